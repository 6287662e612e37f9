"""The detector that an engineer would ship: each step a file."""
