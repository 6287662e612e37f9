"""The design of a campaign: axes, units that are drawn, points at which it is run."""
