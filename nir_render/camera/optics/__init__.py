"""Light through the lens: projection, point spread, glare, spectral response."""
