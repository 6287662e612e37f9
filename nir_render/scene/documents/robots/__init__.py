"""Models of robots: those that are written one by one, and groups that are scattered."""
