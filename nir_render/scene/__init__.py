"""What the world is: scene files, and the plain data that they become."""
