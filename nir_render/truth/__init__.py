"""What is true in a frame, as records: written while rendering, read by whoever scores."""
