"""Flares that overlap, told apart: those that add up, and those of which one hides a part of the other."""
