"""Why a detection's range is no surer: what its σ is made of, cause by cause."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from perception.model.fisher import range_causes
from perception.model.fog import extinction_sigma_per_m
from perception.model.sensor import at_gain
from perception.types import Calibration, Detection

CAUSES = (
    "own_light_m", "background_m", "prnu_m", "read_noise_m", "dsnu_m", "rounding_m", "range_constant_m",
    "source_radius_m", "point_spread_m", "fog_m", "other_m",
)  # fmt: skip
"""What adds up to the σ of a range, in quadrature."""


@dataclass(frozen=True, eq=False)
class DetectionCauses:
    """What one detection's `range_sigma_m` is made of.

    Attributes
    ----------
    camera, index, detection
        Which detection: its frame, and its number among that frame's detections.
    range_m, range_sigma_m
        As detected.
    causes_m
        What each of `CAUSES` brings; in quadrature they add up to `range_sigma_m`. `range_constant_m` is of
        all that the calibration's σ of K holds: K itself, the robots' own flux, LED temperature, glare.
        `other_m` is what the estimator claims beyond the bound of one flare alone: neighbours, uneven
        background, a misfit; where fog is not excluded `fog_m` has it.
    response_m
        What the σ of `response_relative` (filter, vignetting) would add; it is no part of `range_sigma_m`.
    """

    camera: str
    index: int
    detection: int
    range_m: float
    range_sigma_m: float
    causes_m: Mapping[str, float]
    response_m: float

    def part_m(self, cause: str) -> float:
        """Return what a cause brings: one of `CAUSES`, or `response_m`."""
        return self.response_m if cause == "response_m" else self.causes_m[cause]

    def record(self) -> dict[str, float | int | str]:
        """Return the object of its line in `causes.NAME.jsonl`."""
        own = asdict(self)
        causes_m = own.pop("causes_m")
        return {"format": 1, **own, **causes_m}


def detection_causes(
    hits: Sequence[Detection], calibration: Calibration, gain: float, black_level_dn: float
) -> list[DetectionCauses]:
    """Return the causes of the σ of each range of one frame's detections; of those that claim one.

    The causes are those of the Cramér–Rao bound of a flare of this flux, place, range and background
    (`fisher.range_causes`). Where the estimator claims less than the bound of its own flare, all of them are
    less in proportion.

    Parameters
    ----------
    hits
        All detections of a frame, in their order.
    calibration
        Of the camera.
    gain, black_level_dn
        Of the frame.
    """
    known = at_gain(calibration, gain)
    response = calibration.sigma.get("response_relative", 0.0)
    found = []
    for number, hit in enumerate(hits):
        if not (hit.range_m > 0.0 and math.isfinite(hit.range_sigma_m) and hit.flux_dn > 0.0):
            continue
        background_e = max(hit.background_dn - black_level_dn, 0.0) / known.system_gain_dn_per_e
        flux_e = hit.flux_dn / known.system_gain_dn_per_e
        causes = range_causes(known, hit.u_px, hit.v_px, hit.range_m, flux_e, background_e)
        causes_m = dict.fromkeys(CAUSES, 0.0) | ({} if causes is None else asdict(causes))
        bound_m = math.hypot(*causes_m.values())
        if bound_m > hit.range_sigma_m:
            causes_m = {name: value * hit.range_sigma_m / bound_m for name, value in causes_m.items()}
        rest_m = math.sqrt(max(hit.range_sigma_m**2 - bound_m**2, 0.0))
        causes_m["fog_m" if extinction_sigma_per_m(calibration) > 0.0 else "other_m"] = rest_m
        found.append(
            DetectionCauses(
                hit.camera,
                hit.index,
                number,
                hit.range_m,
                hit.range_sigma_m,
                causes_m,
                0.5 * hit.range_m * response,
            )
        )
    return found
