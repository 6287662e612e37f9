"""The stack that reads raw near-infrared frames: flares, their bearings and their ranges.

It needs a frame and a calibration and nothing else, and runs unchanged on a robot::

    frames = perception.read_frames("recording")
    calibrations = perception.read_calibrations("recording")
    for frame in frames:
        hits = perception.detect(frame, calibrations[frame.camera])          # or estimator="paper"

An estimator is named, or is any function of frame and calibration; `detect` shows a whole example.

>>> import perception
>>> sorted(perception.ESTIMATORS)
['paper', 'robust']

The way of the data, room by room: `files` (what touches disk) → `estimators` (the one call, and one's own) →
`paper` (the paper's method to the letter) or `robust` (prepare → blobs → measure → detect) → detections →
`rig` (of all cameras of a robot: every source once, mirror images told from robots) → measurements. Both
stand on `model`: lens, bearing, sensor, ranging, the image of a flare, and in `fisher` how well any estimator
could do. `calibration` finds the constants from frames at known ranges. `types` is the contract.
"""

from perception.calibration.camera import CalibratedCamera, CalibrationFrames, calibrate_camera
from perception.calibration.dark import DarkCalibration, calibrate_dark
from perception.calibration.flat import FlatCalibration, calibrate_flat
from perception.calibration.rail import calibrate_rail
from perception.calibration.range_constant import (
    RangeConstantFit,
    regress_range_constant,
)
from perception.calibration.result import RailCalibration
from perception.calibration.spread import PointSpreadCalibration, calibrate_point_spread
from perception.command_estimator import CommandEstimator, CommandProcess, load_command
from perception.estimators import (
    ESTIMATORS,
    Estimator,
    EstimatorError,
    OwnEstimator,
    OwnSetEstimator,
    detect,
    detect_frames,
    load_estimator,
)
from perception.files.calibration import calibration_document, parse_calibration_document
from perception.files.detections import detection_record, parse_detection
from perception.files.fields import RecordingError
from perception.files.measurements import (
    measurement_record,
    mirror_record,
    parse_measurement,
    parse_mirror,
    parse_robot,
    robot_record,
)
from perception.files.pictures import Picture, encode_png16, read_picture
from perception.files.ranges import encode_ranges, read_ranges
from perception.files.recording import (
    FrameRecord,
    Recording,
    frame_record,
    parse_frame_record,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_frames,
    read_recording,
)
from perception.files.tracks import (
    message_record,
    odometry_record,
    parse_message,
    parse_odometry,
    parse_signal,
    parse_track,
    read_odometry,
    signal_record,
    track_record,
)
from perception.model.fisher import FlareLimit, flare_limit, flare_limits
from perception.paper import PaperRegression, regress_paper_range_constant
from perception.pipeline import Heard, Pipeline
from perception.processes.detectors import DetectorProcesses
from perception.rig.frame_sets import frame_sets
from perception.rig.measure_set import detect_set, measure_set
from perception.track.tracker import Tracker
from perception.types import (
    Calibration,
    Detection,
    Detections,
    ForwardLight,
    Layout,
    Measurement,
    Message,
    MirrorPlane,
    Odometry,
    PoseHypothesis,
    RawFrame,
    RobotPose,
    SetMeasurements,
    Signal,
    Track,
)
from perception.warm_up import warm_up

__all__ = [
    "ESTIMATORS",
    "CalibratedCamera",
    "Calibration",
    "CalibrationFrames",
    "CommandEstimator",
    "CommandProcess",
    "DarkCalibration",
    "Detection",
    "Detections",
    "DetectorProcesses",
    "Estimator",
    "EstimatorError",
    "FlareLimit",
    "FlatCalibration",
    "ForwardLight",
    "FrameRecord",
    "Heard",
    "Layout",
    "Measurement",
    "Message",
    "MirrorPlane",
    "Odometry",
    "OwnEstimator",
    "OwnSetEstimator",
    "PaperRegression",
    "Picture",
    "Pipeline",
    "PointSpreadCalibration",
    "PoseHypothesis",
    "RailCalibration",
    "RangeConstantFit",
    "RawFrame",
    "Recording",
    "RecordingError",
    "RobotPose",
    "SetMeasurements",
    "Signal",
    "Track",
    "Tracker",
    "calibrate_camera",
    "calibrate_dark",
    "calibrate_flat",
    "calibrate_point_spread",
    "calibrate_rail",
    "calibration_document",
    "detect",
    "detect_frames",
    "detect_set",
    "detection_record",
    "encode_png16",
    "encode_ranges",
    "flare_limit",
    "flare_limits",
    "frame_record",
    "frame_sets",
    "load_command",
    "load_estimator",
    "measure_set",
    "measurement_record",
    "message_record",
    "mirror_record",
    "odometry_record",
    "parse_calibration_document",
    "parse_detection",
    "parse_frame_record",
    "parse_measurement",
    "parse_message",
    "parse_mirror",
    "parse_odometry",
    "parse_robot",
    "parse_signal",
    "parse_track",
    "read_calibrations",
    "read_frame",
    "read_frame_records",
    "read_frames",
    "read_odometry",
    "read_picture",
    "read_ranges",
    "read_recording",
    "regress_paper_range_constant",
    "regress_range_constant",
    "robot_record",
    "signal_record",
    "track_record",
    "warm_up",
]
