"""The forward model that fit, bound and evaluation share."""
