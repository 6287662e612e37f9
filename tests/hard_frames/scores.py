"""What an estimator's detections are held against: flares as they are, and bounds that share no code with it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import erf

from perception.types import Calibration, Detection, RawFrame
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expected_e, expose, random

Array = NDArray[np.float64]

EXPOSURE_S = 1e-3
CELL_PX = 64
CELLS = 9
POINT = replace(
    calibration(
        width_px=CELLS * CELL_PX, height_px=CELLS * CELL_PX, cx_px=0.5 * CELLS * CELL_PX, cy_px=0.5 * CELLS * CELL_PX,
        source_radius_m=1e-6, read_noise_e=4.6, bit_depth=16, saturation_dn=65535, sigma={},
    )
)  # fmt: skip
"""A camera whose dark pixels have 4.6² + 1/(12·0.74²) ≈ 21.3 e⁻², 24 with 2.7 e⁻ of background; sources are points."""

BACKGROUND_E = 2.7
BRIGHT_E = 1.3e4


@dataclass(frozen=True)
class Flare:
    """A flare as it is: place and flux."""

    u_px: float
    v_px: float
    flux_e: float

    def source(self, camera: Calibration) -> tuple[float, float, float]:
        """Return place and range of a source that has this flux."""
        x, y = (self.u_px - camera.cx_px) / camera.fx_px, (self.v_px - camera.cy_px) / camera.fy_px
        cosine = 1.0 / math.sqrt(1.0 + x * x + y * y)
        return self.u_px, self.v_px, math.sqrt(FLUX_PER_S_AT_1_M * EXPOSURE_S * cosine / self.flux_e)


@dataclass(frozen=True, eq=False)
class Scored:
    """A frame's flares in the order given, the detection of each or None, and the detections of nothing."""

    flares: Sequence[Flare]
    hits: Sequence[Detection | None]
    false_alarms: Sequence[Detection]


def frame_of(
    flares: Sequence[Flare], camera: Calibration, background_e: float | Array, *key: int
) -> RawFrame:
    """Return a frame of flares on a background."""
    mean_e = expected_e(camera, [flare.source(camera) for flare in flares], EXPOSURE_S) + background_e
    return expose(mean_e, camera, random(*key), EXPOSURE_S)


def score(flares: Sequence[Flare], found: Sequence[Detection], within_px: float) -> Scored:
    """Pair flares and detections one to one, nearest first, within a distance."""
    hits: list[Detection | None] = [None] * len(flares)
    if flares and found:
        apart = cdist([(f.u_px, f.v_px) for f in flares], [(d.u_px, d.v_px) for d in found])
        hits = paired(apart, found, within_px)
    taken = {id(hit) for hit in hits}
    return Scored(flares, hits, [one for one in found if id(one) not in taken])


def paired(apart: Array, found: Sequence[Detection], within: float) -> list[Detection | None]:
    """Return for each row of distances, shape (flares, detections), its detection: nearest first, each once."""
    hits: list[Detection | None] = [None] * len(apart)
    left = set(range(len(found)))
    for flat in np.argsort(apart, axis=None).tolist():
        row, one = divmod(flat, len(found))
        if not apart[row, one] <= within:
            break
        if hits[row] is None and one in left:
            hits[row] = found[one]
            left.remove(one)
    return hits


def cell_centres(inner: int = 0) -> Iterator[tuple[float, float]]:
    """Yield the centres of cells, row by row, `inner` of them left out at each edge."""
    for row in range(inner, CELLS - inner):
        for column in range(inner, CELLS - inner):
            yield (column + 0.5) * CELL_PX - 0.5, (row + 0.5) * CELL_PX - 0.5


def pair_sigmas(first: Flare, second: Flare, camera: Calibration, background_e: float) -> Array:
    """Return the Cramér–Rao sigmas of (u, v, ln F) of two points, seven parameters free; shape (2, 3).

    The image of a point is a Gaussian over pixels, ½ erf differences; derivatives are differences too.
    """
    left, top = (round(0.5 * (a + b)) - 20 for a, b in ((first.u_px, second.u_px), (first.v_px, second.v_px)))

    def image(values: Array) -> Array:
        total = np.zeros((41, 41))
        for u, v, log_flux in values.reshape(2, 3):
            shares = [
                0.5
                * np.diff(erf((np.arange(42) - 0.5 + start - at) / (math.sqrt(2.0) * camera.psf_sigma_px)))
                for start, at in ((top, v), (left, u))
            ]
            total += math.exp(log_flux) * np.outer(*shares)
        return total.ravel()

    place = np.array([[flare.u_px, flare.v_px, math.log(flare.flux_e)] for flare in (first, second)]).ravel()
    slopes = [(image(place + step) - image(place - step)) / 2e-3 for step in 1e-3 * np.eye(6)]
    jacobian = np.stack([*slopes, np.ones(41 * 41)])
    rounding_e2 = 1.0 / (12.0 * camera.system_gain_dn_per_e**2)
    variance = image(place) + background_e + camera.read_noise_e**2 + rounding_e2
    information = (jacobian / variance) @ jacobian.T
    return np.sqrt(np.diagonal(np.linalg.inv(information)))[:6].reshape(2, 3)


def lone_sigmas(flare: Flare, camera: Calibration, background_e: float) -> Array:
    """Return the Cramér–Rao sigmas of (u, v, ln F) of a point far from all others, background free too."""
    far = Flare(flare.u_px + 15.0, flare.v_px + 15.0, flare.flux_e)
    return np.asarray(pair_sigmas(flare, far, camera, background_e)[0])


def counts(scored: Sequence[Scored]) -> dict[str, Any]:
    flares = sum(len(each.flares) for each in scored)
    found = sum(hit is not None for each in scored for hit in each.hits)
    false = sum(len(each.false_alarms) for each in scored)
    return {
        "frames": len(scored), "flares": flares, "recall": round(found / max(flares, 1), 4), "false_alarms": false,
    }  # fmt: skip


def share_of(values: Sequence[bool]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def rms(values: Sequence[Any]) -> Any:
    if not values:
        return None
    return np.round(np.sqrt(np.nanmean(np.square(np.array(values, dtype=float)), axis=0)), 4).tolist()
