"""The contract: what perception reads (`inputs`) and what it says (`outputs`)."""

from perception.types.inputs import Calibration, FrameKey, Odometry, RawFrame
from perception.types.outputs import (
    Detection,
    Detections,
    Ghost,
    Measurement,
    Message,
    MirrorPlane,
    SetMeasurements,
    Signal,
    Track,
    bearing_axes,
)

__all__ = [
    "Calibration",
    "Detection",
    "Detections",
    "FrameKey",
    "Ghost",
    "Measurement",
    "Message",
    "MirrorPlane",
    "Odometry",
    "RawFrame",
    "SetMeasurements",
    "Signal",
    "Track",
    "bearing_axes",
]
