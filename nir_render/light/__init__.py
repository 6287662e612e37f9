"""What transport hands to camera: what one unit of each group brings to each pixel, and its files."""
