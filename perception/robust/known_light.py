"""Flares in fog are fitted again with the light that fog scatters forward about them, where it is known."""

from dataclasses import replace

import numpy as np

from perception.model.fog import forward_sigma, range_in_fog_m
from perception.model.forward import halo_e
from perception.model.layout import Structure
from perception.model.window import Camera
from perception.robust.solve import Solution, Window, solve
from perception.robust.structure import joined

_ROUNDS = 3
_SETTLED = 1e-3  # of a flux


def fit_beside_forward_light(best: list[Solution | None], camera: Camera) -> None:
    """Replace solutions by those of windows in which the flares' halos by fog are known light.

    How bright a halo is follows from the flare's flux and the range at which fog leaves so much of it; the
    flux is smaller where the halo is known: so it is done until fluxes stay. Nothing is changed where the
    calibration does not know extinction or forward light.
    """
    calibration = camera.calibration
    if not (calibration.forward_light and calibration.extinction_per_m > 0.0):
        return
    first = {index: one for index, one in enumerate(best) if one is not None and bool(one.ranged.all())}
    going = dict(first)
    for _ in range(_ROUNDS):
        problems = [one.again(_with_halos(one, first[index], camera)) for index, one in going.items()]
        again = dict(zip(going, solve(problems, camera), strict=True))
        moved = {}
        for index, now in again.items():
            if now is None:
                continue
            best[index] = now
            if np.any(np.abs(np.log(now.flux_e / going[index].flux_e)) > _SETTLED):
                moved[index] = now
        going = moved
        if not going:
            return


def _with_halos(solution: Solution, first: Solution, camera: Camera) -> Window:
    """Return a solution's window with the halos of its flares as known light.

    What is not known of their strength is structure of it, on what the first had.
    """
    calibration, window = camera.calibration, solution.window
    ranges_m = range_in_fog_m(np.exp(solution.log_photometric_range), calibration.extinction_per_m)
    depths = calibration.extinction_per_m * ranges_m
    rows = zip(solution.u_px, solution.v_px, solution.flux_e, solution.image_radius_px, depths, strict=True)
    halos = [halo_e(*map(float, row), window.box, calibration) for row in rows]
    known_e, structure, sigma = np.sum(halos, axis=0), first.window.structure, forward_sigma(calibration)
    if sigma > 0.0:
        structure = joined(structure, Structure(known_e.reshape(1, -1), np.array([[1.0 / sigma**2]])))
    return replace(window, known_e=known_e, structure=structure)
