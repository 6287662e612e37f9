"""A frame with something of everything, so that loops are compiled before the first frame that matters."""

import math
from dataclasses import replace

import numpy as np

from perception.messages.decoder import decode
from perception.messages.pair import decode_pair
from perception.messages.uart import encode, packet_levels
from perception.model.fisher import flare_limit
from perception.model.flare import PixelBox, flare_image
from perception.model.lens import unproject
from perception.model.ranging import brightness_e
from perception.pairs import inseparable
from perception.photometry import Expected, sample_at
from perception.rig.measure_set import measure_set
from perception.robust.detect import detect_robust
from perception.track.tracker import Tracker
from perception.types import Calibration, Detection, Layout, RawFrame, Signal

_ROWS, _COLUMNS = 256, 320


def warm_up() -> None:
    """Compile the loops of detector, limits, rig, tracks, decoders, where that was not done on this machine.

    It takes minutes once, when the package is new, and a moment after: to be called where a robot is set up,
    or starts, so that no frame waits for it. Two processes do it in half of the time, one for frames, one for
    sets and time.
    """
    warm_up_frames()
    warm_up_sets()


def warm_up_frames() -> None:
    """Compile what measures single frames, and the limits."""
    frame, calibration = _sample()
    detect_robust(frame, calibration)
    detect_robust(_near_sample(calibration), calibration)
    flare_limit(calibration, 40.3, 60.2, 4.0, 9e3, 20.0)
    flare_image(40.3, 60.2, 0.0025, PixelBox(50, 30, 21, 21), calibration)
    _measure_brightness(frame, calibration)
    bent = replace(calibration, lens_model="brown_conrady", distortion=(-0.1, 0.0, 0.0, 0.0))
    unproject(np.array([(40.3, 60.2)]), bent)


def warm_up_sets() -> None:
    """Compile what makes of the flares of a set robots, tracks and words."""
    _measure_sample_set(_sample()[1])
    _decode_sample()


def _measure_brightness(frame: RawFrame, calibration: Calibration) -> None:
    """Look at a dark place beside another."""
    place = Expected(u_px=200.3, v_px=60.2, sigma_px=0.1, range_m=3.0, flux_dn=9e3, width_px=0.8)
    sample_at(place, (), frame, calibration)
    inseparable({1: place, 2: replace(place, u_px=201.0)})


def _decode_sample() -> None:
    """Decode a packet, by itself and with another."""
    time_s = np.arange(0.0, 8.0, 1.0 / 30.0)
    every = np.ones(len(time_s))
    lit = packet_levels(time_s, 1e-3 * every, encode(42), 1.0)
    signal = Signal("warm-up", 1, time_s, 1e-3 * every, lit, 0.1 * every, 0.1 * every)
    decode(signal)
    other = packet_levels(time_s, 1e-3 * every, encode(19), 1.7)
    both = replace(signal, level=lit + 0.5 * other)
    decode_pair(both, (1.0, 0.5), (0.05, 0.025), (1, 2))


def _measure_sample_set(calibration: Calibration) -> None:
    """Measure and follow what two cameras see: robots, one with two sources, and their mirror images."""
    pair = Layout("pair", ((0.05, 0.0, 0.0), (-0.05, 0.0, 0.0)), (1.0, 1.0))
    calibration = replace(calibration, layouts=(pair,))
    side = replace(calibration, camera="side", position_body_m=np.array([0.1, 0.0, 0.0]))
    robots = np.array([[-0.5, 0.3, 2.0], [-0.4, 0.3, 2.0], [0.4, -0.2, 3.0], [0.1, 0.5, 4.0]])
    images = robots * [1.0, 1.0, -1.0] + [
        0.0,
        0.0,
        12.0,
    ]  # in a mirror at z = 6 m, which takes a fifth of light
    places = [(place, 1.0) for place in robots] + [(place, 1.12) for place in images]
    frames, detections = [], []
    for camera in (calibration, side):
        frames.append(RawFrame(camera.camera, 0, 0.0, 1e-3, np.zeros((1, 1), dtype=np.uint16), 64.0))
        own = []
        for place, longer in places:
            x, y, z = (place - camera.position_body_m).tolist()
            range_m = math.sqrt(x * x + y * y + z * z)
            own.append(
                Detection(
                    camera=camera.camera,
                    index=0,
                    time_s=0.0,
                    u_px=camera.cx_px + camera.fx_px * x / z,
                    v_px=camera.cy_px + camera.fy_px * y / z,
                    u_sigma_px=0.05,
                    v_sigma_px=0.05,
                    flux_dn=1e4,
                    mean_dn=100.0,
                    background_dn=64.0,
                    area_px=9,
                    saturated=False,
                    merged=False,
                    ghost=False,
                    range_m=longer * range_m,
                    range_sigma_m=0.01 * range_m,
                    bearing_body=(x / range_m, y / range_m, z / range_m),
                )
            )
        detections.append(own)
    seen = measure_set(frames, detections, {camera.camera: camera for camera in (calibration, side)})
    tracker = Tracker()
    for time_s in (0.0, 0.05):
        tracker.update(time_s, seen.measurements)


def _sample() -> tuple[RawFrame, Calibration]:
    """Return a frame with a lone flare, a clipped one, two that overlap, a bad pixel, and texture."""
    calibration = Calibration(
        camera="warm-up", width_px=_COLUMNS, height_px=_ROWS, fx_px=160.0, fy_px=160.0,
        cx_px=0.5 * (_COLUMNS - 1), cy_px=0.5 * (_ROWS - 1),
        rotation_body_camera=np.eye(3), position_body_m=np.zeros(3), system_gain_dn_per_e=0.5,
        read_noise_e=4.0, black_level_dn=64.0, saturation_dn=4095, bit_depth=12, psf_sigma_px=0.8,
        source_radius_m=0.01, wavelength_m=940e-9, response_angle_rad=np.array([0.0, 1.2]),
        response_relative=np.array([1.0, 0.9]), range_constant_dn_m2_per_s=1e8,
        range_constant_paper_dn_m2_per_s=7e6,
    )  # fmt: skip
    rows, columns = np.indices((_ROWS, _COLUMNS))
    light_e = 20.0 + 60.0 * (columns > 0.5 * _COLUMNS) * (1.0 + np.sin(columns / 3.0) * np.sin(rows / 3.0))
    for u, v, flux_e in ((40.3, 60.2, 9e3), (70.1, 150.4, 2e5), (100.0, 100.0, 9e3), (102.0, 101.5, 9e3)):
        light_e += flux_e / 4.5 * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 0.72)
    noise = np.random.Generator(np.random.Philox(1))
    electrons = noise.poisson(light_e) + noise.normal(0.0, calibration.read_noise_e, light_e.shape)
    counts = np.clip(np.rint(0.5 * electrons + 64.0), 0, 4095).astype(np.uint16)
    counts[20, 20] = 4095
    return RawFrame("warm-up", 0, 0.0, 1e-3, counts, 64.0), calibration


def _near_sample(calibration: Calibration) -> RawFrame:
    """Return a frame with two near sources, one partly behind the other."""
    rows, columns = np.indices((_ROWS, _COLUMNS))
    middle_u, middle_v, exposure_s = calibration.cx_px, calibration.cy_px, 1e-4
    place = np.array([[middle_u, middle_v]])
    light_e = np.full((_ROWS, _COLUMNS), 5.0)
    for away_px, radius_px in ((0.0, 7.3), (7.0, 5.6)):
        away = np.hypot(columns - middle_u - away_px, rows - middle_v - away_px)
        covered = np.clip((radius_px - away) / calibration.psf_sigma_px + 0.5, 0.0, 1.0)
        light_e = np.maximum(light_e, covered * float(brightness_e(place, exposure_s, 1.0, calibration)[0]))
    counts = np.random.Generator(np.random.Philox(2)).poisson(light_e) * calibration.system_gain_dn_per_e
    return RawFrame("warm-up", 0, 0.0, exposure_s, np.rint(counts + 64.0).astype(np.uint16), 64.0)
