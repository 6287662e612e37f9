"""Dark, flat and rail frames of one camera over many seeds, and how well anyone could learn it from them.

Frames are made by the camera room of nir_render, as the scene scenes/calibration.yaml has them, on a small
sensor behind a lens that vignettes. The bounds are Cramér–Rao's, put together here by hand: derivatives by
differences of rendered images, the normal matrix of a mixed model by Woodbury's identity.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

import nir_render as nr
from nir_render.camera.beams import Beam, beam_electrons
from nir_render.camera.optics.response import response
from nir_render.camera.sensor.fixed_pattern import fixed_pattern
from nir_render.camera.sensor.read_out import read_out
from nir_render.randomness import RandomKey
from nir_render.scene.documents.camera import Camera
from nir_render.simulation.flare_spread import source_beam
from perception import CalibrationFrames, RawFrame
from perception.types import Calibration
from tests.paths import SCENES

Array = NDArray[np.float64]

NAME = "r1.front"
DARK, FLAT, REPEATS = 16, 16, 8
RANGES_M = tuple(float(range_m) for range_m in np.geomspace(1.0, 10.0, 16))
PEAK_E = 3800.0
EXPOSURE_S = 2e-4
_SIZE = {"rows": 300, "columns": 400}
_VIGNETTING = tuple((math.radians(a / 2.0), 1.0 - 0.2 * (a / 60.0) ** 2) for a in range(71))
_WINDOW_PX = 48
_INTERVALS = 9


def camera_of(glare_share: float, serial: str) -> Camera:
    """The camera of the example on a small sensor: another serial number has another fixed pattern."""
    scene = nr.load_scene(SCENES / "calibration.yaml")
    device = scene.camera(NAME)[1]
    spread = device.point_spread
    assert spread.glare is not None
    glare = None if glare_share == 0.0 else spread.glare.model_copy(update={"share": glare_share})
    return device.model_copy(
        update={
            "sensor": device.sensor.model_copy(update=_SIZE),
            "lens": device.lens.model_copy(update={"vignetting": _VIGNETTING}),
            "point_spread": spread.model_copy(update={"glare": glare}),
            "auto_exposure": None,
            "serial": serial,
        }
    )


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """What one seed's frames are made of: the mean frames, their exposures, what is known of the camera.

    Frames 0 to 15 are dark, 16 to 31 flat, then 8 at each range.
    """

    glare_share: float
    seed: int = 0

    @cached_property
    def camera(self) -> Camera:
        return camera_of(self.glare_share, f"serial {self.seed}")

    def frames(self, first_guess: Calibration) -> CalibrationFrames:
        """The frames; black levels are as the first guess has them."""
        first_rail = DARK + FLAT

        def load(index: int) -> RawFrame:
            if index < DARK:
                mean_e, exposure_s = np.zeros(tuple(_SIZE.values())), EXPOSURE_S
            elif index < first_rail:
                mean_e, exposure_s = flat_e(self.glare_share), EXPOSURE_S
            else:
                mean_e, exposure_s = rail_e(self.glare_share, (index - first_rail) // REPEATS)
            key = RandomKey(self.seed, "read_out", NAME, index)
            counts = read_out(mean_e, self.camera, exposure_s, key)
            return RawFrame(NAME, index, 0.125 * index, exposure_s, counts, first_guess.black_level_dn)

        places = {
            first_rail + REPEATS * place + turn: range_m
            for place, range_m in enumerate(RANGES_M)
            for turn in range(REPEATS)
        }
        return CalibrationFrames(load, range(DARK), range(DARK, first_rail), places)

    @property
    def true_black_dn(self) -> float:
        """The mean count of this camera's dark pixels: offsets and dark current are in it."""
        sensor = self.camera.sensor
        offset_e = fixed_pattern(sensor, self.camera.serial or "").offset_e
        mean_e = 0.0 if offset_e is None else float(offset_e.mean(dtype=np.float64))
        return float(
            sensor.black_level_dn
            + sensor.system_gain_dn_per_e * (mean_e + sensor.dark_rate_e_per_s * EXPOSURE_S)
        )

    @property
    def true_offset_e(self) -> Array:
        """Each pixel's offset from the mean."""
        offset_e = fixed_pattern(self.camera.sensor, self.camera.serial or "").offset_e
        assert offset_e is not None
        return np.asarray(offset_e - offset_e.mean(dtype=np.float64), dtype=np.float64)


_KEPT: dict[object, tuple[Array, float]] = {}


def rail_e(glare_share: float, place: int, **changes: float) -> tuple[Array, float]:
    """The mean frame of the source at a place, and its exposure; `changes` are of the camera and the place."""
    key = (glare_share, place, tuple(changes.items()))
    if key not in _KEPT:
        camera = _changed(camera_of(glare_share, "any"), changes)
        scene = nr.load_scene(SCENES / "calibration.yaml")
        _, source = scene.sources()["r2.top"]
        range_m = RANGES_M[place]
        aside = np.array([-0.03, -0.08, 0.0]) + 0.01 * place * np.array([0.7, 0.4, 0.0])
        direction = aside + np.array([0.0, 0.0, math.sqrt(range_m**2 - float(aside @ aside))])
        direction = (
            direction / range_m + np.array([changes.get("du", 0.0), changes.get("dv", 0.0), 0.0]) / 480.0
        )
        direction /= np.linalg.norm(direction)
        beam = source_beam(source, response(camera, source), direction, range_m * changes.get("range", 1.0))
        if "range" in changes:  # another size, the same light
            beam = replace(beam, irradiance_w_per_m2=beam.irradiance_w_per_m2 * changes["range"] ** 2)
        per_s = beam_electrons(camera, [beam], 1.0)
        exposure_s = PEAK_E / float(per_s.max()) if not changes else rail_e(glare_share, place)[1]
        _KEPT[key] = (exposure_s * per_s, exposure_s)
    return _KEPT[key]


def _changed(camera: Camera, changes: dict[str, float]) -> Camera:
    spread, glare = camera.point_spread, camera.point_spread.glare
    update: dict[str, object] = {}
    if "sigma_px" in changes:
        update["sigma_px"] = changes["sigma_px"]
    if glare is not None:
        names = {"share", "core_radius_px", "exponent"} & set(changes)
        update["glare"] = glare.model_copy(update={name: changes[name] for name in names})
    return camera.model_copy(update={"point_spread": spread.model_copy(update=update)})


def flat_e(glare_share: float) -> Array:
    """The mean frame of a glowing sphere right before the lens."""
    key = ("flat", glare_share)
    if key not in _KEPT:
        camera = camera_of(glare_share, "any")
        source = nr.load_scene(SCENES / "calibration.yaml").sources()["r2.top"][1]
        beam = Beam(np.array([0.0, 0.0, 1.0]), 1.2, 1.0, response(camera, source))
        image = beam_electrons(camera, [beam], 1.0)
        _KEPT[key] = (PEAK_E / float(image.max()) * image, EXPOSURE_S)
    return _KEPT[key][0]


def _window(place: int, glare_share: float) -> tuple[slice, slice]:
    image = rail_e(glare_share, place)[0]
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    return (
        slice(max(int(row) - _WINDOW_PX, 0), int(row) + _WINDOW_PX + 1),
        slice(max(int(column) - _WINDOW_PX, 0), int(column) + _WINDOW_PX + 1),
    )


def point_spread_bounds(glare_share: float, dsnu_e: float) -> dict[str, float]:
    """Least σ of width and glare: place, flux and background of each range are unknown too.

    Eight frames are added up; what is left of DSNU, and PRNU, are the same in each of them and at each range: the
    covariance of a pixel's sums at all ranges is inverted as it is, pixel by pixel. Without glare only the share
    is unknown, of glare of 10 px and exponent 2.5.
    """
    camera = camera_of(glare_share, "any")
    glare, gain = camera.point_spread.glare, camera.sensor.system_gain_dn_per_e
    assert camera.point_spread.sigma_px is not None
    steps = {"sigma_px": (camera.point_spread.sigma_px, 0.002)}
    if glare is not None:
        steps |= {
            "share": (glare.share, 0.002),
            "core_radius_px": (glare.core_radius_px, 0.2),
            "exponent": (glare.exponent, 0.05),
        }
    names = [*steps] if glare is not None else ["sigma_px", "share"]
    read_e2 = camera.sensor.read_noise_e**2 + 1.0 / (12.0 * gain**2)
    places, shared = len(RANGES_M), len(names)
    slopes = np.zeros((shared + 4 * places, places, *_SIZE.values()), dtype=np.float32)
    light_e, seen = np.zeros((2, places, *_SIZE.values()))
    for place in range(places):
        at = _window(place, glare_share)
        image = REPEATS * rail_e(glare_share, place)[0]

        def change(name: str, value: float, step: float, place: int = place) -> Array:
            high, low = (rail_e(glare_share, place, **{name: value + s * step})[0] for s in (1, -1))
            return np.asarray(REPEATS * (high - low) / (2.0 * step))

        of_all = [change(name, *steps[name]) for name in steps]
        if glare is None:
            some = rail_e(0.02, place)
            veiled = REPEATS * some[0] * rail_e(0.0, place)[1] / some[1]
            of_all.append((veiled - image) / 0.02)
        own = [change("du", 0.0, 0.02), change("dv", 0.0, 0.02), image, np.ones_like(image)]
        slopes[:shared, place, *at] = [one[at] for one in of_all]
        slopes[shared + 4 * place : shared + 4 * place + 4, place, *at] = [one[at] for one in own]
        light_e[place][at], seen[place][at] = image[at], 1.0
    prnu = camera.sensor.prnu.total
    information = np.zeros((len(slopes), len(slopes)))
    for row in range(_SIZE["rows"]):
        used = seen[:, row].any(axis=0)
        if not used.any():
            continue
        light, mask, by = (
            one[..., row, used].T for one in (light_e, seen, slopes)
        )  # (pixels, places[, slopes])
        both = mask[:, :, None] * mask[:, None, :]
        fixed = (REPEATS * dsnu_e) ** 2 * both + prnu**2 * light[:, :, None] * light[:, None, :]
        own_e2 = (light + REPEATS * read_e2)[:, :, None] * np.eye(places)
        information += np.einsum("xpk,xpl->kl", by, np.linalg.solve(fixed + own_e2, by), optimize=True)
    left = information[:shared, :shared] - information[:shared, shared:] @ np.linalg.solve(
        information[shared:, shared:], information[shared:, :shared]
    )
    return dict(zip(names, np.sqrt(np.diagonal(np.linalg.inv(left))), strict=True))


def range_constant_bound(dsnu_e: float, calibration: Calibration) -> float:
    """Least relative σ of K without glare, from every other place: place and background of each are unknown too.

    So is the point spread's width, but for what the whole rail tells of it, and the flat frames tell
    of pixels what their noise allows: of a place's pixels, response and all. K holds for the mean pixel on
    the axis, which flat frames tell as well as unlike pixels, rows and columns allow.
    """
    camera = camera_of(0.0, "any")
    read_e2 = camera.sensor.read_noise_e**2 + 1.0 / (12.0 * camera.sensor.system_gain_dn_per_e**2)
    light = FLAT * flat_e(0.0)
    flat_noise = np.sqrt(light + FLAT * read_e2 + (FLAT * dsnu_e) ** 2) / light
    unknown_prnu = 1.0 / np.hypot(1.0 / camera.sensor.prnu.pixel, 1.0 / flat_noise)
    total = np.zeros((2, 2))
    total[1, 1] = point_spread_bounds(0.0, dsnu_e)["sigma_px"] ** -2
    for place in range(0, len(RANGES_M), 2):
        at = _window(place, 0.0)
        image = REPEATS * rail_e(0.0, place)[0][at]

        def change(
            name: str, value: float, step: float, place: int = place, at: tuple[slice, slice] = at
        ) -> Array:
            high, low = (rail_e(0.0, place, **{name: value + s * step})[0][at] for s in (1, -1))
            return np.asarray(REPEATS * (high - low) / (2.0 * step))

        own = [change("du", 0.0, 0.02), change("dv", 0.0, 0.02), np.ones_like(image)]
        jacobian = np.array([one.ravel() for one in (image, change("sigma_px", 0.7, 0.002), *own)])
        variance = image + (unknown_prnu[at] * image) ** 2 + REPEATS * read_e2 + (REPEATS * dsnu_e) ** 2
        information = (jacobian / variance.ravel()) @ jacobian.T
        known = information[:2, :2] - information[:2, 2:] @ np.linalg.solve(
            information[2:, 2:], information[2:, :2]
        )
        total += known
    of_axis, covariance, _ = _response_fit(0.0, np.zeros(1), calibration, dsnu_e)
    axis2 = float(of_axis[0] @ covariance @ of_axis[0])  # R(0) is 1
    return math.sqrt(float(np.linalg.inv(total)[0, 0]) + axis2)


def response_bound(glare_share: float, angle_rad: Array, calibration: Calibration, dsnu_e: float) -> Array:
    """Least σ of the response relative to the axis."""
    wanted, covariance, at = _response_fit(glare_share, angle_rad, calibration, dsnu_e)
    slope = wanted[:-1] - at[:, None] * wanted[-1]  # R(0) is 1
    return np.asarray(np.sqrt(np.einsum("ik,kl,il->i", slope, covariance, slope)))


def _response_fit(
    glare_share: float, angle_rad: Array, calibration: Calibration, dsnu_e: float
) -> tuple[Array, Array, Array]:
    """The splines at angles and, last, on the axis; their least covariance; the response at the angles.

    A cubic spline in θ² of nine parts, and a tilt. The covariance of the frame's sum is D + Z G Zᵀ: pixels by themselves, and rows and columns of one
    response each; it is inverted by Woodbury's identity.
    """
    sensor, rows, columns = camera_of(glare_share, "any").sensor, *_SIZE.values()
    v, u = np.mgrid[0:rows, 0:columns]
    away = np.hypot(u - calibration.cx_px, v - calibration.cy_px) / calibration.fx_px
    theta = np.arctan(away)
    light = FLAT * flat_e(glare_share)
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, _INTERVALS + 1), np.ones(3)])
    basis = BSpline.design_matrix((theta / theta.max()).ravel() ** 2, knots, 3).toarray()
    truth = np.interp(theta, calibration.response_angle_rad, calibration.response_relative).ravel()
    design = np.column_stack([basis / truth[:, None], (u / columns).ravel(), (v / rows).ravel()])
    read_e2 = sensor.read_noise_e**2 + 1.0 / (12.0 * sensor.system_gain_dn_per_e**2)
    own = sensor.prnu.pixel**2 + (light + FLAT * read_e2 + (FLAT * dsnu_e) ** 2).ravel() / light.ravel() ** 2
    lines = np.zeros((rows + columns, design.shape[1]))
    weighted = design / own[:, None]
    np.add.at(lines, v.ravel(), weighted)
    np.add.at(lines, rows + u.ravel(), weighted)
    inner = np.diag(
        np.concatenate([
            (1.0 / own).reshape(rows, columns).sum(axis=1) + 1.0 / sensor.prnu.row**2,
            (1.0 / own).reshape(rows, columns).sum(axis=0) + 1.0 / sensor.prnu.column**2,
        ])
    )  # fmt: skip
    inner[:rows, rows:] = (1.0 / own).reshape(rows, columns)
    inner[rows:, :rows] = inner[:rows, rows:].T
    information = design.T @ weighted - lines.T @ np.linalg.solve(inner, lines)
    inverse = np.linalg.inv(information)
    wanted = BSpline.design_matrix(
        np.append((angle_rad / theta.max()) ** 2, 0.0).clip(0, 1), knots, 3
    ).toarray()
    at = np.interp(angle_rad, calibration.response_angle_rad, calibration.response_relative)
    return wanted, np.asarray(inverse[:-2, :-2], dtype=np.float64), np.asarray(at, dtype=np.float64)
