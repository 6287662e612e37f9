"""All that frames of darkness, of an even surface and of a rail tell of one camera, each from the last."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from perception.calibration.dark import DarkCalibration, calibrate_dark
from perception.calibration.flat import FlatCalibration, calibrate_flat
from perception.calibration.rail import Progress, calibrate_rail
from perception.calibration.result import RailCalibration
from perception.calibration.spread import PointSpreadCalibration, calibrate_point_spread
from perception.calibration.veil import Glare
from perception.files.fields import RecordingError
from perception.model.sensor import without_offsets, without_response
from perception.types import Calibration, RawFrame


@dataclass(frozen=True, eq=False)
class CalibrationFrames:
    """The frames of one camera by what they were taken of: indices, the known ranges, and what reads one.

    They are read as the sensor gave them: offsets that were known before are not off.
    """

    load: Callable[[int], RawFrame]
    dark: Sequence[int] = ()
    flat: Sequence[int] = ()
    ranges_m: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A calibration with all that was learned, and what each kind of frame told, or None."""

    calibration: Calibration
    dark: DarkCalibration | None
    flat: FlatCalibration | None
    point_spread: PointSpreadCalibration | None
    rail: RailCalibration | None


def calibrate_camera(
    frames: CalibrationFrames, calibration: Calibration, progress: Progress = lambda _done, _total: None
) -> CalibratedCamera:
    """Learn a camera from its own frames.

    Dark frames give black level, read noise and the pixels' offsets; with these the rail gives point spread
    and glare; with these flat frames give the response over the field; with all of it the rail gives the
    range constants. What no frames tell of stays as it was.

    Parameters
    ----------
    frames
        What was taken.
    calibration
        Of the camera: geometry, gain and sources are taken from it; all else is a first guess.
    progress
        Told of each pass over frames how far it is.

    Raises
    ------
    RecordingError
        There is none of the three kinds, or one of them does not tell what it is for.
    """
    if not (frames.dark or frames.flat or frames.ranges_m):
        raise RecordingError(
            f"{calibration.camera}: no frame to calibrate from; label some in frames.jsonl with `kind`: "
            "dark, flat or rail, and write the ranges of rail frames into ranges.csv"
        )
    dark = flat = spread = rail = None
    known = calibration
    if frames.dark:
        plain = replace(calibration, offset_dn=None, offset_file="")
        dark = calibrate_dark(map(frames.load, frames.dark), plain)
        known = dark.calibration

    def load(index: int) -> RawFrame:
        return as_calibrated(frames.load(index), calibration, known)

    if frames.ranges_m:
        if frames.flat:  # how unlike pixels are is the same without glare taken off, and counts in the rail
            known = replace(known, prnu=calibrate_flat(map(load, frames.flat), known).prnu)
        spread = calibrate_point_spread(frames.ranges_m, load, known, progress)
        known = spread.calibration
    if frames.flat:
        flat = calibrate_flat(map(load, frames.flat), known, glare=_glare(known, spread))
        known = flat.calibration
    if frames.ranges_m:
        even = known if flat is None else replace(known, prnu=flat.unknown_prnu)

        def load_even(index: int) -> RawFrame:
            frame = load(index)
            return frame if flat is None else without_response(frame, known, flat.pixel_response)

        axis_sigma = 0.0 if flat is None else flat.axis_sigma
        rail = calibrate_rail(frames.ranges_m, load_even, even, progress, axis_sigma)
        rail = replace(rail, calibration=replace(rail.calibration, prnu=known.prnu))
        known = rail.calibration
    return CalibratedCamera(known, dark, flat, spread, rail)


def as_calibrated(frame: RawFrame, before: Calibration, now: Calibration) -> RawFrame:
    """Return a frame as taken, as a later calibration has it: its black level moved, known offsets off."""
    moved_dn = now.black_level_dn - before.black_level_dn
    return without_offsets(replace(frame, black_level_dn=frame.black_level_dn + moved_dn), now)


def _glare(known: Calibration, spread: PointSpreadCalibration | None) -> Glare | None:
    if not known.glare_share > 0.0:
        return None
    covariance = np.zeros((3, 3)) if spread is None else spread.glare_covariance
    return Glare(known.glare_share, known.glare_radius_px, known.glare_exponent, covariance)
