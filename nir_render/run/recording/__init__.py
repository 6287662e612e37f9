"""Recordings of real cameras: from a short file that a person fills in to frames and calibration."""
