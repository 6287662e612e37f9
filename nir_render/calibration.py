"""What perception may know about a camera of a scene: its calibration, exact.

The range constants are those of the sources of the other robots (of its own, where there are no others);
where these differ, their mean, with their spread as σ.
"""

import math
from dataclasses import replace

import numpy as np

from nir_render.camera.exposure import Beam, expected_electrons
from nir_render.camera.gaussian_fit import gaussian_fit
from nir_render.camera.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.otf import core_of
from nir_render.camera.response import response
from nir_render.camera.sensor import quantise, saturation_dn
from nir_render.errors import InputError
from nir_render.scene.devices import Camera, Source
from nir_render.scene.load import Scene
from nir_render.scene.motion import camera_pose_on_robot
from perception.calibrate import regress_paper_range_constant
from perception.pipeline import detect
from perception.types import Calibration, RawFrame

_RAIL_M = tuple(float(range_m) for range_m in range(1, 11))
_RAIL_PEAK = 0.8  # of full scale, at the nearest range: as bright as one would dare


def calibration(scene: Scene, camera: str) -> Calibration:
    """Return the calibration of a camera, `robot.camera`.

    Raises
    ------
    InputError
        No such camera, or no source to range to.
    """
    _, device = scene.camera(camera)
    own = camera.partition(".")[0] + "."
    everyone = {name: source for name, (_, source) in scene.sources().items()}
    others = [source for name, source in everyone.items() if not name.startswith(own)]
    sources = others or list(everyone.values())
    if not sources:
        raise InputError(f"{scene.path}: robots: no robot has a source, so there is no range constant")
    intrinsics = intrinsics_of(device)
    mount = camera_pose_on_robot(device)
    on_axis = response(device, sources[0])
    flux_constants = [range_constant(device, source) for source in sources]
    radii_m = [source.radius_m for source in sources]
    spread = {
        "range_constant_dn_m2_per_s": float(np.std(flux_constants)),
        "source_radius_m": float(np.std(radii_m)),
    }
    known = Calibration(
        camera=camera,
        width_px=intrinsics.width_px,
        height_px=intrinsics.height_px,
        fx_px=intrinsics.fx_px,
        fy_px=intrinsics.fy_px,
        cx_px=intrinsics.cx_px,
        cy_px=intrinsics.cy_px,
        rotation_body_camera=mount.rotation,
        position_body_m=mount.position_m,
        system_gain_dn_per_e=device.sensor.system_gain_dn_per_e,
        read_noise_e=device.sensor.read_noise_e,
        black_level_dn=device.sensor.black_level_dn,
        saturation_dn=saturation_dn(device.sensor),
        bit_depth=int(device.sensor.bit_depth_bit),
        psf_sigma_px=gaussian_fit(core_of(device)).sigma_px,
        response_angle_rad=on_axis.angle_rad,
        response_relative=on_axis.electrons_per_j / on_axis.electrons_per_j[0],
        range_constant_dn_m2_per_s=float(np.mean(flux_constants)),
        range_constant_paper_dn_m2_per_s=math.nan,
        source_radius_m=float(np.mean(radii_m)),
        wavelength_m=940e-9,
        sigma={name: sigma for name, sigma in spread.items() if sigma > 0.0},
        dsnu_e=device.sensor.dsnu.total_e,
        prnu=device.sensor.prnu.total,
        lens_model=device.lens.model,
        distortion=device.lens.distortion,
    )
    return replace(known, range_constant_paper_dn_m2_per_s=_paper_constant(known, device, sources[0]))


def range_constant(camera: Camera, source: Source) -> float:
    """Return K of a flare's flux on axis, in DN m²/s: system gain · A_ap · C(0) · Φ/4π · share.

    The share leaves out what glare and ghosts take, and what the core spreads beyond a flare.
    """
    electrons_per_j = float(response(camera, source).electrons_per_j[0])
    intensity_w_per_sr = source.flux_w / (4.0 * np.pi)
    flare_share = camera.point_spread.core_share * gaussian_fit(core_of(camera)).share
    return (
        camera.sensor.system_gain_dn_per_e
        * aperture_area_m2(camera)
        * electrons_per_j
        * intensity_w_per_sr
        * flare_share
    )


def _paper_constant(known: Calibration, camera: Camera, source: Source) -> float:
    """Return the paper's K by its own procedure (Exp1): one exposure, known ranges, regression of m on 1/d².

    Noise-free frames of the source on the axis at 1 to 10 m, measured by the paper's own detector. NaN where
    that detector finds the source at fewer than two ranges.
    """
    headroom_e = min(camera.sensor.well_e, camera.sensor.full_scale_dn / camera.sensor.system_gain_dn_per_e)
    brightest_e_per_s = expected_electrons(camera, [_beam(camera, source, _RAIL_M[0])], 1.0).max()
    exposure_s = float(_RAIL_PEAK * headroom_e / brightest_e_per_s)
    measured = []
    for index, range_m in enumerate(_RAIL_M):
        expected_e = expected_electrons(camera, [_beam(camera, source, range_m)], exposure_s)
        data_dn = quantise(expected_e, camera.sensor)
        frame = RawFrame(known.camera, index, float(index), exposure_s, data_dn, camera.sensor.black_level_dn)
        measured += [(found.mean_dn, found.background_dn, range_m) for found in detect(frame, known, "paper")]
    if len(measured) < 2:
        return math.nan
    mean_dn, background_dn, ranges_m = zip(*measured, strict=True)
    return regress_paper_range_constant(mean_dn, background_dn, exposure_s, ranges_m).slope_dn_m2_per_s


def _beam(camera: Camera, source: Source, range_m: float) -> Beam:
    return Beam(
        direction=np.array([0.0, 0.0, 1.0]),
        angular_radius_rad=float(np.arcsin(min(source.radius_m / range_m, 1.0))),
        irradiance_w_per_m2=source.flux_w / (4.0 * np.pi * range_m**2),
        response=response(camera, source),
        distance_m=range_m,
    )
