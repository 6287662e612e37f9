"""The one call from a frame to its flares, by an estimator that the caller names or brings.

One's own is a function in a Python file, `file.py:function`, of one frame or of a set of frames. Whatever
goes wrong in code that somebody is still writing becomes one line that says where.
"""

import dataclasses
import inspect
import math
import operator
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.own_code import error_line, kind_of, load_function
from perception.paper import detect_paper
from perception.robust.detect import detect_robust
from perception.types import Calibration, Detection, Detections, Odometry, RawFrame

Estimator = Callable[[RawFrame, Calibration], Iterable[Detection]]
"""Anything that turns a frame and its calibration into detections."""

ESTIMATORS: dict[str, Estimator] = {"paper": detect_paper, "robust": detect_robust}


def detect(
    frame: RawFrame,
    calibration: Calibration,
    estimator: str | Estimator = "robust",
    *,
    limit_s: float = math.inf,
) -> Detections:
    """Find the flares of one frame.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.
    estimator
        "paper" (the paper's method to the letter), "robust", or a function of frame and calibration.
    limit_s
        After so much time "robust" begins with no further flare: the brightest are measured, and the result
        says that it is `truncated`. Which ones these are then depends on the machine.

    Returns
    -------
    The detections, in the order in which the estimator gives them. Where "robust" finds none, their `reason`
    says why.

    Raises
    ------
    ValueError
        If the estimator's name is not known, frame and calibration do not belong together, or time is
        limited for another estimator than "robust", or to no positive number.

    Examples
    --------
    A camera of 64 × 48 pixels that looks forward, and a frame with a flare of 7000 counts at (41, 23):

    >>> import numpy as np
    >>> calibration = Calibration(
    ...     camera="r1.front", width_px=64, height_px=48, fx_px=60.0, fy_px=60.0, cx_px=31.5, cy_px=23.5,
    ...     rotation_body_camera=np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    ...     position_body_m=np.zeros(3), system_gain_dn_per_e=0.5, read_noise_e=4.0, black_level_dn=64.0,
    ...     saturation_dn=4095, bit_depth=12, psf_sigma_px=0.8, source_radius_m=0.01, wavelength_m=940e-9,
    ...     response_angle_rad=np.array([0.0, 1.0]), response_relative=np.array([1.0, 0.9]),
    ...     range_constant_dn_m2_per_s=1e8, range_constant_paper_dn_m2_per_s=7e6)
    >>> share = np.array([0.03, 0.236, 0.468, 0.236, 0.03])
    >>> counts = np.full((48, 64), 66, dtype=np.uint16)
    >>> counts[21:26, 39:44] += np.rint(7000.0 * np.outer(share, share)).astype(np.uint16)
    >>> frame = RawFrame("r1.front", 0, time_s=0.0, exposure_s=1e-3, data_dn=counts, black_level_dn=64.0)
    >>> (hit,) = detect(frame, calibration)
    >>> f"({hit.u_px:.1f}, {hit.v_px:.1f}) px, {hit.range_m:.2f} ± {hit.range_sigma_m:.2f} m"
    '(41.0, 23.0) px, 3.72 ± 0.02 m'
    >>> (hit,) = detect(frame, calibration, "paper")
    >>> f"({hit.u_px:.1f}, {hit.v_px:.1f}) px, {hit.range_m:.2f} m"
    '(41.0, 23.0) px, 3.72 m'
    """
    if isinstance(estimator, str):
        if estimator not in ESTIMATORS:
            raise ValueError(
                f"unknown estimator {estimator!r}: known are {', '.join(ESTIMATORS)}, or pass a function"
            )
        estimator = ESTIMATORS[estimator]
    if limit_s != math.inf:
        if estimator is not detect_robust:
            raise ValueError("limit_s: only the estimator 'robust' knows a limit of time")
        if not limit_s > 0.0:
            raise ValueError(f"limit_s is {limit_s!r}: wanted a time above 0 s")
        return detect_robust(frame, calibration, limit_s)
    found = estimator(frame, calibration)
    return found if isinstance(found, Detections) else Detections(found)


def detect_frames(
    frames: Sequence[RawFrame],
    calibrations: Mapping[str, Calibration],
    estimator: str | Estimator = "robust",
    *,
    limit_s: float = math.inf,
) -> list[Detections]:
    """Find the flares of several frames, such as those of a robot's cameras, side by side on all cores.

    Parameters
    ----------
    frames
        Raw frames, of one camera or of several.
    calibrations
        Of each camera, by its name.
    estimator
        As for `detect`; one's own is called by several threads at once.
    limit_s
        As for `detect`, of each frame.

    Returns
    -------
    What `detect` finds in each frame, in the order of the frames.

    Raises
    ------
    ValueError
        As for `detect`, or if a frame's camera has no calibration.
    """
    require_calibrations(frames, calibrations)

    def found(frame: RawFrame) -> Detections:
        return detect(frame, calibrations[frame.camera], estimator, limit_s=limit_s)

    if len(frames) < 2:
        return [found(frame) for frame in frames]
    with ThreadPoolExecutor(min(len(frames), cores())) as threads:
        return list(threads.map(found, frames))


def require_calibrations(frames: Sequence[RawFrame], calibrations: Mapping[str, Calibration]) -> None:
    """Raise `ValueError` if the camera of a frame has no calibration."""
    unknown = sorted({frame.camera for frame in frames} - set(calibrations))
    if unknown:
        raise ValueError(
            f"no calibration for {', '.join(unknown)}; there are some for {', '.join(calibrations) or 'none'}"
        )


class EstimatorError(ValueError):
    """An estimator cannot be loaded, or failed on a frame; a command's text ends with its standard error."""


@dataclass(frozen=True)
class OwnEstimator:
    """An estimator of the user's own; calling it checks what comes back.

    `name` is the function's, and names the file of its detections; `reference` is what the user wrote,
    for error texts; `path` is the file that holds it.
    """

    name: str
    reference: str
    path: Path
    function: Callable[[RawFrame, Calibration], Iterable[Detection]]

    def __call__(self, frame: RawFrame, calibration: Calibration) -> list[Detection]:
        """Find the flares of one frame.

        The function gets counts of its own, which it may change. NumPy numbers in its detections become
        plain ones.

        Raises
        ------
        EstimatorError
            If the function raises, or returns anything but detections of this frame.
        """
        where = f"{self.reference}: frame {frame.index} of {frame.camera}"
        copied = dataclasses.replace(frame, data_dn=frame.data_dn.copy())
        found = _listed(lambda: self.function(copied, calibration), self.path, where)
        return [_checked_detection(detection, [frame], where) for detection in found]


@dataclass(frozen=True)
class OwnSetEstimator:
    """One's own function of a set of frames: what the cameras of one robot took at about the same time.

    It is called by the names of its parameters, `frames`, `calibrations` and, if it has it, `odometry`.
    """

    name: str
    reference: str
    path: Path
    function: Callable[..., Iterable[Detection]]

    def __call__(
        self,
        frames: Sequence[RawFrame],
        calibrations: Mapping[str, Calibration],
        odometry: Sequence[Odometry] | None = None,
    ) -> list[Detection]:
        """Find the flares of a set of frames; otherwise as `OwnEstimator`.

        Parameters
        ----------
        frames
            Of one robot, of several cameras or exposures, by time.
        calibrations
            Of each camera, by its name.
        odometry
            What the robot knows of its own motion, by time; None where it knows nothing.

        Raises
        ------
        EstimatorError
            If the function raises, or returns anything but detections of these frames.
        """
        first = frames[0]
        where = f"{self.reference}: set of frame {first.index} of {first.camera}"
        given = {
            "frames": [dataclasses.replace(frame, data_dn=frame.data_dn.copy()) for frame in frames],
            "calibrations": dict(calibrations),
            "odometry": odometry,
        }
        taken = inspect.signature(self.function).parameters
        found = _listed(
            lambda: self.function(**{name: value for name, value in given.items() if name in taken}),
            self.path,
            where,
        )
        return [_checked_detection(detection, frames, where) for detection in found]


def load_estimator(reference: str) -> OwnEstimator | OwnSetEstimator:
    """Load the function that `file.py:function` names.

    The file may import modules that lie beside it. A function with a parameter `frames` wants sets of frames.

    Parameters
    ----------
    reference
        Path of a Python file, a colon, and the name of a function in it that takes a frame and its
        calibration, or `frames`, `calibrations` and `odometry` by these names, and returns detections.

    Returns
    -------
    OwnEstimator, or OwnSetEstimator for a function of sets.

    Raises
    ------
    EstimatorError
        If there is no such file or function, it cannot be called, the file raises while it is imported,
        the function's name cannot name a file of detections, or its parameters are neither kind's.
    """
    name, path, function = load_function(
        reference, "estimator", "my_estimator.py:brightest_blob", ESTIMATORS, EstimatorError
    )
    if _wants_sets(function, reference):
        return OwnSetEstimator(name, reference, path, function)
    return OwnEstimator(name, reference, path, function)


def _wants_sets(function: Callable[..., Any], reference: str) -> bool:
    """Tell a function of sets by the names of its parameters."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # of a compiled function, say
        return False
    if "frames" not in parameters:
        return False
    named = {
        name: one
        for name, one in parameters.items()
        if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD, one.POSITIONAL_ONLY)
    }
    needed = {name for name, one in named.items() if one.default is one.empty} | {"frames", "calibrations"}
    if not needed <= named.keys() or needed - {"frames", "calibrations", "odometry"}:
        raise EstimatorError(
            f"{reference}: takes ({', '.join(parameters)}); wanted (frame, calibration), or for sets of "
            "frames (frames, calibrations, odometry), by these names"
        )
    return True


def _listed(call: Callable[[], Any], path: Path, where: str) -> list[Any]:
    """Return what a user's function gives, as a list; whatever goes wrong becomes an EstimatorError."""
    try:
        # A generator raises only while it is being read.
        found = call()
        listed = list(found) if isinstance(found, Iterable) else None
    except Exception as error:
        raise EstimatorError(f"{where}: {error_line(error, path)}") from error
    if listed is None:
        raise EstimatorError(f"{where}: returned {kind_of(found)}; wanted a list of detections")
    return listed


def _checked_detection(detection: object, frames: Sequence[RawFrame], where: str) -> Detection:
    """Return a detection with plain numbers, or say what about it is wrong."""
    if not isinstance(detection, Detection):
        raise EstimatorError(
            f"{where}: returned {kind_of(detection)} among its detections; wanted a Detection"
        )
    if (detection.camera, detection.index) not in {(frame.camera, frame.index) for frame in frames}:
        raise EstimatorError(
            f"{where}: returned a detection of frame {detection.index} of {detection.camera}; "
            "give it this frame's camera and index"
        )
    fields = {}
    for field in dataclasses.fields(Detection):
        value = getattr(detection, field.name)
        try:
            fields[field.name] = _KINDS[field.type](value) if field.type in _KINDS else value
        except (TypeError, ValueError) as error:
            raise EstimatorError(f"{where}: {field.name} of a detection is {value!r}: {error}") from None
    return Detection(**fields)


def _number(value: Any) -> float:
    number = float(value)
    if math.isinf(number):
        raise ValueError("wanted a finite number, or NaN where there is none")
    return number


def _vector(values: Any) -> tuple[float, float, float]:
    numbers = [_number(value) for value in values]
    if len(numbers) != 3:
        raise ValueError("wanted three numbers")
    if abs(math.hypot(*numbers) - 1.0) > 1e-3:  # NaN, where there is no bearing, passes
        raise ValueError("wanted a vector of length 1, or NaN in all its places")
    return numbers[0], numbers[1], numbers[2]


_KINDS: dict[Any, Callable[[Any], Any]] = {
    float: _number,
    int: operator.index,
    bool: bool,
    tuple[float, float, float]: _vector,
}


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
