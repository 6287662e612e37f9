"""The photon budget of a scene without rendering: electrons, σ of ranges by cause, eye safety."""
