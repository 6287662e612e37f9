"""Models of sources as they are built, which a goniometer measures."""
