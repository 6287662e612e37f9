"""The one call from a frame to its flares, by an estimator that the caller names or brings."""

from collections.abc import Callable, Iterable

from perception.detection import detect_paper, detect_robust
from perception.types import Calibration, Detection, RawFrame

Estimator = Callable[[RawFrame, Calibration], Iterable[Detection]]
"""Anything that turns a frame and its calibration into detections."""

ESTIMATORS: dict[str, Estimator] = {"paper": detect_paper, "robust": detect_robust}


def detect(
    frame: RawFrame, calibration: Calibration, estimator: str | Estimator = "robust"
) -> list[Detection]:
    """Find the flares of one frame.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.
    estimator
        "paper" (the paper's method to the letter), "robust", or a function of frame and calibration.

    Returns
    -------
    The detections, in the order in which the estimator gives them.

    Raises
    ------
    ValueError
        If the estimator's name is not known, or frame and calibration do not belong together.
    """
    if isinstance(estimator, str):
        if estimator not in ESTIMATORS:
            raise ValueError(
                f"unknown estimator {estimator!r}: known are {', '.join(ESTIMATORS)}, or pass a function"
            )
        estimator = ESTIMATORS[estimator]
    return list(estimator(frame, calibration))
