"""What no single field can tell: cameras inside solids, exposures longer than the clock leaves, ..."""

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.emission import emission_spectrum
from nir_render.camera.response import efficiency_of
from nir_render.camera.shutter import row_delay_s
from nir_render.scene.devices import Camera
from nir_render.scene.document import SceneDocument
from nir_render.scene.motion import camera_pose, rotation_of
from nir_render.scene.world import Box, Cylinder, Dielectric, Pane, Rectangle, ShapeDocument, Sphere

_BAND_M = 940e-9
_SLACK_M = 1e-15  # what float64 rounds away
_SLACK = 1e-9


def check(document: SceneDocument) -> list[str]:
    """Return one line per problem of a document whose fields are right one by one."""
    return [
        *_flat_cylinders(document),
        *_sheets_and_solids(document),
        *_fog_up_to_the_sun(document),
        *_indivisible_sensors(document),
        *_exposures_beyond_the_clock(document),
        *_uncovered_curves(document),
        *_cameras_inside_solids(document),
    ]


def _indivisible_sensors(document: SceneDocument) -> list[str]:
    problems = [indivisible_sensor(document, name) for name in _observing(document)]
    return [problem for problem in problems if problem is not None]


def _observing(document: SceneDocument) -> dict[str, Camera]:
    """Return the cameras that take frames, by `robot.camera`."""
    names = dict.fromkeys(name for selector in document.observe for name in document.cameras_of(selector))
    return {name: _camera_of(document, name) for name in names}


def _camera_of(document: SceneDocument, name: str) -> Camera:
    robot, camera = name.split(".")
    return document.robots[robot].rig.cameras[camera]


def indivisible_sensor(document: SceneDocument, name: str) -> str | None:
    """Return what is wrong where the pixels of the indirect light do not fit the sensor of `robot.camera`."""
    sensor = _camera_of(document, name).sensor
    scale = document.render.indirect.scale
    if not document.has_indirect_light() or not (sensor.columns % scale or sensor.rows % scale):
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
    period_s = (1.0 + _SLACK) / document.clock.frame_rate_hz
    period = f"{1e3 / document.clock.frame_rate_hz:.4g} ms"
    mend = "shorten it, or lower clock.frame_rate"
    for name, camera in _observing(document).items():
        robot, camera_name = name.split(".")
        place = f"robots.{robot}.rig.cameras.{camera_name}"
        rows, auto = camera.sensor.rows, camera.auto_exposure
        read_out_s = rows * row_delay_s(camera)
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


def _longest_exposures_s(camera: Camera) -> dict[str, float]:
    """Return the longest exposure that each field lets a camera take."""
    if camera.bracket is not None:
        return {"bracket": max(camera.bracket)}
    if camera.auto_exposure is not None:
        return {"exposure": camera.exposure_s, "auto_exposure.longest": camera.auto_exposure.longest_s}
    return {"exposure": camera.exposure_s}


def _flat_cylinders(document: SceneDocument) -> list[str]:
    return [
        f"shapes.{name}: start and end of the cylinder are the same point"
        for name, shape in document.shapes.items()
        if isinstance(shape, Cylinder) and shape.start_m == shape.end_m
    ]


def _sheets_and_solids(document: SceneDocument) -> list[str]:
    problems = []
    for name, shape in document.shapes.items():
        material = document.materials[shape.material]
        if isinstance(material, Pane) and not isinstance(shape, Rectangle):
            problems.append(
                f"shapes.{name}.material: {shape.material!r} is a pane, a thin sheet: only a rectangle can "
                f"be of it, not a {shape.type}; solid glass is of the type 'dielectric'"
            )
        if isinstance(material, Dielectric) and isinstance(shape, Rectangle):
            problems.append(
                f"shapes.{name}.material: {shape.material!r} is a solid dielectric, and a rectangle has no "
                "inside; use the type 'pane' for a sheet of glass, or a box"
            )
    return problems


def _fog_up_to_the_sun(document: SceneDocument) -> list[str]:
    fog = document.fog
    endless = fog is not None and fog.extinction_per_m > 0.0 and fog.top_m is None and fog.size_m is None
    problem = (
        "fog: has no end on the way to the sun, so that the sun is black; give it a 'top', such as '4 m', "
        "or make it a bank with 'center' and 'size'"
    )
    return [problem] if endless and document.sun is not None else []


def _uncovered_curves(document: SceneDocument) -> list[str]:
    problems = []
    spectra = {
        f"robots.{name}.rig.sources.{source_name}.spectrum": emission_spectrum(source)
        for name, robot in document.robots.items()
        for source_name, source in robot.rig.sources.items()
    }
    spectra |= {f"lamps.{name}": emission_spectrum(lamp) for name, lamp in document.lamps.items()}
    if document.sun is not None:
        spectra["sun"] = emission_spectrum(document.sun)
    for place, spectrum in spectra.items():
        if not spectrum.low_m - _SLACK_M <= _BAND_M <= spectrum.high_m + _SLACK_M:
            problems.append(f"{place}: covers {spectrum.range_nm()}, not 940 nm")
    for name, robot in document.robots.items():
        for camera_name, camera in robot.rig.cameras.items():
            efficiency = efficiency_of(camera)
            for place, spectrum in spectra.items():
                if (
                    efficiency.low_m > spectrum.low_m + _SLACK_M
                    or efficiency.high_m < spectrum.high_m - _SLACK_M
                ):
                    problems.append(
                        f"robots.{name}.rig.cameras.{camera_name}.sensor.quantum_efficiency: covers "
                        f"{efficiency.range_nm()}, but {place} shines from "
                        f"{spectrum.range_nm()}; give data for it all"
                    )
                    break
    return problems


def _cameras_inside_solids(document: SceneDocument) -> list[str]:
    problems = []
    for name, robot in document.robots.items():
        for camera_name, camera in robot.rig.cameras.items():
            for time_s in document.frame_times_s():
                point_m = camera_pose(robot, camera, time_s).position_m
                inside = solid_around(document, point_m)
                if inside is not None:
                    problems.append(
                        f"robots.{name}.rig.cameras.{camera_name}: the camera is inside shapes.{inside} "
                        f"at {time_s:g} s, at [{', '.join(f'{x:.4g}' for x in point_m)}] m; move one of them"
                    )
                    break
    return problems


def solid_around(document: SceneDocument, point_m: NDArray[np.float64]) -> str | None:
    """Return the name of a closed shape that holds a point, or None. Meshes are tested when built."""
    return next((name for name, body in document.shapes.items() if _contains(body, point_m)), None)


def _contains(body: ShapeDocument, point_m: NDArray[np.float64]) -> bool:
    match body:
        case Sphere():
            return float(np.linalg.norm(point_m - body.center_m)) < body.radius_m
        case Box():
            local_m = (point_m - body.center_m) @ rotation_of(body.orientation)
            return bool((np.abs(local_m) < 0.5 * np.array(body.size_m)).all())
        case Cylinder():
            axis = np.subtract(body.end_m, body.start_m)
            along = float((point_m - body.start_m) @ axis / (axis @ axis))
            off_m = float(np.linalg.norm(point_m - body.start_m - along * axis))
            return 0.0 < along < 1.0 and off_m < body.radius_m
    return False
