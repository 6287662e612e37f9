"""Images of spheres, laid out to be spread over pixels: by points, and by rows."""
