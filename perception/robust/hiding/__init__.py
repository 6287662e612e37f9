"""Spheres partly behind others, or behind an edge: what is seen of them, and what it tells."""
