"""What touches disk: recordings, calibrations, detections, ranges."""
