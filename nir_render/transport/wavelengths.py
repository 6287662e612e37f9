"""At which wavelengths light is carried into one camera: one, unless materials vary over what it sees."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.response import kind_alone, optics_alone, sensed
from nir_render.errors import InputError
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.document import WavelengthSettings
from nir_render.scene.documents.materials import curves_of
from nir_render.scene.emission import Emitter
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.choice import Choice, beyond_data, choose_nodes
from nir_render.spectra.curve import Curve
from nir_render.spectra.illuminants import SILICON_M
from nir_render.spectra.nodes import BAND_M

Array = NDArray[np.float64]

_STEP_M = 0.25e-9
_BEYOND_SHARE = 0.5  # of the error wanted, what may lie beyond data


def carried_wavelengths(snapshot: Snapshot, camera: str) -> Choice:
    """Return the nodes for a camera, `robot.camera`, and the error that they make (`spectra.choice`).

    Where all materials are the same at all wavelengths that is 940 nm alone, without any error. What lies
    beyond a material's data, if it is little, is carried by the data's end, and its error is in that of the
    nodes: it could have any reflectance, at each of the bounces that are counted on.

    Raises
    ------
    InputError
        What the camera sees of an emitter beyond the data of a material could err by more than half of the
        error asked for.
    """
    curves = used_curves(snapshot)
    if not curves or not snapshot.emitters:
        return Choice((BAND_M,), 0.0)
    device = optics_alone(snapshot.camera(camera).camera)
    kinds: dict[Emitter, str] = {}
    for name, emitter in snapshot.emitters.items():
        kinds.setdefault(kind_alone(emitter), name)
    settings = snapshot.render.wavelengths
    return _carried(snapshot.origin, camera, device, tuple(kinds.items()), tuple(curves.items()), settings)


def used_curves(snapshot: Snapshot) -> dict[str, CurveDocument]:
    """Return what varies with the wavelength of materials that bodies are made of, by place."""
    used = dict.fromkeys(shape.material for shape in snapshot.shapes.values())
    return {
        f"materials.{name}.{field}": curve
        for name in used
        for field, curve in curves_of(snapshot.materials[name]).items()
    }


@lru_cache(maxsize=64)
def _carried(
    origin: str,
    camera: str,
    device: Camera,
    kinds: tuple[tuple[Emitter, str], ...],
    written: tuple[tuple[str, CurveDocument], ...],
    settings: WavelengthSettings,
) -> Choice:
    wavelength_m = np.arange(SILICON_M[0], SILICON_M[1] + 0.5 * _STEP_M, _STEP_M)
    curves = {place: curve.curve(place) for place, curve in written}
    seen = {name: sensed(device, emitter, wavelength_m) for emitter, name in kinds}
    try:
        beyond = _beyond(camera, wavelength_m, seen, curves, settings.error)
    except InputError as error:
        raise InputError(f"{origin}: {error}") from None
    low_m = max(curve.low_m for curve in curves.values())
    high_m = min(curve.high_m for curve in curves.values())
    within = np.clip(wavelength_m, low_m, high_m)
    values = np.array([np.interp(within, curve.wavelength_m, curve.value) for curve in curves.values()])
    bends_m = np.concatenate([[low_m, high_m, BAND_M], *(curve.wavelength_m for curve in curves.values())])
    found = choose_nodes(
        wavelength_m,
        np.concatenate(list(seen.values())),
        values,
        bends_m[(bends_m >= low_m) & (bends_m <= high_m)],
        error=settings.error - beyond,
        most=settings.most,
    )
    return Choice(found.wavelengths_m, found.error + beyond)


def _beyond(
    camera: str, wavelength_m: Array, seen: Mapping[str, Array], curves: Mapping[str, Curve], error: float
) -> float:
    """Return the largest relative error that anything from 0 to 1 beyond the curves' data could make."""
    held = np.array([np.interp(wavelength_m, one.wavelength_m, one.value) for one in curves.values()])
    outside = np.array(
        [(wavelength_m < one.low_m - 1e-15) | (wavelength_m > one.high_m + 1e-15) for one in curves.values()]
    )
    largest = 0.0
    for emitter, parts in seen.items():
        could_err = beyond_data(parts, held, outside)
        if could_err > _BEYOND_SHARE * error:
            shares = [float(parts[:, one].sum(axis=1).max()) for one in outside]
            most = int(np.argmax(shares))
            place, curve = list(curves.items())[most]
            wanted = 1.05 * could_err / _BEYOND_SHARE
            allowing = f"render: {{wavelengths: {{error: {100.0 * wanted:.2g} %}}}}"
            raise InputError(
                f"{place}: covers {curve.range_nm()}, but {100.0 * shares[most]:.3g} % of what {camera} sees "
                f"of {emitter} lies beyond; give data there"
                + (f", or allow the error that this could make by {allowing}" if wanted < 0.95 else "")
            )
        largest = max(largest, could_err)
    return largest
