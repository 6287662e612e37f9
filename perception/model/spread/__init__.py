"""Points and strips of light, blurred by a Gaussian point spread, as shares of it in pixels: compiled."""
