"""The camera against its reference: the reference's light to electrons, its electrons to raw counts.

Neither is Monte Carlo. Electrons are sums in float32; the random numbers of a frame are keyed, so its counts
are the same but where rounding falls on the other side.
"""

import math
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from nir_render.regress.findings import Finding, ImagePair, percent
from nir_render.regress.make import FrameSetting, electrons_of, frame_of
from nir_render.regress.reference import ReferenceLight, ReferenceShot, leaves
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from perception import Calibration, RawFrame, calibration_document

_FLOAT32 = 2.0**-24
# Of what is computed in float64 by way of Fourier transforms: a share of the image's brightest pixel.
_FLOAT64 = 1e-12
# Elementary functions in float32 differ by a few units in the last place among libraries and processors, and
# a variate of mean μ by that share of μ; so many electrons, or counts, fall on another whole number.
_FLIPS = 8.0 * _FLOAT32
_MARGIN = 6.0  # standard deviations of the number of flips
_FIELD = 1e-12  # of times, which are a few float64 operations
_CALIBRATION = 1e-6
_QUATERNION = 1e-9
_OF_ROUNDED_FRAMES = 1e-4  # the paper's range constant is fitted to counts, of which one may round otherwise


def compare_electrons(
    scene: Scene,
    setting: FrameSetting,
    shot: ReferenceShot,
    reference: ReferenceLight,
    label: str,
    *,
    exact: bool,
) -> tuple[Finding, ImagePair | None]:
    """Compare the electrons that the reference's light brings now with those that it brought.

    A pixel is the sum of as many float32 images as there are drives, each weighted, and rounded at the end:
    right to the number of drives and 4 times 2⁻²⁴, for nothing in the sum is negative.
    """
    what = f"{label}expected electrons"
    light = reference.light
    problem = _unfit(scene, setting.camera, reference)
    if problem is not None:
        return Finding("camera", what, "fail", problem), None
    before, after = shot.electrons, electrons_of(scene, setting, light)
    if before.shape != after.shape:
        sizes = f"{before.shape[1]} × {before.shape[0]} → {after.shape[1]} × {after.shape[0]} pixels"
        return Finding("camera", what, "fail", sizes), None
    one, other = before.astype(np.float64), after.astype(np.float64)
    share = (len(light.groups) + 4) * _FLOAT32
    allowed = share * np.maximum(one, other) + _FLOAT64 * max(one.max(), other.max())
    excess = np.abs(other - one) / np.maximum(allowed, 1e-300)
    same_bits = bool(np.array_equal(before, after))
    fails = bool(excess.max() > 1.0) or (exact and not same_bits)
    finding = Finding(
        "camera",
        what,
        "fail" if fails else "pass",
        _seen(one, other, same_bits),
        f"{share:.0e} of a pixel",
        same_bits=same_bits,
    )
    return finding, ImagePair(what, "electrons", one, other)


def compare_frame(
    scene: Scene, setting: FrameSetting, shot: ReferenceShot, seed: int, label: str, *, exact: bool
) -> Finding:
    """Compare the raw frame of the reference's electrons, with the reference's noise, with its frame.

    Counts, and what goes with them: exposure, gain, black level, times.
    """
    what = f"{label}raw frame"
    _, camera = scene.camera(setting.camera)
    before = shot.frame.data_dn
    if before.shape != (camera.sensor.rows, camera.sensor.columns):
        return Finding("camera", what, "fail", "the sensor has another size")
    frame = frame_of(camera, setting, shot.electrons, seed)
    difference = frame.data_dn.astype(np.int64) - before
    flips = int(np.count_nonzero(difference))
    others = _other_fields(shot.frame, frame)
    same_bits = flips == 0 and not others
    gain = camera.sensor.system_gain_dn_per_e * setting.gain
    step_dn = math.ceil(gain) + 1
    mean = float(np.sum(1.0 + shot.electrons * (1.0 + gain)))
    allowed = math.ceil(_FLIPS * mean + _MARGIN * math.sqrt(_FLIPS * mean)) + 2
    largest_dn = int(np.abs(difference).max())
    fails = flips > allowed or largest_dn > step_dn or max(others.values(), default=0.0) > _FIELD
    seen = [f"{name} {_short(getattr(shot.frame, name))} → {_short(getattr(frame, name))}" for name in others]
    if flips:
        counts = f"{flips} of {before.size} pixels differ, by {largest_dn} DN at most"
        seen.append(counts + f", on average {difference.mean():+.3g} DN".replace("-", "−"))
    return Finding(
        "camera",
        what,
        "fail" if fails or (exact and not same_bits) else "pass",
        "; ".join(seen) or "equal",
        f"{allowed + 1} pixels, or one by {step_dn + 1} DN; {_FIELD:.0e} of exposure, gain and times",
        same_bits=same_bits,
    )


def compare_calibration(scene: Scene, name: str, before: Calibration, *, exact: bool) -> Finding:
    """Compare what perception may know about a camera with what it knew.

    A spread σ is held against the size of its entry: where there is none, rounding may leave one.
    """
    after = calibration(scene, name)
    old, new = _entries(before), _entries(after)
    worst, seen, same_bits = 0.0, "equal", before.sigma == after.sigma
    for field in dict.fromkeys([*old, *new]):
        one, other = old.get(field), new.get(field)
        difference = _difference(one, other)
        # Poses pass through a quaternion on disk, which rounds.
        same_bits &= difference <= (_QUATERNION if "quaternion" in field else 0.0)
        excess = difference / (_OF_ROUNDED_FRAMES if "range_constant_paper" in field else _CALIBRATION)
        if excess > worst:
            worst, seen = excess, f"{field}: {_short(one)} → {_short(other)}"
    for field in dict.fromkeys([*before.sigma, *after.sigma]):
        one, other = (known.sigma.get(field, 0.0) for known in (before, after))
        size = max(_size(getattr(before, field)), one, 1e-300)
        if abs(other - one) / size / _CALIBRATION > worst:
            worst = abs(other - one) / size / _CALIBRATION
            seen = f"σ of {field}: {_short(one)} → {_short(other)}"
    return Finding(
        "camera",
        f"{name} calibration",
        "fail" if worst > 1.0 or (exact and not same_bits) else "pass",
        seen if worst > 1.0 or same_bits else "equal but for rounding",
        f"{_CALIBRATION:.0e} of an entry",
        same_bits=same_bits,
    )


def _other_fields(before: RawFrame, after: RawFrame) -> dict[str, float]:
    """Return the relative difference of each field but the counts that is not the same."""
    pairs = {
        field.name: (getattr(before, field.name), getattr(after, field.name))
        for field in fields(RawFrame)
        if field.name != "data_dn"
    }
    return {name: _difference(one, other) for name, (one, other) in pairs.items() if one != other}


def _entries(calibration: Calibration) -> dict[str, object]:
    document = calibration_document([replace(calibration, sigma={})])
    return leaves(document["cameras"][calibration.camera])


def _size(value: object) -> float:
    return float(np.max(np.abs(np.asarray(value, dtype=np.float64))))


def _unfit(scene: Scene, name: str, reference: ReferenceLight) -> str | None:
    """Say why the reference's light is none that this scene's camera could see, if so."""
    known, light = scene.emitters(), reference.light
    gone = [group for group in light.groups if group not in known]
    if gone:
        return f"the scene has no {', '.join(gone)} any more"
    _, camera = scene.camera(name)
    if light.indirect is not None:
        film = light.indirect.radiance_per_w.shape[2:]
        sensor = (camera.sensor.rows, camera.sensor.columns)
        if tuple(light.indirect.scale * side for side in film) != sensor:
            return f"the sensor has {sensor[1]} × {sensor[0]} pixels now"
    return None


def _seen(before: NDArray[np.float64], after: NDArray[np.float64], same_bits: bool) -> str:
    if same_bits:
        return "equal"
    row, column = np.unravel_index(np.argmax(np.abs(after - before)), before.shape)
    total = float(after.sum() / before.sum() - 1.0) if before.sum() else math.inf
    here = float(after[row, column] / before[row, column] - 1.0) if before[row, column] else math.inf
    return (
        f"frame {percent(total, signed=True)}, at u {column}, v {row} {percent(here, signed=True)}"
        f" ({before[row, column]:.5g} → {after[row, column]:.5g} e)"
    )


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "nothing" if value is None else str(value)


def _difference(one: object, other: object) -> float:
    if one == other:
        return 0.0
    if isinstance(one, tuple | list) and isinstance(other, tuple | list) and len(one) == len(other):
        return max(map(_difference, one, other))
    if not (isinstance(one, int | float) and isinstance(other, int | float)):
        return math.inf
    # Angles, places and times may be 0.
    return abs(other - one) / max(abs(one), abs(other), 1e-6)
