"""Models of what shines besides the robots: lamps, the sun, the sky."""
