"""What perception may know about a camera of a scene: its calibration, exact.

The range constants are those of the sources of the other robots (of its own, where there are no others);
where these differ, their mean, with their spread as σ. Of fog it says that there may be some, not how much,
and what fogs usually scatter forward.
Sources are rendered as black spheres: in clear air they hide all of the background.
"""

import math
from dataclasses import fields, replace
from functools import lru_cache

import numpy as np

from nir_render.camera.beams import beam_electrons
from nir_render.camera.optics.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.optics.response import response
from nir_render.camera.sensor.read_out import quantise, saturation_dn
from nir_render.errors import InputError
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.scene.pose import camera_mount
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.flare_spread import Progress, flare_spread, source_beam
from nir_render.simulation.fog_known import USUAL, forward_light
from nir_render.spectra.nodes import BAND_M
from perception.estimators import detect
from perception.paper import regress_paper_range_constant
from perception.types import Calibration, Layout, RawFrame

FOG_SIGMA_PER_M = 0.05
"""What a robot knows of fog where there is some: not how thick it is. 0.05 /m is a visibility of 78 m."""

_KEPT = 64
_RAIL_M = tuple(float(range_m) for range_m in range(1, 11))
_RAIL_PEAK = 0.8  # of full scale, at the nearest range: as bright as one would dare


def calibration(world: Scene | Snapshot, camera: str, progress: Progress | None = None) -> Calibration:
    """Return the calibration of a camera, `robot.camera`; its arrays are read-only.

    Of a point spread that is no Gaussian the one that perception is to use, and the share of the light that
    it finds, are measured once (`flare_spread`), which takes seconds; `progress` is told of it.

    Raises
    ------
    InputError
        No such camera, or no source to range to.
    """
    device, sources = _devices(world, camera)
    for source in sources:
        flare_spread(device, source, progress)
    return _with_robot(_of_devices(camera, device, sources), world)


def calibration_without_rail(world: Scene | Snapshot, camera: str) -> Calibration:
    """Return what is known of a camera without looking at a source, at once: geometry, response, noise.

    NaN are the Gaussian of the point spread and both range constants; no σ is given. Errors as `calibration`.
    """
    return _with_robot(_without_rail(camera, *_devices(world, camera)), world)


def _devices(world: Scene | Snapshot, camera: str) -> tuple[Camera, tuple[Source, ...]]:
    """Return a camera and the sources that it ranges to."""
    snapshot = world.at(0.0) if isinstance(world, Scene) else world
    device = snapshot.camera(camera).camera
    own = camera.partition(".")[0] + "."
    everyone = {name: placed.source for name, placed in snapshot.carried_sources.items()}
    others = [source for name, source in everyone.items() if not name.startswith(own)]
    sources = others or list(everyone.values())
    if not sources:
        raise InputError(f"{snapshot.origin}: robots: no robot has a source, so there is no range constant")
    return device, tuple(source.of_its_type for source in sources)


def _with_robot(known: Calibration, world: Scene | Snapshot) -> Calibration:
    """Return a calibration with what else the robot knows: where its own sources sit, that there is fog."""
    snapshot = world.at(0.0) if isinstance(world, Scene) else world
    own = known.camera.partition(".")[0] + "."
    places = [
        each.source.position_m for name, each in snapshot.carried_sources.items() if name.startswith(own)
    ]
    sigma = dict(known.sigma)
    if snapshot.fog is not None and snapshot.fog.extinction_per_m > 0.0:
        sigma["extinction_per_m"] = FOG_SIGMA_PER_M
        # How much of the light beside a source comes from fog before it is anybody's guess: even over 0 to 1.
        sigma["hidden_background"] = math.sqrt(1.0 / 12.0)
        known = replace(known, hidden_background=0.5, forward_light=forward_light(USUAL))
    own_sources_body_m = np.array(places, dtype=np.float64).reshape(-1, 3)
    return replace(
        known,
        sigma=sigma,
        own_sources_body_m=own_sources_body_m,
        layouts=_layouts(snapshot, known),
    )


def _layouts(snapshot: Snapshot, known: Calibration) -> tuple[Layout, ...]:
    """Return where robots carry their sources that have several, one of each kind, named by its first robot.

    Their flux is over that of the range constant, so far as this is known, and but for a unit's own offset.
    """
    own = known.camera.partition(".")[0]
    layouts: dict[tuple[object, ...], Layout] = {}
    for name, robot in snapshot.robots.items():
        sources = [source.of_its_type for source in robot.rig.sources.values()]
        if name == own or len(sources) < 2:
            continue
        device = snapshot.camera(known.camera).camera
        constant = known.range_constant_dn_m2_per_s
        flux = tuple(
            1.0 if math.isnan(constant) else range_constant(device, source) / constant for source in sources
        )
        known_shares = [] if math.isnan(constant) else [flare_spread(device, source) for source in sources]
        share_sigma = max((spread.share_sigma for spread in known_shares), default=0.0)
        places_m = tuple(source.position_m for source in sources)
        layouts.setdefault((places_m, flux), Layout(name, places_m, flux, flux_sigma_common=share_sigma))
    return tuple(layouts.values())


@lru_cache(maxsize=_KEPT)
def _of_devices(camera: str, device: Camera, sources: tuple[Source, ...]) -> Calibration:
    """Return the calibration of a camera to the sources that it ranges to, kept for other scenes."""
    flux_constants = [range_constant(device, source) for source in sources]
    spreads = [flare_spread(device, source) for source in sources]
    constant = float(np.mean(flux_constants))
    of_shares = constant * max(spread.share_sigma for spread in spreads)
    radii_m = [source.radius_m for source in sources]
    # Through a point spread that is no Gaussian a size seen says nothing: perception knows Gaussians alone.
    of_size = float(np.mean(radii_m)) if of_shares > 0.0 else 0.0
    spread = {
        "range_constant_dn_m2_per_s": math.hypot(float(np.std(flux_constants)), of_shares),
        "source_radius_m": math.hypot(float(np.std(radii_m)), of_size),
    }
    known = replace(
        _without_rail(camera, device, sources),
        psf_sigma_px=spreads[0].sigma_px,
        range_constant_dn_m2_per_s=constant,
        sigma={name: sigma for name, sigma in spread.items() if sigma > 0.0},
    )
    return replace(known, range_constant_paper_dn_m2_per_s=_paper_constant(known, device, sources[0]))


@lru_cache(maxsize=_KEPT)
def _without_rail(camera: str, device: Camera, sources: tuple[Source, ...]) -> Calibration:
    """Return the calibration but for what a rail tells, its arrays read-only."""
    intrinsics = intrinsics_of(device)
    mount = camera_mount(device)
    on_axis = response(device, sources[0])
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
        psf_sigma_px=math.nan,
        response_angle_rad=on_axis.angle_rad,
        response_relative=on_axis.electrons_per_j / on_axis.electrons_per_j[0],
        range_constant_dn_m2_per_s=math.nan,
        range_constant_paper_dn_m2_per_s=math.nan,
        source_radius_m=float(np.mean([source.radius_m for source in sources])),
        wavelength_m=BAND_M,
        dsnu_e=device.sensor.dsnu.total_e,
        prnu=device.sensor.prnu.total,
        lens_model=device.lens.model,
        distortion=device.lens.distortion,
        hidden_background=1.0,
    )
    if (glare := device.point_spread.glare) is not None:
        known = replace(
            known,
            glare_share=glare.share,
            glare_radius_px=glare.core_radius_px,
            glare_exponent=glare.exponent,
        )
    for field in fields(known):
        if isinstance(array := getattr(known, field.name), np.ndarray):
            array.setflags(write=False)
    return known


def range_constant(camera: Camera, source: Source) -> float:
    """Return K of a flare's flux on axis, in DN m²/s: system gain · A_ap · C(0) · Φ/4π · share.

    The share is that which perception finds of a flare's light under the camera's point spread.
    """
    electrons_per_j = float(response(camera, source).electrons_per_j[0])
    intensity_w_per_sr = source.sent_flux_w / (4.0 * np.pi)
    return (
        camera.sensor.system_gain_dn_per_e
        * aperture_area_m2(camera)
        * electrons_per_j
        * intensity_w_per_sr
        * flare_spread(camera, source).share
    )


def _paper_constant(known: Calibration, camera: Camera, source: Source) -> float:
    """Return the paper's K by its own procedure (Exp1): one exposure, known ranges, regression of m on 1/d².

    Noise-free frames of the source on the axis at 1 to 10 m, measured by the paper's own detector. NaN where
    that detector finds the source at fewer than two ranges, as where the axis lies beyond the sensor.
    """
    headroom_e = min(camera.sensor.well_e, camera.sensor.full_scale_dn / camera.sensor.system_gain_dn_per_e)
    unit, axis = response(camera, source), np.array([0.0, 0.0, 1.0])
    brightest_e_per_s = float(
        beam_electrons(camera, [source_beam(source, unit, axis, _RAIL_M[0])], 1.0).max()
    )
    if not brightest_e_per_s > 0.0:
        return math.nan
    exposure_s = _RAIL_PEAK * headroom_e / brightest_e_per_s
    measured = []
    for index, range_m in enumerate(_RAIL_M):
        expected_e = beam_electrons(camera, [source_beam(source, unit, axis, range_m)], exposure_s)
        data_dn = quantise(expected_e, camera.sensor)
        frame = RawFrame(known.camera, index, float(index), exposure_s, data_dn, camera.sensor.black_level_dn)
        measured += [(found.mean_dn, found.background_dn, range_m) for found in detect(frame, known, "paper")]
    if len(measured) < 2:
        return math.nan
    mean_dn, background_dn, ranges_m = zip(*measured, strict=True)
    return regress_paper_range_constant(mean_dn, background_dn, exposure_s, ranges_m).slope_dn_m2_per_s
