"""A source as it is built, and where it shines to: photons are sent through it one by one and counted."""
