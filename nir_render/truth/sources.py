"""The record of a source, or of one ghost of it, in one frame: a line of `truth.jsonl`."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

from nir_render.errors import InputError, shown

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class SourceTruth:
    """The truth about one source, or one ghost of it, in one frame, at mid-exposure.

    `u_px, v_px` is the projection of the source's centre; `range_m` the straight distance from the lens to
    it, `depth_z_m` its part along the optical axis; bearings are unit vectors from the camera's centre;
    `position_body_m` counts from the observing robot's origin. `on_fraction` is the mean of the source's
    drive over the exposure of the row of pixels that its centre is in. All electrons are those in the frame,
    with the sources as they were driven: `direct_e` are the expected electrons that came straight, those
    beyond the sensor's edge included; `scattered_e` those of the source's own light that came by way of
    bodies or fog into the pixels of the flare. `background_e` is all light but the flare's, the source's own
    scattered light and the glare and lens ghosts of its light included, as a mean per pixel there; `dark_e`
    the mean dark current's, in every pixel. `peak_snr` is the flare's brightest pixel over the temporal noise
    there, before the ADC: shot noise of light and dark current, read noise. `flare_share` is the share of
    `direct_e` that is in the flare as perception knows it: 1 under a Gaussian point spread, less with glare,
    ghosts and diffraction. `gain` is the frame's, a factor on the calibrated system gain. `moved_u_px,
    moved_v_px` is how far the flare moves over a row's exposure, from its place at the begin to that at the
    end, at the velocities of mid-exposure; 0 where it is drawn in one place.

    A ghost, the image of a source in one flat smooth surface, has a row of its own: `ghost_of` is the name
    `robot.source` of whom it shows (None for a source itself), place and range are those of the image behind
    the surface, its electrons are `mirrored_e`, and `direct_e` is 0; a source's own `mirrored_e` is 0.

    What has a default another program may leave out: then a source counts as seen in full, lit and bright,
    and there is no limit to hold its range against. The limit follows from `direct_e` and `background_e`;
    who gives the first and leaves out the second gets one that is too low.
    """

    camera: str
    index: int
    time_s: float
    source: str
    robot: str
    u_px: float
    v_px: float
    range_m: float
    depth_z_m: float | None = None
    bearing_camera: Vector | None = None
    bearing_body: Vector
    position_body_m: Vector | None = None
    visible_fraction: float = 1.0
    direct_e: float = 0.0
    mirrored_e: float = 0.0
    scattered_e: float = 0.0
    background_e: float = 0.0
    peak_snr: float = math.inf
    saturated_px: int = 0
    on_fraction: float = 1.0
    ghost_of: str | None = None
    gain: float = 1.0
    dark_e: float = 0.0
    flare_share: float = 1.0
    moved_u_px: float = 0.0
    moved_v_px: float = 0.0

    def record(self) -> dict[str, Any]:
        """Return the line of `truth.jsonl`."""
        return {"format": 1, **asdict(self)}


_UNIT_SLACK = 1e-3  # of the length of a bearing
# Bounds are far beyond what any camera sees: what lies outside is a slip.
_NOT_NEGATIVE = (0.0, 1e30)
_MOST = 1e30
_ELECTRONS = ("direct_e", "mirrored_e", "scattered_e", "background_e", "dark_e")
_BOUNDS = {
    **dict.fromkeys(("peak_snr", *_ELECTRONS), _NOT_NEGATIVE),
    "range_m": (0.0, 1e9),
    "depth_z_m": (-1e9, 1e9),
    "index": (0, 2**63 - 1),
    "time_s": (-1e12, 1e12),
    "saturated_px": (0, 2**53),
    **dict.fromkeys(("u_px", "v_px", "moved_u_px", "moved_v_px"), (-1e6, 1e6)),
    "flare_share": (0.0, 1e3),
    **dict.fromkeys(("visible_fraction", "on_fraction"), (0.0, 1.0)),
    "gain": (1e-6, 1e6),
}
_VECTORS = ("bearing_camera", "bearing_body", "position_body_m")


def parse_truth(record: Mapping[str, Any]) -> SourceTruth:
    """Return the truth of a line of `truth.jsonl`; fields that have a default may be missing.

    Raises
    ------
    InputError
        All fields that are missing, unknown, of another kind than they should be, or out of bounds.
    """
    if not isinstance(record, Mapping):
        raise InputError(f"wanted an object with fields such as 'camera' and 'index', not {shown(record)}")
    problems = []
    if record.get("format", 1) != 1:
        problems.append(f"format is {shown(record['format'])}; this program reads format 1")
    given = {name: value for name, value in record.items() if name != "format"}
    known = {field.name: field for field in fields(SourceTruth)}
    unknown = [name for name in given if name not in known]
    if unknown:
        problems.append(f"there is no field {shown(unknown[0])}; known: {', '.join(known)}")
    missing = [name for name, field in known.items() if field.default is MISSING and name not in given]
    problems += [f"the field {name!r} is missing" for name in missing]
    for name in given.keys() & known.keys():
        try:
            given[name] = _checked(name, str(known[name].type), given[name])
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise InputError(*problems)
    return SourceTruth(**given)


def _checked(name: str, kind: str, value: Any) -> Any:
    """Return the value of a field if it is of its kind, as it is annotated; raise ValueError if not."""
    if value is None and "None" in kind:
        return value
    if name in _VECTORS:
        if not isinstance(value, list | tuple) or len(value) != 3 or not all(map(is_number, value)):
            raise ValueError(f"{name} is {shown(value)}; wanted a list of three finite numbers")
        if name != "position_body_m" and abs(math.hypot(*value) - 1.0) > _UNIT_SLACK:
            raise ValueError(f"{name} is {shown(value)}; wanted a vector of length 1")
        return tuple(map(float, value))
    if "str" in kind:
        if isinstance(value, str) and value.isprintable():
            return value
        raise ValueError(f"{name} is {shown(value)}; wanted a text of one line")
    if not is_number(value) or ("int" in kind and not isinstance(value, int)):
        wanted = "whole number" if "int" in kind else "finite number"
        raise ValueError(f"{name} is {shown(value)}; wanted a {wanted}")
    least, most = _BOUNDS.get(name, (-_MOST, _MOST))
    if not least <= value <= most:
        raise ValueError(f"{name} is {shown(value)}; wanted a number from {least:g} to {most:g}")
    return value if "int" in kind else float(value)


def is_number(value: Any) -> bool:
    """Tell whether a value is a number that sums and squares of stay finite."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -_MOST <= value <= _MOST
