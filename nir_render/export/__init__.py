"""A run folder in other people's formats; a file per format, and what it needs."""
