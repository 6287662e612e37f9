"""The stack that reads raw near-infrared frames: flares, their bearings and their ranges.

    frames = perception.read_frames("recording")
    calibrations = perception.read_calibrations("recording")
    for frame in frames:
        hits = perception.detect(frame, calibrations[frame.camera])          # or estimator="paper"

It needs a frame and a calibration and nothing else, and runs unchanged on a robot. The way of the data:
`recording` → `detection` (`preparation` → `blobs` → `measurement`) → detections. `limits` says how well any
estimator could do.
"""

from perception.calibrate import (
    PaperRegression,
    RangeConstantFit,
    regress_paper_range_constant,
    regress_range_constant,
)
from perception.calibration_file import calibration_document, parse_calibration_document
from perception.detection_file import detection_record, parse_detection
from perception.json_fields import RecordingError
from perception.limits import FlareLimit, flare_limit
from perception.own_estimator import EstimatorError, OwnEstimator, load_estimator
from perception.pipeline import ESTIMATORS, Estimator, detect
from perception.rail import calibrate_rail
from perception.rail_result import RailCalibration
from perception.ranges_file import encode_ranges, read_ranges
from perception.recording import (
    FrameRecord,
    encode_png16,
    frame_record,
    parse_frame_record,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_frames,
)
from perception.types import Calibration, Detection, RawFrame

__all__ = [
    "ESTIMATORS",
    "Calibration",
    "Detection",
    "Estimator",
    "EstimatorError",
    "FlareLimit",
    "FrameRecord",
    "OwnEstimator",
    "PaperRegression",
    "RailCalibration",
    "RangeConstantFit",
    "RawFrame",
    "RecordingError",
    "calibrate_rail",
    "calibration_document",
    "detect",
    "detection_record",
    "encode_png16",
    "encode_ranges",
    "flare_limit",
    "frame_record",
    "load_estimator",
    "parse_calibration_document",
    "parse_detection",
    "parse_frame_record",
    "read_calibrations",
    "read_frame",
    "read_frame_records",
    "read_frames",
    "read_ranges",
    "regress_paper_range_constant",
    "regress_range_constant",
]
