"""The clock: poses, exposures and light over time, and the truth about what they show."""
