"""The stage `calibrate`, from folder to folder: frames at known ranges become calibrated range constants."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds, parse_lines
from nir_render.run.perceive import unknown_camera
from nir_render.run.render import Progress
from nir_render.scene.load import load_scene
from nir_render.simulation.calibration import range_constant
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import (
    RailCalibration,
    calibrate_rail,
    calibration_document,
    encode_ranges,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_ranges,
)
from perception.calibration.result import IDEAL_MAE, HeldOut, faults
from perception.files.ranges import RANGES_FILE

FITTED_FILE = "calibration.fitted.json"


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """One camera's calibration, what speaks against it, and the true constant of rendered frames."""

    result: RailCalibration
    faults: tuple[str, ...]
    true_range_constant_dn_m2_per_s: float | None

    @property
    def fitted_to_true(self) -> float | None:
        """Relative error of the fitted constant of the flux."""
        if self.true_range_constant_dn_m2_per_s is None:
            return None
        return self.result.fit.range_constant_dn_m2_per_s / self.true_range_constant_dn_m2_per_s - 1.0

    def record(self) -> dict[str, Any]:
        """Return the numbers, as JSON has them."""
        result, fit, paper = self.result, self.result.fit, self.result.paper
        numbers = {
            "range_constant_dn_m2_per_s": fit.range_constant_dn_m2_per_s,
            "range_constant_sigma_dn_m2_per_s": fit.range_constant_sigma_dn_m2_per_s,
            "range_constant_true_dn_m2_per_s": self.true_range_constant_dn_m2_per_s,
            "range_constant_relative_error": self.fitted_to_true,
            "slope_dn_m2_per_s": fit.slope_dn_m2_per_s,
            "slope_sigma_dn_m2_per_s": fit.slope_sigma_dn_m2_per_s,
            "intercept_dn_per_s": fit.intercept_dn_per_s,
            "intercept_sigma_dn_per_s": fit.intercept_sigma_dn_per_s,
            "correlation": fit.correlation,
            "reduced_chi2": fit.reduced_chi2,
            "chi2_probability": fit.chi2_probability,
            "measurements": fit.measurements,
            "misfits": result.misfits,
            "passes": result.passes,
            "last_change": result.last_change,
            "range_constant_paper_dn_m2_per_s": paper.slope_dn_m2_per_s if paper else None,
            "range_constant_paper_sigma_dn_m2_per_s": paper.slope_sigma_dn_m2_per_s if paper else None,
            "intercept_paper_dn_per_s": paper.intercept_dn_per_s if paper else None,
            "intercept_paper_sigma_dn_per_s": paper.intercept_sigma_dn_per_s if paper else None,
        }
        held_out = {
            "ranges": result.places_held_out,
            "frames": result.frames_held_out,
            "range_limit_sigma_m": _or_none(result.range_limit_m),
            "range_limit_mae_m": _or_none(IDEAL_MAE * result.range_limit_m),
            "estimators": {"robust": _numbers(result.robust), "paper": _numbers(result.paper_held_out)},
        }
        return {
            **{name: _or_none(value) for name, value in numbers.items()},
            "fitted": {"ranges": result.places_fitted, "frames": result.frames_fitted},
            "held_out": held_out,
            "faults": list(self.faults),
        }


def calibrate_run(folder: Path, progress: Progress) -> dict[str, CameraCalibration]:
    """Calibrate the cameras of a folder whose ranges are known; returns the results by camera.

    The ranges stand in `ranges.csv`; where a rendered run has none, it is written from the truth. Where
    nothing speaks against the result, `calibration.fitted.json` is written: the calibration with the fitted
    constants. Otherwise there is none, also none of an earlier call.

    Raises
    ------
    InputError
        The folder is no recording, no ranges are known, or they are too few.
    """
    started = time.perf_counter()
    (folder / FITTED_FILE).unlink(missing_ok=True)
    truth = _truth(folder)
    try:
        calibrations = read_calibrations(folder)
        records = {(record.camera, record.index): record for record in read_frame_records(folder)}
        if not (folder / RANGES_FILE).is_file() and truth:
            run_folder.write_file(folder / RANGES_FILE, encode_ranges(_true_ranges(folder, truth)).encode())
        ranges_m = read_ranges(folder)
        done = {}
        for camera, index in ranges_m:
            if camera not in calibrations:
                raise unknown_camera(folder, camera, calibrations)
            if (camera, index) not in records:
                raise InputError(
                    f"{folder / RANGES_FILE}: knows the range of frame {index} of {camera!r}, "
                    "which is not in frames.jsonl"
                )
        for camera in dict.fromkeys(camera for camera, _ in ranges_m):
            own = {index: range_m for (name, index), range_m in ranges_m.items() if name == camera}
            result = calibrate_rail(
                own,
                lambda index, camera=camera: read_frame(folder, records[camera, index]),  # type: ignore[misc]
                calibrations[camera],
                progress,
            )
            done[camera] = CameraCalibration(
                result, tuple(faults(result)), _true_constant(folder, camera, truth)
            )
    except InputError:
        raise
    except ValueError as error:  # a broken recording, or a frame that does not match its calibration
        raise InputError(str(error)) from None
    if not done:
        raise InputError(f"{folder / RANGES_FILE}: holds no ranges")
    if not any(camera.faults for camera in done.values()):
        fitted = {**calibrations, **{name: camera.result.calibration for name, camera in done.items()}}
        run_folder.write_json(folder / FITTED_FILE, calibration_document(fitted.values()))
    note_seconds(folder, "calibrate", started)
    return done


def _truth(folder: Path) -> list[SourceTruth]:
    """Return the truth about the sources themselves; a ghost is not what one ranges to."""
    path = folder / run_folder.TRUTH
    if not path.is_file():
        return []
    return [row for row in parse_lines(path, parse_truth) if row.ghost_of is None]


def _true_ranges(folder: Path, truth: list[SourceTruth]) -> dict[tuple[str, int], float]:
    ranges_m: dict[tuple[str, int], float] = {}
    for row in truth:
        if (row.camera, row.index) in ranges_m:
            raise InputError(
                f"{folder}: frame {row.index} of {row.camera!r} has more than one source in view; "
                f"calibrate on a rail with one source, or write the range that counts into {RANGES_FILE}"
            )
        if not row.range_m > 0.0:
            raise InputError(f"{folder / run_folder.TRUTH}: range_m of frame {row.index} is {row.range_m!r}")
        ranges_m[row.camera, row.index] = row.range_m
    return ranges_m


def _true_constant(folder: Path, camera: str, truth: list[SourceTruth]) -> float | None:
    """Return the constant that a rendered run's scene has; None for other recordings."""
    seen = {f"{row.robot}.{row.source}" for row in truth if row.camera == camera}
    if len(seen) != 1 or not (folder / run_folder.SCENE).is_file():
        return None
    scene = load_scene(folder / run_folder.SCENE)
    name = seen.pop()
    if name not in scene.sources():
        raise InputError(
            f"{folder / run_folder.TRUTH}: speaks of a source {name!r} that scene.yaml does not have"
        )
    _, source = scene.sources()[name]
    return range_constant(scene.camera(camera)[1], source)


def _numbers(held_out: HeldOut) -> Mapping[str, float | None]:
    return {
        "found": held_out.found,
        "range_mae_m": _or_none(held_out.range_mae_m),
        "range_rmse_m": _or_none(held_out.range_rmse_m),
        "range_bias_m": _or_none(held_out.range_bias_m),
        "reduced_chi2": _or_none(held_out.reduced_chi2),
    }


def _or_none(value: float | None) -> float | None:
    """Return a number, or None for what JSON cannot hold."""
    return value if value is not None and math.isfinite(value) else None
