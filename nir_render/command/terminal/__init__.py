"""What the command shows on a terminal: text, bars, tables."""
