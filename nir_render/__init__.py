"""Physically based rendering of raw frames from narrowband near-infrared cameras."""
