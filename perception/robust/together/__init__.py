"""What all flares of a frame tell together that none tells alone: of the camera, and of its calibration."""
