"""The part of a run's page about time: who was followed by which track, how well, and what was said."""
