"""The page of a calibration: what was learned, how sure it is, and what speaks against it."""
