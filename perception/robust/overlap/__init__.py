"""Flares that overlap, told apart: those that add up, and what else would explain them as well."""
