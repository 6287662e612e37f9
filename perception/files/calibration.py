"""`calibration.json`: all that perception may know about the cameras of a recording.

{"format": 1, "cameras": {name: {...}}}. Fields are named as in `Calibration`, but for the pose, which stands
as `quaternion_body_camera_xyzw` and `position_body_m`. An entry whose standard deviation is known is written
as {"value": v, "sigma": s}; that of the quaternion is an angle in radians. `lens_model` and `distortion` may
be missing: the lens is then rectilinear; `dsnu_e` and `prnu` too: they are then 0; `own_sources_body_m` too.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import (
    Place,
    Reader,
    check_format,
    get,
    integer,
    not_negative,
    number,
    number_or_nan,
    numbers,
    positive,
)
from perception.model.lens import COEFFICIENTS
from perception.types import Calibration

_WHOLE = ("width_px", "height_px", "saturation_dn", "bit_depth")
_POSITIVE = ("fx_px", "fy_px", "system_gain_dn_per_e", "psf_sigma_px", "wavelength_m")
_REAL = (
    "cx_px",
    "cy_px",
    "read_noise_e",
    "black_level_dn",
    "range_constant_dn_m2_per_s",
    "range_constant_paper_dn_m2_per_s",
    "source_radius_m",
)
_FIXED_PATTERN = ("dsnu_e", "prnu")
_QUATERNION = "quaternion_body_camera_xyzw"
_READERS: dict[str, Reader] = {
    **dict.fromkeys(_WHOLE, integer),
    **dict.fromkeys(_POSITIVE, positive),
    **dict.fromkeys(_REAL, number),
    **dict.fromkeys((*_FIXED_PATTERN, "read_noise_e", "source_radius_m"), not_negative),
    "range_constant_paper_dn_m2_per_s": number_or_nan,
}
_NUMBERS = (*_WHOLE, *_POSITIVE, *_REAL, *_FIXED_PATTERN)
_LISTS = (
    _QUATERNION,
    "position_body_m",
    "response_angle_rad",
    "response_relative",
    "distortion",
    "own_sources_body_m",
)


def calibration_document(calibrations: Iterable[Calibration]) -> dict[str, Any]:
    """Make the content of `calibration.json`.

    Parameters
    ----------
    calibrations
        One per camera.

    Returns
    -------
    A JSON object. Parsed again, it gives the same calibrations: numbers bit by bit, the rotation to within
    rounding (it passes through a quaternion).

    Raises
    ------
    ValueError
        If two have the same camera, a sigma names no entry, or a rotation is none.
    """
    cameras: dict[str, Any] = {}
    for calibration in calibrations:
        if calibration.camera in cameras:
            raise ValueError(f"two calibrations of camera {calibration.camera!r}")
        cameras[calibration.camera] = _camera_record(calibration)
    return {"format": 1, "cameras": cameras}


def _camera_record(calibration: Calibration) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    matrix = np.asarray(calibration.rotation_body_camera, dtype=np.float64)
    if matrix.shape != (3, 3) or not (
        np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) and np.linalg.det(matrix) > 0.0
    ):
        raise ValueError(f"rotation_body_camera of {calibration.camera!r} is no rotation matrix")
    record: dict[str, Any] = {name: getattr(calibration, name) for name in _NUMBERS}
    if math.isnan(calibration.range_constant_paper_dn_m2_per_s):
        record["range_constant_paper_dn_m2_per_s"] = None  # its detector found too little to calibrate with
    record[_QUATERNION] = Rotation.from_matrix(matrix).as_quat(canonical=True).tolist()
    for name in ("position_body_m", "response_angle_rad", "response_relative", "own_sources_body_m"):
        record[name] = np.asarray(getattr(calibration, name), dtype=np.float64).tolist()
    record["lens_model"] = calibration.lens_model
    record["distortion"] = [float(number) for number in calibration.distortion]
    for field, sigma in calibration.sigma.items():
        name = _QUATERNION if field == "rotation_body_camera" else field
        if name not in record:
            raise ValueError(f"sigma of {field!r}, which is no entry of a calibration")
        record[name] = {"value": record[name], "sigma": float(sigma)}
    return record


def parse_calibration_document(
    document: Mapping[str, Any], file: str = "calibration.json"
) -> dict[str, Calibration]:
    """Read the content of `calibration.json`.

    Parameters
    ----------
    document
        The JSON object.
    file
        Its name, for error texts.

    Returns
    -------
    Calibrations by the camera's name.

    Raises
    ------
    RecordingError
        If a field is missing, of the wrong type, or contradicts another.
    """
    place = Place(file)
    check_format(document, place)
    cameras = get(document, "cameras", place)
    if not isinstance(cameras, dict):
        raise place.error(f"is {cameras!r}", "Write an object of cameras by name", "cameras")
    return {name: _calibration(name, cameras[name], place.within(f"cameras.{name}")) for name in cameras}


def _calibration(name: str, record: Any, place: Place) -> Calibration:
    from scipy.spatial.transform import Rotation

    if not isinstance(record, dict):
        raise place.error(f"is {record!r}", "Write an object with the entries of one camera")
    values, sigma = _split_sigmas(record, place)
    quaternion = np.array(numbers(values, _QUATERNION, place, 4))
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-6:
        raise place.error(f"has length {length:.9g}", "Write a unit quaternion x, y, z, w", _QUATERNION)
    angles = np.array(numbers(values, "response_angle_rad", place))
    if angles[0] != 0.0 or np.any(np.diff(angles) <= 0.0):
        raise place.error("does not increase from 0", "Sort the angles, the first is 0", "response_angle_rad")
    response = np.array(numbers(values, "response_relative", place, len(angles)))
    values = {**dict.fromkeys(_FIXED_PATTERN, 0.0), **values}
    lens_model, distortion = _lens(values, place)
    return Calibration(
        camera=name,
        rotation_body_camera=Rotation.from_quat(quaternion).as_matrix(),
        position_body_m=np.array(numbers(values, "position_body_m", place, 3)),
        response_angle_rad=angles,
        response_relative=response,
        own_sources_body_m=_own_sources(values, place),
        sigma=sigma,
        lens_model=lens_model,
        distortion=distortion,
        **{field: _READERS[field](values, field, place) for field in _NUMBERS},
    )


def _own_sources(values: Mapping[str, Any], place: Place) -> NDArray[np.float64]:
    """Return where the robot's own sources sit; without, none."""
    rows = values.get("own_sources_body_m", [])
    if not isinstance(rows, list):
        raise place.error(f"is {rows!r}", "Write a list of [x, y, z], in metres", "own_sources_body_m")
    parts = {f"own_sources_body_m[{i}]": row for i, row in enumerate(rows)}
    return np.array([numbers(parts, name, place, 3) for name in parts]).reshape(-1, 3)


def _lens(values: Mapping[str, Any], place: Place) -> tuple[str, tuple[float, ...]]:
    """Return lens model and coefficients; without, rectilinear."""
    model = values.get("lens_model", "rectilinear")
    if model not in COEFFICIENTS:
        raise place.error(f"is {model!r}", f"Known are {', '.join(COEFFICIENTS)}", "lens_model")
    distortion = values.get("distortion", [])
    if not isinstance(distortion, list) or len(distortion) not in COEFFICIENTS[model]:
        wanted = " or ".join(str(count) for count in COEFFICIENTS[model])
        problem = f"is {distortion!r}"
        raise place.error(problem, f"A {model} lens takes {wanted} numbers in OpenCV's order", "distortion")
    return model, tuple(numbers(values, "distortion", place)) if distortion else ()


def _split_sigmas(record: Mapping[str, Any], place: Place) -> tuple[dict[str, Any], dict[str, float]]:
    """Take {"value": v, "sigma": s} apart."""
    values, sigma = dict(record), {}
    for name in (*_NUMBERS, *_LISTS):
        entry = record.get(name)
        if not isinstance(entry, dict):
            continue
        values[name] = get(entry, "value", place.within(name))
        field = "rotation_body_camera" if name == _QUATERNION else name
        sigma[field] = not_negative(entry, "sigma", place.within(name))
    return values, sigma
