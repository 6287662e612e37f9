"""What a reference holds of each stage, and how what is rendered now is held against it."""
