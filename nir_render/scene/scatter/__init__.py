"""Robots at random places: what is free, and where each is put."""
