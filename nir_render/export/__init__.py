"""Light and frames in other people's formats."""
