"""Discs too large to be looked at closely: near sources, and what is no source."""
