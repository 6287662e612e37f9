"""Everything that varies with wavelength: sampled curves, emission spectra, filters."""
