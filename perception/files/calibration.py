"""`calibration.json`: all that perception may know about the cameras of a recording.

{"format": 1, "cameras": {name: {...}}}. Fields are named as in `Calibration`, but for the pose, which stands
as `quaternion_body_camera_xyzw` and `position_body_m`. An entry whose standard deviation is known is written
as {"value": v, "sigma": s}; that of the quaternion is an angle in radians. `lens_model` and `distortion` may
be missing: the lens is then rectilinear; `dsnu_e`, `prnu`, `extinction_per_m` and
`hidden_background` too: they are then 0; `own_sources_body_m` and `layouts` too: they are then empty.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np

from perception.files.entries import Entry, check_names, read_entries, read_entry
from perception.files.fields import Faults, Place, RecordingError, check_format, get, shown
from perception.files.readers import plain
from perception.model.lens import COEFFICIENTS
from perception.types import Calibration, ForwardLight, Layout

_QUATERNION = "quaternion_body_camera_xyzw"
_MOST_DN = 65535.0
_MOST_E = 1e6
_MOST_CONSTANT = 1e30

LAYOUT_ENTRIES = (
    Entry("kind", "text", "the name of such robots"),
    Entry("places_body_m", "places", "the sources' centres, in the robot's own body axes", -1e3, 1e3),
    Entry(
        "relative_flux", "list", "flux of each, over that which the range constant is of", 1e-6, 1e6
    ),
    Entry(
        "flux_sigma_common", "number", "relative σ of these fluxes, of all sources of a robot together",
        0.0, 10.0, null="as the range constant has it", default=math.nan,
    ),
    Entry(
        "flux_sigma_own", "number", "relative σ of the flux of each source by itself", 0.0, 10.0, default=0.0
    ),
)  # fmt: skip
"""The fields of a layout among `layouts`."""

FORWARD_ENTRIES = (
    Entry("depth", "number", "optical depth of the way from a source", 0.0, 100.0, above=True),
    Entry("angle_rad", "list", "angles off the source, increasing, above 0", 0.0, 3.2),
    Entry("share", "list", "light that fog scatters forward within each, over what comes straight", 0.0, 1e6),
    Entry("share_sigma", "number", "relative σ of all shares together", 0.0, 10.0, default=0.0),
    Entry(
        "deviations",
        "list",
        "shares of each kind that the fog may be of less `share`, kind after kind; none where it is of one",
        -1e6,
        1e6,
        default=(),
    ),
)
"""The fields of one optical depth among `forward_light`."""

CALIBRATION_ENTRIES = (
    Entry("width_px", "whole", "columns of a frame", 1, 65535, sigma=True),
    Entry("height_px", "whole", "rows of a frame", 1, 65535, sigma=True),
    Entry("saturation_dn", "whole", "a pixel at or above this count is clipped", 1, _MOST_DN, sigma=True),
    Entry("bit_depth", "whole", "bits of a count: full scale is 2^bit_depth − 1", 1, 16, sigma=True),
    Entry("fx_px", "number", "focal length in columns", 1e-3, 1e6, above=True, sigma=True),
    Entry("fy_px", "number", "focal length in rows", 1e-3, 1e6, above=True, sigma=True),
    Entry(
        "system_gain_dn_per_e", "number", "counts per electron", 1e-9, _MOST_E, above=True, sigma=True
    ),
    Entry(
        "psf_sigma_px", "number", "σ of the Gaussian point spread, without the pixel's own aperture",
        1e-3, 1e3, sigma=True,
    ),
    Entry("wavelength_m", "number", "centre wavelength", 1e-7, 1e-4, sigma=True),
    Entry("cx_px", "number", "column of the optical axis", -1e5, 1e5, sigma=True),
    Entry("cy_px", "number", "row of the optical axis", -1e5, 1e5, sigma=True),
    Entry("read_noise_e", "number", "σ of a dark pixel from frame to frame", 0.0, _MOST_E, sigma=True),
    Entry("black_level_dn", "number", "mean count of a dark pixel", -_MOST_DN, _MOST_DN, sigma=True),
    Entry(
        "range_constant_dn_m2_per_s", "number",
        "K of flux_dn = K · exposure · cos θ · response(θ) / range²", 1e-9, _MOST_CONSTANT,
        above=True, sigma=True,
    ),
    Entry(
        "range_constant_paper_dn_m2_per_s", "number", "K of the paper's mean grey value, its eq. 1",
        -_MOST_CONSTANT, _MOST_CONSTANT, null="it is not known", default=math.nan, sigma=True,
    ),
    Entry("source_radius_m", "number", "radius of a source, a sphere", 0.0, 1e3, sigma=True),
    Entry("dsnu_e", "number", "σ of the pixels' fixed offsets", 0.0, _MOST_E, default=0.0, sigma=True),
    Entry("prnu", "number", "σ of the pixels' relative responses", 0.0, 1.0, default=0.0, sigma=True),
    Entry(
        _QUATERNION, "list", "unit quaternion from camera axes to body axes; its σ is an angle in radians",
        -1e6, 1e6, size=4, sigma=True,
    ),
    Entry("position_body_m", "list", "the camera's centre in body axes", -1e6, 1e6, size=3, sigma=True),
    Entry(
        "response_angle_rad", "list", "field angles of the response, increasing from 0", 0.0, 3.2, sigma=True
    ),
    Entry(
        "response_relative", "list",
        "response there, relative to the axis: filter and vignetting, without the lens's cos θ", 0.0, 1e3,
        sigma=True,
    ),
    Entry(
        "lens_model", "choice", "how angles become pixels", choices=tuple(COEFFICIENTS), default="rectilinear"
    ),
    Entry(
        "distortion", "list", "the model's coefficients in OpenCV's order; none of a rectilinear lens",
        -1e9, 1e9, default=(), sigma=True,
    ),
    Entry(
        "extinction_per_m", "number", "of the fog; 0 is clear air, with a σ where it is not known", 0.0, 1e3,
        default=0.0, sigma=True,
    ),
    Entry(
        "hidden_background", "number",
        "share of the background's light that a source takes away where it stands before it: 1 if it is "
        "black, 0 if it sends back as much ambient light as it hides", -10.0, 1.0, default=0.0, sigma=True,
    ),
    Entry(
        "glare_share", "number", "g: share of all light that the lens scatters far off", 0.0, 0.9,
        default=0.0, sigma=True,
    ),
    Entry(
        "glare_radius_px", "number", "r₀ of glare, w(r) ∝ (1 + (r / r₀)²)^−γ", 1e-2, 1e5, default=10.0,
        sigma=True,
    ),
    Entry("glare_exponent", "number", "γ of glare", 1.0, 100.0, above=True, default=2.5, sigma=True),
    Entry(
        "offset_file", "text",
        "PNG of 16 bits beside this file: each pixel's fixed offset at gain 1, in counts above 32768; "
        "`dsnu_e` is what it leaves", default="",
    ),
    Entry(
        "own_sources_body_m", "places", "where the robot's own sources sit, in body axes", -1e6, 1e6,
        default=(), sigma=True,
    ),
    Entry(
        "layouts", "objects", "where robots of a kind carry their sources, if several; a robot's heading is "
        "told by it", default=(), fields=LAYOUT_ENTRIES,
    ),
    Entry(
        "forward_light", "objects", "what fog of this kind scatters forward about a source, by rising "
        "optical depth", default=(), fields=FORWARD_ENTRIES,
    ),
)  # fmt: skip
"""The fields of a camera in `calibration.json`."""

_BY_NAME = {entry.name: entry for entry in CALIBRATION_ENTRIES}
_NUMBERS = tuple(entry.name for entry in CALIBRATION_ENTRIES if entry.kind in ("number", "whole"))
_SIGMA = Entry("sigma", "number", "", 0.0, 1e30)


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
    for name in _ARRAYS:
        record[name] = np.asarray(getattr(calibration, name), dtype=np.float64).tolist()
    record["lens_model"] = calibration.lens_model
    if calibration.offset_file:
        record["offset_file"] = calibration.offset_file
    if calibration.layouts:
        record["layouts"] = [_layout_record(layout) for layout in calibration.layouts]
    if calibration.forward_light:
        record["forward_light"] = [
            {name: value for name, value in asdict(light).items() if value != ()}
            for light in calibration.forward_light
        ]
    record["distortion"] = [float(number) for number in calibration.distortion]
    for field, sigma in calibration.sigma.items():
        name = _QUATERNION if field == "rotation_body_camera" else field
        if name not in record:
            raise ValueError(f"sigma of {field!r}, which is no entry of a calibration")
        record[name] = {"value": record[name], "sigma": float(sigma)}
    return record


def _layout_record(layout: Layout) -> dict[str, Any]:
    return {name: plain(name, value) for name, value in asdict(layout).items()}


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
        All fields that are missing, of the wrong type, out of bounds, or contradict another.
    """
    place, faults = Place(file), Faults()
    with faults.kept():
        check_format(document, place)
    cameras: Any = {}
    with faults.kept():
        cameras = get(document, "cameras", place)
        if not isinstance(cameras, dict):
            cameras, found = {}, cameras
            raise place.error(f"is {shown(found)}", "Write an object of cameras by name", "cameras")
    calibrations = {}
    for name, record in cameras.items():
        with faults.kept():
            calibrations[name] = _calibration(name, record, place.within(f"cameras.{name}"))
    faults.raise_any()
    return calibrations


def _calibration(name: str, record: Any, place: Place) -> Calibration:
    from scipy.spatial.transform import Rotation

    if not isinstance(record, dict):
        raise place.error(f"is {shown(record)}", "Write an object with the entries of one camera")
    faults = Faults()
    with faults.kept():
        read_entry(name, _NAME, Place(place.file))
    values, sigma = _split_sigmas(record, place, faults)
    values = read_entries(values, _told_of(values, record), place, faults)
    for problem in _contradictions(values, place):
        faults.problems += problem.problems
    faults.raise_any()
    quaternion = np.array(values.pop(_QUATERNION))
    arrays: dict[str, Any] = {field: np.array(values.pop(field)) for field in _ARRAYS}
    arrays["own_sources_body_m"] = arrays["own_sources_body_m"].reshape(-1, 3)
    return Calibration(
        camera=name,
        rotation_body_camera=Rotation.from_quat(quaternion).as_matrix(),
        sigma=sigma,
        distortion=tuple(values.pop("distortion", ())),
        layouts=tuple(_layout(layout) for layout in values.pop("layouts", ())),
        forward_light=tuple(_forward_light(light) for light in values.pop("forward_light", ())),
        **arrays,
        **values,
    )


def _layout(values: Mapping[str, Any]) -> Layout:
    places = tuple((float(x), float(y), float(z)) for x, y, z in values["places_body_m"])
    return Layout(**{**values, "places_body_m": places, "relative_flux": tuple(values["relative_flux"])})


def _forward_light(values: Mapping[str, Any]) -> ForwardLight:
    lists = {name: tuple(values.get(name, ())) for name in ("angle_rad", "share", "deviations")}
    return ForwardLight(**{**values, **lists})


def _told_of(given: Mapping[str, Any], record: Mapping[str, Any]) -> list[Entry]:
    """Return the entries to read: all but those whose value is missing beside their σ."""
    return [
        entry
        for entry in CALIBRATION_ENTRIES
        if entry.name in given or not isinstance(record.get(entry.name), dict)
    ]


_NAME = Entry("cameras", "text", "")
_ARRAYS = ("position_body_m", "response_angle_rad", "response_relative", "own_sources_body_m")


def _contradictions(values: Mapping[str, Any], place: Place) -> Iterator[RecordingError]:
    """Yield what is wrong between values that are each right."""
    if _QUATERNION in values:
        length = math.hypot(*values[_QUATERNION])
        if abs(length - 1.0) > 1e-6:
            yield place.error(f"has length {length:.9g}", "Write a unit quaternion x, y, z, w", _QUATERNION)
    angles = values.get("response_angle_rad")
    if angles and (angles[0] != 0.0 or any(b <= a for a, b in pairwise(angles))):
        remedy = "Sort the angles, the first is 0"
        yield place.error("does not increase from 0", remedy, "response_angle_rad")
    response = values.get("response_relative", angles)
    if angles and response and len(response) != len(angles):
        yield place.error(
            f"has {len(response)} numbers", f"Write a list of {len(angles)} numbers, one for each angle",
            "response_relative",
        )  # fmt: skip
    if "lens_model" in values and (coefficients := values.get("distortion", ())) is not None:
        model = values["lens_model"]
        if len(coefficients) not in COEFFICIENTS[model]:
            counts = " or ".join(str(count) for count in COEFFICIENTS[model])
            remedy = f"A {model} lens takes {counts} numbers in OpenCV's order"
            yield place.error(f"is {shown(list(coefficients))}", remedy, "distortion")
    if "saturation_dn" in values and "bit_depth" in values:
        full_scale_dn = 2 ** values["bit_depth"] - 1
        if values["saturation_dn"] > full_scale_dn:
            yield place.error(
                f"is {values['saturation_dn']}, beyond full scale, {full_scale_dn} DN at "
                f"{values['bit_depth']} bits", f"Write {full_scale_dn} or less", "saturation_dn",
            )  # fmt: skip
    for number, layout in enumerate(values.get("layouts", ())):
        inside = place.within(f"layouts[{number}]")
        places, flux = layout["places_body_m"], layout["relative_flux"]
        if not places:
            yield inside.error("is empty", "Write a list of [x, y, z], in metres", "places_body_m")
        elif len(flux) != len(places):
            remedy = f"Write a list of {len(places)} numbers, one for each source"
            yield inside.error(f"has {len(flux)} numbers", remedy, "relative_flux")
    yield from _contradictions_of_forward_light(values.get("forward_light", ()), place)
    black_dn, saturation_dn = values.get("black_level_dn", -math.inf), values.get("saturation_dn", math.inf)
    if black_dn >= saturation_dn:
        problem = f"is {black_dn:g}, not below saturation_dn = {saturation_dn}"
        yield place.error(problem, "Write the mean count of a frame taken in the dark", "black_level_dn")


def _contradictions_of_forward_light(
    lights: Iterable[Mapping[str, Any]], place: Place
) -> Iterator[RecordingError]:
    before, kinds = 0.0, None
    for number, light in enumerate(lights):
        inside = place.within(f"forward_light[{number}]")
        angles, deviations = len(light["angle_rad"]), len(light.get("deviations", ()))
        kinds = deviations / max(angles, 1) if kinds is None else kinds
        if deviations != kinds * angles or deviations % max(angles, 1):
            remedy = "Write as many as angles of each kind, of as many kinds at each depth, or none"
            yield inside.error(f"has {deviations} numbers", remedy, "deviations")
        if not light["depth"] > before:
            yield inside.error("does not increase", "Sort them by optical depth", "depth")
        before = light["depth"]
        if any(b <= a for a, b in pairwise([0.0, *light["angle_rad"]])):
            yield inside.error("does not increase from above 0", "Sort the angles", "angle_rad")
        if len(light["share"]) != len(light["angle_rad"]):
            remedy = f"Write a list of {len(light['angle_rad'])} numbers, one for each angle"
            yield inside.error(f"has {len(light['share'])} numbers", remedy, "share")
        elif any(b < a for a, b in pairwise([0.0, *light["share"]])):
            yield inside.error("falls", "Write the light within each angle: it rises with it", "share")


def _split_sigmas(
    record: Mapping[str, Any], place: Place, faults: Faults
) -> tuple[dict[str, Any], dict[str, float]]:
    """Take {"value": v, "sigma": s} apart."""
    values, sigma = dict(record), {}
    if values.get("distortion") == []:  # how a lens that has no coefficients is written
        del values["distortion"]
    for entry in CALIBRATION_ENTRIES:
        given = record.get(entry.name)
        if not entry.sigma or not isinstance(given, dict):
            continue
        del values[entry.name]
        inside = place.within(entry.name)
        with faults.kept():
            values[entry.name] = get(given, "value", inside)
        with faults.kept():
            field = "rotation_body_camera" if entry.name == _QUATERNION else entry.name
            sigma[field] = read_entry(get(given, "sigma", inside), _SIGMA, inside)
        with faults.kept():
            check_names(given, ("value", "sigma"), inside)
    return values, sigma
