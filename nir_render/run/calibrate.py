"""The stage `calibrate`, from folder to folder: frames become the calibration that they tell."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds, parse_lines
from nir_render.run.perceive import unknown_camera
from nir_render.run.render import Progress
from nir_render.scene.load import load_scene
from nir_render.simulation.calibration import range_constant
from nir_render.simulation.flare_spread import flare_spread, share_found
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import (
    CalibratedCamera,
    Calibration,
    CalibrationFrames,
    RailCalibration,
    Recording,
    calibrate_camera,
    calibration_document,
    detect_frames,
    encode_ranges,
    frame_sets,
    read_ranges,
    read_recording,
)
from perception.calibration.camera import as_calibrated
from perception.calibration.result import IDEAL_MAE, HeldOut, faults
from perception.extrinsics.calibrate import Extrinsics, FrameSet, calibrate_extrinsics
from perception.files.offsets import encode_offsets
from perception.files.ranges import RANGES_FILE
from perception.rig.frame_sets import robot_of

FITTED_FILE = "calibration.fitted.json"
PAGE = "calibration.html"
_OFFSETS = "calibration.fitted.{}.offsets.png"
_NO_RAIL = ("dark", "flat", "shared")


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What was known of a camera, what was learned, what speaks against it, and K of rendered frames."""

    before: Calibration
    result: CalibratedCamera
    faults: tuple[str, ...]
    true_range_constant_dn_m2_per_s: float | None

    @property
    def fitted_to_true(self) -> float | None:
        """Relative error of the fitted constant of the flux."""
        if self.true_range_constant_dn_m2_per_s is None or self.result.rail is None:
            return None
        found = self.result.rail.fit.range_constant_dn_m2_per_s
        return found / self.true_range_constant_dn_m2_per_s - 1.0

    @property
    def kept(self) -> tuple[str, ...]:
        """What stayed as it was, and which frames would tell it, a sentence each."""
        result = self.result
        missing = {
            "dark": ("black level, read noise and offsets of pixels", "with the cap on", result.dark),
            "flat": ("the response over the field", "of an even surface that fills the field", result.flat),
            "rail": ("range constants, point spread and glare", "at known ranges", result.rail),
        }
        return tuple(
            f"{what} stay as they were: no frame is of kind {kind} (taken {how})"
            for kind, (what, how, told) in missing.items()
            if told is None
        )

    def record(self) -> dict[str, Any]:
        """Return the numbers, as JSON has them."""
        rail = {} if self.result.rail is None else self._rail_record(self.result.rail)
        learned = {
            name: {"value": _or_none(value), "sigma": _or_none(sigma), "before": _or_none(before)}
            for name, value, sigma, before in self.learned()
        }
        return {**rail, "learned": learned, "kept": list(self.kept), "faults": list(self.faults)}

    def learned(self) -> list[tuple[str, float, float, float]]:
        """Return what was learned beside K: name, value, σ, and what it was before."""
        known = self.result.calibration
        rows: list[tuple[str, float, float, float]] = []
        names: list[str] = []
        if self.result.dark is not None:
            names += ["black_level_dn", "read_noise_e"]
        if self.result.point_spread is not None:
            names += ["psf_sigma_px", "glare_share"]
            if self.result.point_spread.has_glare:
                names += ["glare_radius_px", "glare_exponent"]
        if self.result.flat is not None:
            names += ["prnu"]
        rows += [
            (name, getattr(known, name), known.sigma.get(name, 0.0), getattr(self.before, name))
            for name in names
        ]
        if (dark := self.result.dark) is not None:
            rows.append(("dsnu_e", dark.dsnu_e, dark.dsnu_sigma_e, self.before.dsnu_e))
            rows.append(("dsnu_e, offsets off", known.dsnu_e, 0.0, self.before.dsnu_e))
        if (flat := self.result.flat) is not None:
            was = np.interp(flat.angle_rad, self.before.response_angle_rad, self.before.response_relative)
            at = len(flat.angle_rad) - 2  # the last but one is the frame's corner
            for label, index in (("half way", at // 2), ("in the corner", at)):
                row = (float(flat.response[index]), float(flat.response_sigma[index]), float(was[index]))
                rows.append((f"response {label}", *row))
        return rows

    def _rail_record(self, result: RailCalibration) -> dict[str, Any]:
        fit, paper = result.fit, result.paper
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
            "share_spread": result.share_spread,
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
        }


@dataclass(frozen=True, eq=False)
class RunCalibration:
    """What a folder's frames told: of cameras by themselves, and, by robot, of how its cameras stand."""

    cameras: Mapping[str, CameraCalibration]
    rigs: Mapping[str, Extrinsics]

    @property
    def faults(self) -> list[str]:
        """What speaks against it, a sentence each that names what it is of."""
        of_cameras = [f"{name}: {fault}" for name, one in self.cameras.items() for fault in one.faults]
        return of_cameras + [f"{name}: {fault}" for name, one in self.rigs.items() for fault in one.faults]


def calibrate_run(folder: Path, progress: Progress) -> RunCalibration:
    """Calibrate the cameras of a folder, each by itself, then how they stand to each other.

    What a frame is of says its `kind`: darkness, an even surface, a source at a known range, sources that two
    cameras share. Known ranges stand in `ranges.csv`; where a rendered run has none, it is written from the
    truth. Where nothing speaks against the result, `calibration.fitted.json` is written: the calibration with
    what was learned. Otherwise there is none, also none of an earlier call. `calibration.html` shows either.

    Raises
    ------
    InputError
        The folder is no recording, there is nothing to learn from, or frames do not tell what they are for.
    """
    started = time.perf_counter()
    for old in (folder / FITTED_FILE, folder / PAGE, *folder.glob(_OFFSETS.format("*"))):
        old.unlink(missing_ok=True)
    try:
        recording = read_recording(folder)
        taken = _as_taken(recording)
        truth = _truth(recording)
        frames = _frames(taken, truth)
        done = {}
        for camera, of_camera in frames.items():
            result = calibrate_camera(of_camera, recording.calibrations[camera], progress)
            speaks = () if result.rail is None else tuple(faults(result.rail))
            true_constant = _true_constant(folder, camera, truth, result.calibration.psf_sigma_px)
            done[camera] = CameraCalibration(recording.calibrations[camera], result, speaks, true_constant)
        learned = {name: camera.result.calibration for name, camera in done.items()}
        known = {**recording.calibrations, **learned}
        rigs = _rigs(taken, recording.calibrations, known, progress)
    except InputError:
        raise
    except ValueError as error:  # a broken recording, or a frame that does not match its calibration
        raise InputError(str(error)) from None
    told = RunCalibration(done, rigs)
    if not told.faults:
        for rig in rigs.values():
            known |= {pose.camera: rig.calibrations[pose.camera] for pose in rig.poses}
        known |= {name: _with_offsets(folder, known[name]) for name, one in done.items() if one.result.dark}
        run_folder.write_json(folder / FITTED_FILE, calibration_document(known.values()))
    _write_page(folder, told)
    note_seconds(folder, "calibrate", started)
    return told


def _write_page(folder: Path, told: RunCalibration) -> None:
    from nir_render.report.calibration.page import LearnedCamera, calibration_html

    page = calibration_html(
        cameras={
            LearnedCamera(name, one.before, one.result, one.kept): one.learned()
            for name, one in told.cameras.items()
        },
        rigs=told.rigs,
        faults=told.faults,
        folder_name=folder.resolve().name,
        files=run_folder.files_beside(folder / PAGE),
    )
    run_folder.write_file(folder / PAGE, page.encode())


def _rigs(
    taken: Recording,
    before: Mapping[str, Calibration],
    known: Mapping[str, Calibration],
    progress: Progress,
) -> dict[str, Extrinsics]:
    """Return how the cameras of each robot stand that has frames of shared sources."""
    shared = [record for record in taken.records if record.kind == "shared"]
    sets: dict[str, list[FrameSet]] = {}
    done = 0
    for group in frame_sets(shared):
        frames = [
            as_calibrated(taken.frame(record), before[record.camera], known[record.camera])
            for record in group
        ]
        of_robot = sets.setdefault(robot_of(group[0].camera), [])
        of_robot.append((group, detect_frames(frames, known)))
        progress(done := done + len(group), len(shared))
    return {
        robot: calibrate_extrinsics(
            own, {name: one for name, one in known.items() if robot_of(name) == robot}
        )
        for robot, own in sets.items()
    }


def _as_taken(recording: Recording) -> Recording:
    """Return a recording that leaves the pixels' offsets in its frames: they are learned anew."""
    plain = {
        name: replace(known, offset_dn=None, offset_file="") for name, known in recording.calibrations.items()
    }
    return replace(recording, calibrations=plain)


def _with_offsets(folder: Path, calibration: Calibration) -> Calibration:
    """Write the pixels' offsets beside the calibration, which then names them."""
    assert calibration.offset_dn is not None
    name = _OFFSETS.format(calibration.camera)
    run_folder.write_file(folder / name, encode_offsets(calibration.offset_dn))
    return replace(calibration, offset_file=name)


def _frames(recording: Recording, truth: list[SourceTruth]) -> dict[str, CalibrationFrames]:
    """Return what each camera has to learn from, of the cameras that have anything.

    Frames labelled `rail` are the rail's, without any all that show sources; each has to have a known range
    where it is labelled so.
    """
    folder = recording.folder
    kinds = {(record.camera, record.index): record.kind for record in recording.records}
    records = {(record.camera, record.index): record for record in recording.records}
    has_others = any(kind in _NO_RAIL for kind in kinds.values())
    has_rail = any(kind == "rail" for kind in kinds.values())
    path = folder / RANGES_FILE
    if not path.is_file() and truth:
        rows = [row for row in truth if kinds[row.camera, row.index] == ("rail" if has_rail else "scene")]
        if rows:
            run_folder.write_file(path, encode_ranges(_true_ranges(folder, rows)).encode())
    ranges_m = read_ranges(folder) if path.is_file() or has_rail or not has_others else {}
    if not ranges_m and not has_others:
        raise InputError(f"{path}: holds no ranges")
    for camera, index in ranges_m:
        if camera not in recording.calibrations:
            raise unknown_camera(folder, camera, recording.calibrations)
        if (camera, index) not in records:
            raise InputError(
                f"{path}: knows the range of frame {index} of {camera!r}, which is not in frames.jsonl"
            )
        if kinds[camera, index] in _NO_RAIL:
            raise InputError(
                f"{path}: knows the range of frame {index} of {camera!r}, which frames.jsonl calls "
                f"{kinds[camera, index]}; correct its `kind`, or take its line out"
            )
    unranged = [key for key, kind in kinds.items() if kind == "rail" and key not in ranges_m]
    if unranged:
        camera, index = unranged[0]
        raise InputError(
            f"{path}: knows no range of frame {index} of {camera!r}, which frames.jsonl calls rail (and of "
            f"{len(unranged) - 1} more); write it, or leave its `kind` out"
        )
    found = {}
    for camera in dict.fromkeys(camera for camera, _ in kinds):
        of_kind = {
            kind: [index for (name, index), its in kinds.items() if (name, its) == (camera, kind)]
            for kind in ("dark", "flat")
        }
        own_m = {index: range_m for (name, index), range_m in ranges_m.items() if name == camera}
        if own_m or any(of_kind.values()):
            found[camera] = CalibrationFrames(
                load=lambda index, camera=camera: recording.frame(records[camera, index]),  # type: ignore[misc]
                dark=of_kind["dark"],
                flat=of_kind["flat"],
                ranges_m=own_m,
            )
    return found


def _truth(recording: Recording) -> list[SourceTruth]:
    """Return the truth about the sources themselves; a ghost is not what one ranges to."""
    path = recording.folder / run_folder.TRUTH
    if not path.is_file():
        return []
    frames = {(record.camera, record.index) for record in recording.of_sources.records}
    rows = [row for row in parse_lines(path, parse_truth) if row.ghost_of is None]
    return [row for row in rows if (row.camera, row.index) in frames]


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


def _true_constant(folder: Path, camera: str, truth: list[SourceTruth], sigma_px: float) -> float | None:
    """Return the constant that a rendered run's scene has for a Gaussian; None for other recordings."""
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
    device = scene.camera(camera)[1]
    of_gaussian = share_found(device, source, sigma_px) / flare_spread(device, source).share
    return range_constant(device, source) * of_gaussian


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
