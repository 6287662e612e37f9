"""What the text of a scene file means: YAML, and quantities with units."""
