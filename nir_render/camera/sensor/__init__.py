"""Electrons to raw counts: noise, fixed pattern, full well, ADC."""
