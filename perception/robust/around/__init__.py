"""What lies around flares and is none: halos, edges, highlights; each with the flares before it."""
