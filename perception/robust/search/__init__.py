"""Where flares may be: the frame filtered, what exceeds its noise, in blobs."""
