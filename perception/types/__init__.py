"""The contract: what perception reads (`inputs`) and what it says (`outputs`)."""

from perception.types.inputs import Calibration, ForwardLight, FrameKey, Layout, Odometry, RawFrame
from perception.types.outputs import (
    Detection,
    Detections,
    Ghost,
    Measurement,
    Message,
    MirrorPlane,
    PoseHypothesis,
    RobotPose,
    SetMeasurements,
    Signal,
    Track,
    bearing_axes,
)

__all__ = [
    "Calibration",
    "Detection",
    "Detections",
    "ForwardLight",
    "FrameKey",
    "Ghost",
    "Layout",
    "Measurement",
    "Message",
    "MirrorPlane",
    "Odometry",
    "PoseHypothesis",
    "RawFrame",
    "RobotPose",
    "SetMeasurements",
    "Signal",
    "Track",
    "bearing_axes",
]
