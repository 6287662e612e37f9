"""A stack's output against truth and against the physical limit."""
