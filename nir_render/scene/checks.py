"""Checks across fields of a document: cameras inside solids, exposures longer than the clock leaves, ..."""

import math
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import shown
from nir_render.scene.bodies import Solid, bounding_sphere, contains, solid_around, solids
from nir_render.scene.documents.base import Same
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import Robot, SceneDocument
from nir_render.scene.documents.materials import Dielectric, Pane, texture_of
from nir_render.scene.documents.sensor import Sensor
from nir_render.scene.documents.shapes import Cylinder, Mesh, Rectangle
from nir_render.scene.documents.times.clocks import JITTER_SIGMAS, CameraClock
from nir_render.scene.documents.times.motion import Moving
from nir_render.scene.emission import emission_spectrum
from nir_render.scene.meshes.mesh import lies_open
from nir_render.scene.motion import (
    camera_positions_m,
    frame_positions_m,
    frame_rotations,
    robot_positions_m,
    robot_rotations,
)
from nir_render.spectra.curve import constant_curve, range_nm
from nir_render.spectra.illuminants import SILICON_M
from nir_render.spectra.nodes import BAND_M

_SLACK_M = 1e-15  # what float64 rounds away
_SLACK = 1e-9
_MOST_AT_ONCE = 10_000  # poses

Array = NDArray[np.float64]


def check(document: SceneDocument) -> list[str]:
    """Return one line per problem of a document whose fields are right one by one."""
    return [
        *flat_cylinders(document),
        *_sheets_and_solids(document),
        *_pictures_without_a_place(document),
        *_fog_up_to_the_sun(document),
        *_indivisible_sensors(document),
        *_exposures_beyond_the_clock(document),
        *_uncovered_curves(document),
        *_cameras_inside_solids(document),
        *_cameras_and_sources_inside_their_own_bodies(document),
    ]


def flat_cylinders(document: SceneDocument) -> list[str]:
    """Return one line per cylinder without a length."""
    return [
        f"{place}: start and end of the cylinder are the same point"
        for place, shape in document.all_shapes().items()
        if isinstance(shape, Cylinder) and shape.start_m == shape.end_m
    ]


def _indivisible_sensors(document: SceneDocument) -> list[str]:
    if not document.has_indirect_light():
        return []
    scale = document.render.indirect.scale
    problems = [
        indivisible_sensor(name, camera.sensor, scale) for name, camera in _observing(document).items()
    ]
    return [problem for problem in problems if problem is not None]


def _observing(document: SceneDocument) -> dict[str, Camera]:
    """Return the cameras that take frames, by `robot.camera`."""
    names = dict.fromkeys(name for selector in document.observe for name in document.cameras_of(selector))
    return {name: _camera_of(document, name) for name in names}


def _camera_of(document: SceneDocument, name: str) -> Camera:
    robot, camera = name.split(".")
    return document.robots[robot].rig.cameras[camera]


def indivisible_sensor(name: str, sensor: Sensor, scale: int) -> str | None:
    """Return what is wrong where the pixels of the indirect light do not fit the sensor of `robot.camera`."""
    if not (sensor.columns % scale or sensor.rows % scale):
        return None
    return (
        f"render.indirect.scale: {scale} does not divide the sensor of {name}, {sensor.columns} × "
        f"{sensor.rows} pixels; take a divisor of both"
    )


def _exposures_beyond_the_clock(document: SceneDocument) -> list[str]:
    """Tell of rows that would begin before they have ended, and of choices by frames that have not ended."""
    if document.clock.frames == 1:
        return []
    problems = []
    mend = "shorten it, or lower clock.frame_rate"
    for name, camera in _observing(document).items():
        robot, camera_name = name.split(".")
        place = f"robots.{robot}.rig.cameras.{camera_name}"
        shortest_s = _shortest_period_s(camera, document.clock.frame_rate_hz)
        if shortest_s <= 0.0 and camera.clock is not None:
            problems.append(
                f"{place}.clock.jitter: {1e3 * camera.clock.jitter_s:.4g} ms could take a frame before "
                f"the one before it: {JITTER_SIGMAS:g} of them either way, at "
                f"{document.clock.frame_rate_hz:g} Hz; lower it, or clock.frame_rate"
            )
            continue
        period_s, period = (1.0 + _SLACK) * shortest_s, f"{1e3 * shortest_s:.4g} ms"
        rows, auto = camera.sensor.rows, camera.auto_exposure
        read_out_s = rows * camera.shutter.row_delay_s
        read_out = f"the read-out of {rows} rows, {1e3 * read_out_s:.4g} ms,"
        if read_out_s > period_s:
            problems.append(
                f"{place}.shutter.line_time: {read_out} lasts longer than the {period} from one frame to the "
                f"next; {mend}"
            )
        for field, exposure_s in _longest_exposures_s(camera).items():
            exposure = f"{place}.{field}: {1e3 * exposure_s:.4g} ms"
            if exposure_s > period_s:
                problems.append(
                    f"{exposure} is longer than the {period} from one frame to the next: a frame would begin "
                    f"before the one before has ended; {mend}"
                )
            elif auto is not None and exposure_s + read_out_s > auto.latency * period_s:
                problems.append(
                    f"{exposure} and {read_out} are longer than {auto.latency} × {period}: an exposure would "
                    f"be chosen by a frame that has not ended; {mend}, or raise auto_exposure.latency"
                )
    return problems


def _shortest_period_s(camera: Camera, frame_rate_hz: float) -> float:
    """Return the shortest time from one frame to the next, by the camera's own clock."""
    clock = camera.clock or CameraClock()
    return (1.0 + clock.drift) / frame_rate_hz - 2.0 * JITTER_SIGMAS * clock.jitter_s


def _longest_exposures_s(camera: Camera) -> dict[str, float]:
    """Return the longest exposure that each field lets a camera take."""
    if camera.bracket is not None:
        return {"bracket": max(camera.bracket)}
    if camera.auto_exposure is not None:
        return {"exposure": camera.exposure_s, "auto_exposure.longest": camera.auto_exposure.longest_s}
    return {"exposure": camera.exposure_s}


def _sheets_and_solids(document: SceneDocument) -> list[str]:
    problems = []
    for place, shape in document.all_shapes().items():
        material = document.materials[shape.material]
        if isinstance(material, Pane) and not isinstance(shape, Rectangle):
            problems.append(
                f"{place}.material: {shown(shape.material)} is a pane, a thin sheet: only a rectangle "
                f"can be of it, not a {shape.type}; solid glass is of the type 'dielectric'"
            )
        if isinstance(material, Dielectric) and isinstance(shape, Rectangle):
            problems.append(
                f"{place}.material: {shown(shape.material)} is a solid dielectric, and a rectangle has "
                "no inside; use the type 'pane' for a sheet of glass, or a box"
            )
        if isinstance(material, Dielectric) and isinstance(shape, Mesh):
            open_by = lies_open(shape.parts())
            if open_by is not None:
                problems.append(
                    f"{place}.material: {shown(shape.material)} is a solid dielectric, and {shape.file} "
                    f"has no inside: {open_by}"
                )
    return problems


def _pictures_without_a_place(document: SceneDocument) -> list[str]:
    """Tell of bodies of a material with a picture, on which nothing says what lies where."""
    problems = []
    for place, shape in document.all_shapes().items():
        if texture_of(document.materials[shape.material]) is None or isinstance(shape, Rectangle):
            continue
        if isinstance(shape, Mesh) and all(part.uvs is not None for part in shape.parts()):
            continue
        what = f"{shape.file} has no uv coordinates" if isinstance(shape, Mesh) else f"not a {shape.type}"
        problems.append(
            f"{place}.material: {shown(shape.material)} is a picture, which lies on rectangles and on meshes "
            f"whose file has uv coordinates (OBJ, glTF); {what}: unwrap it, or take another material"
        )
    return problems


def _fog_up_to_the_sun(document: SceneDocument) -> list[str]:
    fog = document.fog
    endless = fog is not None and fog.extinction_per_m > 0.0 and not math.isfinite(fog.region_m()[1][2])
    problem = (
        "fog: has no end on the way to the sun, so that the sun is black; give it a 'top', such as '4 m', "
        "make it a bank with 'center' and 'size', or let its 'profile' end with 0"
    )
    return [problem] if endless and document.sun is not None else []


def _uncovered_curves(document: SceneDocument) -> list[str]:
    problems = []
    spectra = {
        f"robots.{name}.rig.sources.{source_name}.spectrum": emission_spectrum(source)
        for name, robot in document.robots.items()
        for source_name, source in robot.rig.sources.items()
    }
    beacons = document.beacons or {}
    # A line of 850 nm sends nothing at 940 nm, and that is known; of a table it is not.
    lines = {f"beacons.{name}.spectrum" for name, one in beacons.items() if one.spectrum.gaussian is not None}
    spectra |= {f"beacons.{name}.spectrum": emission_spectrum(source) for name, source in beacons.items()}
    spectra |= {f"lamps.{name}": emission_spectrum(lamp) for name, lamp in document.lamps.items()}
    if document.sun is not None:
        # Through air it takes pvlib to know, and covers the same.
        spectra["sun"] = constant_curve(1.0, *SILICON_M, "the sun's spectrum")
    for place, spectrum in spectra.items():
        if place in lines:
            continue
        if not spectrum.low_m - _SLACK_M <= BAND_M <= spectrum.high_m + _SLACK_M:
            problems.append(f"{place}: covers {spectrum.range_nm()}, not 940 nm")
    # Of spectra that cover the same the first one tells of all.
    unlike: dict[tuple[float, float], str] = {}
    for place, spectrum in spectra.items():
        unlike.setdefault((spectrum.low_m, spectrum.high_m), place)
    shining = tuple((place, *limits_m) for limits_m, place in unlike.items())
    return problems + [
        f"robots.{name}.rig.cameras.{camera_name}.{problem}"
        for name, robot in document.robots.items()
        for camera_name, camera in robot.rig.cameras.items()
        for problem in _uncovered_by(Same(camera), shining)
    ]


@lru_cache(maxsize=256)
def _uncovered_by(same: Same[Camera], shining: tuple[tuple[str, float, float], ...]) -> tuple[str, ...]:
    """Tell of light that a camera's curves say nothing of: of each place that shines, from and to in m."""
    camera = same.part
    efficiency = camera.sensor.efficiency()
    problems = []
    # At grazing incidence a passband lies farthest to the blue; beyond it the filter blocks.
    band_m = (0.0, math.inf) if camera.filter is None else camera.filter.band_m(0.0)
    for place, *shining_m in shining:
        low_m, high_m = max(shining_m[0], band_m[0]), min(shining_m[1], band_m[1])
        if efficiency.low_m > low_m + _SLACK_M or efficiency.high_m < high_m - _SLACK_M:
            problems.append(
                f"sensor.quantum_efficiency: covers {efficiency.range_nm()}, but {place} shines from "
                f"{range_nm(*shining_m)}; give data for it all"
                + ("" if camera.filter is None else ", or for all that the filter passes")
            )
            break
    known_m = None if camera.filter is None else camera.filter.unblocked_m()
    if known_m is not None:
        problems += [
            f"filter.table: covers {known_m[0] * 1e9:.4g} to {known_m[1] * 1e9:.4g} nm, but {place} shines "
            f"from {range_nm(*shining_m)}; give data for it all, or 'blocking_od', the least optical density "
            "beyond the table"
            for place, *shining_m in shining
            if shining_m[0] < known_m[0] - _SLACK_M or shining_m[1] > known_m[1] + _SLACK_M
        ][:1]
    return tuple(problems)


def _cameras_inside_solids(document: SceneDocument) -> list[str]:
    """Tell of cameras that are in a body at the time of a frame. Meshes are tested when built."""
    carriers = _carriers(document)
    if not carriers:
        return []
    clock = document.clock
    frames_s = clock.start_s + np.arange(clock.frames) / clock.frame_rate_hz
    problems = []
    all_stand = not any(carrier.moves for _, carrier, _ in carriers.values())
    spheres_m = _standing_spheres_m(carriers, frames_s[:1]) if all_stand else None
    for name, robot in document.robots.items():
        # Where the robot stands still, the first frame tells of all.
        times_s = frames_s[:1] if all_stand and not robot.moves else frames_s
        places_m = robot_positions_m(robot, times_s)
        near = list(carriers.items())
        if spheres_m is not None and not robot.moves:
            reaches_m = (float(np.linalg.norm(one.position_m)) for one in robot.rig.cameras.values())
            off_m = np.linalg.norm(spheres_m[:, :3] - places_m[0], axis=1) - spheres_m[:, 3]
            reach_m = max(reaches_m, default=0.0) * (1.0 + _SLACK)
            near = [near[number] for number in np.flatnonzero(off_m <= reach_m)]
        for camera_name, camera in robot.rig.cameras.items():
            met = [
                (*found, place)
                for place, (body, carrier, owner) in near
                if owner != name
                and (found := _first_time_inside(body, carrier, robot, camera, times_s, places_m)) is not None
            ]
            if met:
                time_s, point_m, inside = min(met, key=lambda found: found[0])
                problems.append(
                    f"robots.{name}.rig.cameras.{camera_name}: the camera is inside {inside} "
                    f"at {time_s:g} s, at [{', '.join(f'{x:.4g}' for x in point_m)}] m; move one of them"
                )
    return problems


def _standing_spheres_m(carriers: Mapping[str, tuple[Solid, Moving, str | None]], times_s: Array) -> Array:
    """Return a sphere that holds each body however its carrier is turned, x, y, z, radius: (bodies, 4)."""
    found = []
    for body, carrier, _ in carriers.values():
        center_m, radius_m = bounding_sphere(body)
        if _carries(carrier):
            center_m, radius_m = (
                _carrier_positions_m(carrier, times_s)[0],
                radius_m + float(np.linalg.norm(center_m)),
            )
        found.append([*center_m, radius_m * (1.0 + _SLACK)])
    return np.array(found)


def _first_time_inside(
    body: Solid, carrier: Moving, robot: Robot, camera: Camera, times_s: Array, places_m: Array
) -> tuple[float, Array] | None:
    """Return when, of times, a camera is in a body for the first time, and where it is then.

    `carrier` is what the body moves with. `places_m` is where the camera's robot is, shape (n, 3): only where
    that is near enough is the camera looked for, as this takes the robot's orientation.
    """
    center_m, radius_m = bounding_sphere(body)
    reach_m = (radius_m + float(np.linalg.norm(camera.position_m))) * (1.0 + _SLACK)
    off_m = places_m - center_m
    if _carries(carrier):
        reach_m += float(np.linalg.norm(center_m))
        off_m = places_m - _carrier_positions_m(carrier, times_s)
    near = np.flatnonzero(np.linalg.norm(off_m, axis=-1) <= reach_m)
    for part in np.split(near, range(_MOST_AT_ONCE, len(near), _MOST_AT_ONCE)):
        if len(part) == 0:
            continue
        points_m = camera_positions_m(robot, camera, times_s[part])
        local_m = points_m
        if _carries(carrier):
            off_m = points_m - _carrier_positions_m(carrier, times_s[part])
            local_m = (off_m[:, None, :] @ _carrier_rotations(carrier, times_s[part]))[:, 0]
        inside = np.flatnonzero(contains(body, local_m))
        if len(inside):
            return float(times_s[part[inside[0]]]), points_m[inside[0]]
    return None


def _carriers(document: SceneDocument) -> dict[str, tuple[Solid, Moving, str | None]]:
    """Return closed shapes, what each moves with, and the robot whose body it is, by place."""
    carriers: dict[str, tuple[Solid, Moving, str | None]] = {
        f"shapes.{name}": (body, document.shapes[name], None)
        for name, body in solids(document.shapes).items()
    }
    for robot_name, robot in document.robots.items():
        for name, body in solids(robot.rig.body).items():
            carriers[f"robots.{robot_name}.rig.body.{name}"] = (body, robot, robot_name)
    return carriers


def _carries(carrier: Moving) -> bool:
    """Tell whether what stands on a carrier is written in other axes than the world's."""
    return carrier.moves or isinstance(carrier, Robot)


def _carrier_positions_m(carrier: Moving, times_s: Array) -> Array:
    if isinstance(carrier, Robot):
        return robot_positions_m(carrier, times_s)
    return frame_positions_m(carrier, times_s)


def _carrier_rotations(carrier: Moving, times_s: Array) -> Array:
    return (
        robot_rotations(carrier, times_s) if isinstance(carrier, Robot) else frame_rotations(carrier, times_s)
    )


def _cameras_and_sources_inside_their_own_bodies(document: SceneDocument) -> list[str]:
    """Tell of what is shut in by the body of its own robot: where both are does not depend on the time."""
    problems = []
    for name, robot in document.robots.items():
        rig = robot.rig
        opaque = {
            body: shape
            for body, shape in rig.body.items()
            if not isinstance(document.materials[shape.material], Dielectric)
        }
        parts = [("cameras", one, part.position_m, rig.body) for one, part in rig.cameras.items()]
        parts += [("sources", one, part.position_m, opaque) for one, part in rig.sources.items()]
        for kind, one, position_m, bodies in parts:
            inside = solid_around(bodies, np.array(position_m))
            if inside is not None:
                problems.append(
                    f"robots.{name}.rig.{kind}.{one}: is inside the robot's own body.{inside}, at "
                    f"[{', '.join(f'{x:.4g}' for x in position_m)}] m, and sees or shows nothing; move one "
                    "of them, or make the body of parts that leave it free"
                )
    return problems
