"""Whether the intervals of `calibrate` hold the truth, and are as narrow as they can be.

A camera of 400 × 300 pixels behind a lens that vignettes is calibrated from 16 dark frames, 16 flat ones and 8 at
each of 16 ranges, rendered with noise and a fixed pattern of their own for each seed. What must come out: of 100
seeds 88 to 100 have the truth within 1.96 σ, and no σ is above 1.25 times Cramér–Rao's (`calibration_frames`).
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

import nir_render as nr
from nir_render.simulation.calibration import calibration
from perception import CalibratedCamera, calibrate_camera, calibrate_dark, calibrate_point_spread
from perception.model.sensor import without_offsets
from perception.types import Calibration, RawFrame
from tests.calibration_frames import (
    DARK,
    EXPOSURE_S,
    NAME,
    CalibrationRun,
    camera_of,
    point_spread_bounds,
    range_constant_bound,
    response_bound,
)
from tests.paths import SCENES

# A hundred take an hour: AT_LENGTH=1 make verify.
SEEDS, GLARE_SEEDS = (100, 100) if "AT_LENGTH" in os.environ else (20, 16)
ANGLES = (8, 24, 40, 56, 64)  # of the 65 in the table: the last is the frame's corner
LEFT_E = 2.19  # what 16 frames leave of offsets: √(1/(1/4² + 16/10²) + rounding)


def _exact() -> Calibration:
    """What is known of the camera without glare, exactly."""
    scene = nr.load_scene(SCENES / "calibration.yaml")
    snapshot = scene.at(0.0)
    robot = snapshot.robots["r1"]
    rig = robot.rig.model_copy(update={"cameras": {**robot.rig.cameras, "front": camera_of(0.0, "any")}})
    return calibration(replace(snapshot, robots={**snapshot.robots, "r1": replace(robot, rig=rig)}), NAME)


def _guess(exact: Calibration) -> Calibration:
    """A first guess that is off in all that is learned."""
    return replace(
        exact,
        black_level_dn=60.0,
        read_noise_e=8.0,
        psf_sigma_px=0.8,
        prnu=2.0 * exact.prnu,
        range_constant_dn_m2_per_s=1.1 * exact.range_constant_dn_m2_per_s,
        response_relative=np.ones_like(exact.response_relative),
        sigma={},
    )


@dataclass(frozen=True, eq=False)
class _Told:
    """One thing that was learned in each seed: errors, σ, and the bound of σ."""

    errors: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    bound: float

    def check(self, what: str) -> None:
        held = np.mean(np.abs(self.errors) <= 1.96 * self.sigmas)
        # For 95 % of so many, 88 of 100 are 3.2 σ off.
        least = 0.95 - 3.2 * math.sqrt(0.95 * 0.05 / len(self.errors))
        assert held >= least, f"{what}: {held:.0%} of the intervals hold the truth"
        assert np.median(self.sigmas) <= 1.25 * self.bound, f"{what}: σ over its bound {self.bound:g}"


def _told(
    found: Sequence[CalibratedCamera], runs: Sequence[CalibrationRun], exact: Calibration
) -> dict[str, _Told]:
    def one(errors: Sequence[float], sigmas: Sequence[float], bound: float) -> _Told:
        return _Told(np.array(errors), np.array(sigmas), bound)

    pixels, gain = exact.width_px * exact.height_px, exact.system_gain_dn_per_e
    read_e = math.hypot(exact.read_noise_e, math.sqrt(20.0 * EXPOSURE_S))  # dark current's own
    noise_e2 = read_e**2 + 1.0 / (12.0 * gain**2)
    spread = point_spread_bounds(0.0, LEFT_E)
    dark = [one.dark for one in found if one.dark is not None]
    points = [one.point_spread for one in found if one.point_spread is not None]
    flat = [one.flat for one in found if one.flat is not None]
    told = {
        "black level": one(
            [d.black_level_dn - run.true_black_dn for d, run in zip(dark, runs, strict=True)],
            [d.black_level_sigma_dn for d in dark],
            gain * math.sqrt(noise_e2 / (DARK * pixels)),
        ),
        "read noise": one(
            [d.read_noise_e - read_e for d in dark],
            [d.read_noise_sigma_e for d in dark],
            noise_e2 * math.sqrt(0.5 / (DARK * pixels)) / read_e,
        ),
        "an offset": one(
            [float((d.offset_e - run.true_offset_e)[100, 200]) for d, run in zip(dark, runs, strict=True)],
            [d.offset_sigma_e for d in dark],
            math.sqrt(1.0 / (1.0 / 4.0**2 + DARK / noise_e2)),
        ),
        "point spread": one(
            [p.sigma_px - 0.7 for p in points], [p.sigma_sigma_px for p in points], spread["sigma_px"]
        ),
        "glare": one([p.glare_share for p in points], [p.glare_share_sigma for p in points], spread["share"]),
    }
    constants = [one.calibration for one in found]
    least = range_constant_bound(LEFT_E, exact) * exact.range_constant_dn_m2_per_s
    told["range constant"] = one(
        [k.range_constant_dn_m2_per_s - exact.range_constant_dn_m2_per_s for k in constants],
        [k.sigma["range_constant_dn_m2_per_s"] for k in constants],
        least,
    )
    angle_rad = flat[0].angle_rad[list(ANGLES)]
    bounds = response_bound(0.0, angle_rad, exact, LEFT_E)
    truth = np.interp(angle_rad, exact.response_angle_rad, exact.response_relative)
    for number, index in enumerate(ANGLES):
        told[f"response at {math.degrees(angle_rad[number]):.0f}°"] = one(
            [float(f.response[index] - truth[number]) for f in flat],
            [float(f.response_sigma[index]) for f in flat],
            float(bounds[number]),
        )
    return told


def _check(seeds: int) -> None:
    exact = _exact()
    runs = [CalibrationRun(0.0, seed) for seed in range(seeds)]
    found = [calibrate_camera(run.frames(_guess(exact)), _guess(exact)) for run in runs]
    for what, told in _told(found, runs, exact).items():
        told.check(what)


@pytest.mark.verify
def test_of_three_cameras_all_that_is_learned_is_true() -> None:
    _check(3)


@pytest.mark.verify
def test_of_many_cameras_the_intervals_hold_the_truth() -> None:
    """As above, of more seeds."""
    _check(SEEDS)


@pytest.mark.verify
def test_intervals_of_glare_hold_the_truth() -> None:
    """2 % of glare of 10 px and exponent 2.5; its shape is known badly, and the share's σ knows it."""
    exact = _exact()
    guess = replace(_guess(exact), prnu=exact.prnu)  # no flat frames tell it here
    errors, sigmas = [], []
    for seed in range(GLARE_SEEDS):
        frames = CalibrationRun(0.02, seed).frames(guess)
        known = calibrate_dark(map(frames.load, frames.dark), guess).calibration

        def load(index: int, known: Calibration = known, read=frames.load) -> RawFrame:  # type: ignore[no-untyped-def]
            return without_offsets(replace(read(index), black_level_dn=known.black_level_dn), known)

        found = calibrate_point_spread(frames.ranges_m, load, known)
        errors.append([found.sigma_px - 0.7, found.glare_share - 0.02])
        sigmas.append([found.sigma_sigma_px, found.glare_share_sigma])
    bounds = point_spread_bounds(0.02, LEFT_E)
    for number, what in enumerate(("sigma_px", "share")):
        _Told(np.array(errors)[:, number], np.array(sigmas)[:, number], bounds[what]).check(what)
