"""Light to raw counts: lens, point spread, spectral response, sensor. Plain numpy."""
