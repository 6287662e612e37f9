"""How droplets and particles scatter light: sizes, Mie theory, and what becomes of many of them."""
