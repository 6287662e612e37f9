"""Models of what is spectral: LEDs, interference filters, what is known of a quantum efficiency."""
