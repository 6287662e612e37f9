"""How likely is what the pixels of a window show, and where it is likeliest: compiled, window by window."""
