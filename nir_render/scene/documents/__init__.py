"""The models of a scene file: what may be written, and what it means in SI units."""
