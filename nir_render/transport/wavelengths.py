"""At which wavelengths light is carried into one camera: one, unless materials vary over what it sees."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.response import sensed
from nir_render.errors import InputError
from nir_render.scene.documents.materials import curves_of
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.choice import Choice, choose_nodes
from nir_render.spectra.curve import Curve
from nir_render.spectra.illuminants import SILICON_M
from nir_render.spectra.nodes import BAND_M

Array = NDArray[np.float64]

_STEP_M = 0.25e-9


def carried_wavelengths(snapshot: Snapshot, camera: str) -> Choice:
    """Return the nodes for a camera, `robot.camera`, and the error that they make (`spectra.choice`).

    Where all materials are the same at all wavelengths that is 940 nm alone, without any error.

    Raises
    ------
    InputError
        More than the error asked for, of what the camera sees, lies beyond the data of a material.
    """
    curves = used_curves(snapshot)
    if not curves or not snapshot.emitters:
        return Choice((BAND_M,), 0.0)
    settings = snapshot.render.wavelengths
    device = snapshot.camera(camera).camera
    wavelength_m = np.arange(SILICON_M[0], SILICON_M[1] + _STEP_M, _STEP_M)
    seen = {name: sensed(device, emitter, wavelength_m) for name, emitter in snapshot.emitters.items()}
    low_m = max(curve.low_m for curve in curves.values())
    high_m = min(curve.high_m for curve in curves.values())
    beyond = _refuse_unknown(snapshot, camera, wavelength_m, seen, curves, settings.error)
    weights = np.unique(np.concatenate(list(seen.values())), axis=0)
    within = np.clip(wavelength_m, low_m, high_m)
    values = np.array([np.interp(within, curve.wavelength_m, curve.value) for curve in curves.values()])
    bends_m = np.unique(np.concatenate([curve.wavelength_m for curve in curves.values()]))
    bends_m = bends_m[(bends_m >= low_m) & (bends_m <= high_m)]
    candidates_m = np.concatenate([[low_m, high_m], _thinned(bends_m)])
    if low_m <= BAND_M <= high_m:
        candidates_m = np.append(candidates_m, BAND_M)
    found = choose_nodes(
        wavelength_m, weights, values, candidates_m, error=settings.error, most=settings.most
    )
    return Choice(found.wavelengths_m, found.error + beyond)


def used_curves(snapshot: Snapshot) -> Mapping[str, Curve]:
    """Return what varies with the wavelength of materials that bodies are made of, by place."""
    used = dict.fromkeys(shape.material for shape in snapshot.shapes.values())
    found: dict[str, Curve] = {}
    for name in used:
        for field, curve in curves_of(snapshot.materials[name]).items():
            place = f"materials.{name}.{field}"
            found[place] = curve.curve(place)
    return found


def _refuse_unknown(
    snapshot: Snapshot,
    camera: str,
    wavelength_m: Array,
    seen: Mapping[str, Array],
    curves: Mapping[str, Curve],
    error: float,
) -> float:
    """Return the largest share of what a camera sees of an emitter that lies beyond a curve's data."""
    largest = 0.0
    for place, curve in curves.items():
        outside = (wavelength_m < curve.low_m - 1e-15) | (wavelength_m > curve.high_m + 1e-15)
        for emitter, parts in seen.items():
            total = parts.sum(axis=1)
            share = float((parts[:, outside].sum(axis=1) / np.maximum(total, 1e-300)).max())
            if share > error:
                raise InputError(
                    f"{snapshot.origin}: {place}: covers {curve.range_nm()}, but {100.0 * share:.3g} % of "
                    f"what {camera} sees of {emitter} lies beyond; give data there, or allow the error by "
                    f"render: {{wavelengths: {{error: {100.0 * share * 1.1:.2g} %}}}}"
                )
            largest = max(largest, share)
    return largest


def _thinned(places_m: Array, most: int = 64) -> Array:
    """Return some of many places, evenly."""
    if len(places_m) <= most:
        return places_m
    return np.asarray(places_m[np.linspace(0, len(places_m) - 1, most).round().astype(int)])
