"""One source before one camera: frames of it, and what both stacks make of them, beside truth."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nir_render.camera.mean_frame import Rates, exposed_frame, fully_lit_frame
from nir_render.camera.timing.exposure_control import Setting
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.evaluate.match import match, on_a_lamp
from nir_render.evaluate.metrics import source_limits
from nir_render.randomness import RandomKey
from nir_render.simulation.clock import frame_of
from nir_render.simulation.lamps import lamp_truth
from nir_render.simulation.truth import truth_of
from nir_render.truth.sources import SourceTruth
from perception import Calibration, Detection, RawFrame, detect

STACKS = ("paper", "robust")

_BRIGHTEST = 0.7  # of full scale, as automatic exposure sets it
_SHORTEST_S, _LONGEST_S = 20e-6, 5e-3


@dataclass(frozen=True)
class Seen:
    """What a stack makes of the source in one frame; None where it does not find it.

    Attributes
    ----------
    range_m
        As the stack says it, by its constant in the calibration.
    signal_dn_per_s
        The paper's m: (mean grey - background) / exposure.
    flux_dn_per_s
        Counts of the whole flare, in a second.
    """

    range_m: float
    signal_dn_per_s: float
    flux_dn_per_s: float


@dataclass(frozen=True)
class Sighting:
    """One frame.

    Attributes
    ----------
    range_m
        The true range.
    limit_m
        The Cramér–Rao bound of it, 1 σ.
    light_e_per_s
        Electrons in a second that truly came straight from it.
    exposure_s
        How long it was exposed.
    seen
        By stack.
    false_alarms
        By stack: detections that are of no source, no lamp, and no mirror image by their own account.
    """

    range_m: float
    limit_m: float
    light_e_per_s: float
    exposure_s: float
    seen: dict[str, Seen | None]
    false_alarms: dict[str, int]

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self)


def sighting_of(record: dict[str, Any]) -> Sighting:
    """Return a sighting from its record."""
    seen = {name: None if one is None else Seen(**one) for name, one in record["seen"].items()}
    return Sighting(**{**record, "seen": seen})


def set_exposure_s(rates: Rates, known: Calibration) -> float:
    """Return the exposure at which the brightest pixel of the mean frame is at 70 % of full scale."""
    rate_e_per_s = float(fully_lit_frame(rates, 1.0).electrons.max())
    full_e = (known.saturation_dn - known.black_level_dn) / known.system_gain_dn_per_e
    return float(np.clip(_BRIGHTEST * full_e / rate_e_per_s, _SHORTEST_S, _LONGEST_S))


def sight(rates: Rates, known: Calibration, exposure_s: float, index: int, seed: int) -> Sighting:
    """Take a frame of a light, and let both stacks look for the source."""
    camera = rates.camera
    begin_s = rates.snapshot.time_s - mid_exposure_s(camera, exposure_s)
    mean = exposed_frame(rates, exposure_s, begin_s)
    key = RandomKey(seed, "read_out", known.camera, index)
    frame = frame_of(mean.electrons, camera, Setting(exposure_s, 1.0), begin_s, key)
    (truth,) = (row for row in truth_of(mean, frame) if row.ghost_of is None)
    limit_m, _ = source_limits(truth, known)
    lamps_px = [lamp.outline_px for lamp in lamp_truth(rates.snapshot, known.camera, index)]
    seen: dict[str, Seen | None] = {}
    false_alarms: dict[str, int] = {}
    for name in STACKS:
        found = detect(frame, known, estimator=name)
        seen[name], others = _of_source(found, truth, frame, known)
        false_alarms[name] = sum(not (one.ghost or on_a_lamp(one, lamps_px)) for one in others)
    return Sighting(truth.range_m, limit_m, truth.direct_e / exposure_s, exposure_s, seen, false_alarms)


def _of_source(
    found: list[Detection], truth: SourceTruth, frame: RawFrame, known: Calibration
) -> tuple[Seen | None, list[Detection]]:
    matched = match([truth], found, known)
    others = [found[number] for number in matched.unmatched]
    if not matched.pairs:
        return None, others
    hit = found[matched.pairs[0][1]]
    signal_dn = hit.mean_dn - hit.background_dn
    return Seen(hit.range_m, signal_dn / frame.exposure_s, hit.flux_dn / frame.exposure_s), others
