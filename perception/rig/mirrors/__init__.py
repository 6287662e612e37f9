"""Planes that show robots twice: their images found, fitted, and weighed against chance."""
