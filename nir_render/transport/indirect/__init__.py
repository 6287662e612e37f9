"""All other light, by Monte Carlo: every group apart in one pass, with its variance."""
