"""The world at one time: where everything stands, and what everyone sends.

`Scene.at` makes a snapshot from the motions of a scene file; who moves robots himself makes the next one from
it. Transport and camera know the world by snapshots alone.

    world = scene.at(0.0)
    world = world.moved({"r2": Pose.of((3.0, 0.5, 0.0), yaw_rad=0.1)}, time_s=0.1)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from nir_render.errors import InputError, shown
from nir_render.scene.bodies import body_shapes
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.camera import Camera, Rig
from nir_render.scene.documents.document import RenderSettings, reflects_or_scatters
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.fog import Fog
from nir_render.scene.documents.materials import MaterialDocument, at_wavelength, curves_of
from nir_render.scene.documents.shapes import ShapeDocument
from nir_render.scene.documents.times.drives import Drive, SourceDrive
from nir_render.scene.emission import Emitter, light_groups
from nir_render.scene.motion import Velocity
from nir_render.scene.pose import Pose, camera_mount, source_mount
from nir_render.scene.problems import explain
from nir_render.scene.text.units import LENGTH

_SOURCE_DRIVE: TypeAdapter[Drive] = TypeAdapter(SourceDrive)


@dataclass(frozen=True, eq=False)
class PlacedRobot:
    """What a robot carries, the pose of its body in the world, and how that changes: None where it rests."""

    rig: Rig
    pose: Pose
    velocity: Velocity | None = None


@dataclass(frozen=True, eq=False)
class PlacedSource:
    """A source with its drive, and the pose of its own axes in the world."""

    source: Source
    pose: Pose


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera, and the pose of its axes (x right, y down, z forward) in the world."""

    camera: Camera
    pose: Pose


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The world at `time_s`.

    Attributes
    ----------
    robots
        Rig and pose of each robot, by name.
    standing, materials
        Bodies that no robot carries, where they are, and what bodies are made of, by name.
    lamps, sun, fog
        What else shines, and what the air holds.
    skylight
        The sky under its sun, None where there is none.
    beacons
        Sources that stand in the world and are no robot's, by name.
    render
        How finely transport samples.
    seed
        Of what is rendered of it where no other is given.
    origin
        What it was made from, for error messages: the path of a scene file.
    """

    time_s: float
    robots: Mapping[str, PlacedRobot]
    standing: Mapping[str, ShapeDocument]
    materials: Mapping[str, MaterialDocument]
    lamps: Mapping[str, Lamp]
    sun: Sun | None
    fog: Fog | None
    render: RenderSettings
    seed: int = 0
    origin: str = "snapshot"
    skylight: Skylight | None = None
    beacons: Mapping[str, Source] = field(default_factory=dict)

    @cached_property
    def shapes(self) -> Mapping[str, ShapeDocument]:
        """All bodies where they are, by name: those that stand, then `robot.body.shape`."""
        shapes = dict(self.standing)
        for name, robot in self.robots.items():
            shapes |= body_shapes(name, robot.rig.body, robot.pose)
        return shapes

    @cached_property
    def sources(self) -> Mapping[str, PlacedSource]:
        """All spheres that shine, the first of the light groups: `robot.source`, then `beacons.name`."""
        standing = {
            f"beacons.{name}": PlacedSource(source, source_mount(source))
            for name, source in self.beacons.items()
        }
        return {**self.carried_sources, **standing}

    @cached_property
    def carried_sources(self) -> Mapping[str, PlacedSource]:
        """The sources of all robots, by `robot.source`."""
        return {
            f"{name}.{source_name}": PlacedSource(source, robot.pose @ source_mount(source))
            for name, robot in self.robots.items()
            for source_name, source in robot.rig.sources.items()
        }

    @cached_property
    def emitters(self) -> Mapping[str, Emitter]:
        """What each light group is, by name: `robot.source`, `beacons.name`, `lamps.name`, `sun`, `sky`."""
        spheres = {name: placed.source for name, placed in self.sources.items()}
        return light_groups(spheres, self.lamps, self.sun, self.skylight)

    @property
    def groups(self) -> tuple[str, ...]:
        """The names of the light groups, in order."""
        return tuple(self.emitters)

    def camera(self, name: str) -> PlacedCamera:
        """Return the camera named `robot.camera`; raise InputError where there is none."""
        robot_name, _, camera_name = name.partition(".")
        robot = self.robots.get(robot_name)
        if robot is None or camera_name not in robot.rig.cameras:
            known = ", ".join(
                f"{who}.{one}" for who, placed in self.robots.items() for one in placed.rig.cameras
            )
            raise InputError(f"{self.origin}: there is no camera {shown(name)}; known: {known or 'none'}")
        camera = robot.rig.cameras[camera_name]
        return PlacedCamera(camera, robot.pose @ camera_mount(camera))

    def has_indirect_light(self) -> bool:
        """Tell whether light comes other than straight from sources: from a lamp, off a body, off fog."""
        if not self.emitters:
            return False
        if self.lamps or self.skylight is not None:
            return True
        return reflects_or_scatters(self.shapes, self.materials, self.fog)

    def as_fast_as(self, other: "Snapshot") -> bool:
        """Tell whether all robots go as fast in another world: else their flares are drawn out otherwise."""
        pairs = [(other.robots[name].velocity, robot.velocity) for name, robot in self.robots.items()]
        return all(
            (one is None) == (its is None)
            and (
                one is None
                or its is None
                or (
                    np.array_equal(one.linear_m_per_s, its.linear_m_per_s)
                    and np.array_equal(one.angular_rad_per_s, its.angular_rad_per_s)
                )
            )
            for one, its in pairs
        )

    def at_wavelength(self, wavelength_m: float) -> "Snapshot":
        """Return the world as it is at one wavelength: materials of numbers alone."""
        if not any(curves_of(material) for material in self.materials.values()):
            return self
        materials = {name: at_wavelength(known, wavelength_m) for name, known in self.materials.items()}
        return replace(self, materials=materials)

    def moved(
        self,
        poses: Mapping[str, Pose],
        time_s: float | None = None,
        velocities: Mapping[str, Velocity] | None = None,
    ) -> "Snapshot":
        """Return the world with robots at other poses, by name, and at another time.

        Robots that are moved rest there, unless `velocities` says how fast they go: their flares are drawn
        out along their way in the exposure.

        >>> from nir_render import Pose, load_scene
        >>> world = load_scene("scenes/one_source.yaml").at(0.0)
        >>> world = world.moved({"r2": Pose.of((3.0, 0.5, 0.0))}, time_s=0.1)
        >>> world.sources["r2.top"].pose.position_m
        array([3.  , 0.5 , 0.28])

        Raises
        ------
        InputError
            There is no such robot; a pose is none, not finite, too far off, or no rotation.
        """
        robots = {
            name: replace(
                self._robot(name), pose=self._sound(name, pose), velocity=(velocities or {}).get(name)
            )
            for name, pose in poses.items()
        }
        return replace(
            self, robots={**self.robots, **robots}, time_s=self.time_s if time_s is None else time_s
        )

    def sending(self, drives: Mapping[str, Any]) -> "Snapshot":
        """Return the world with sources, by `robot.source`, that send something else.

        A drive is a `Drive`, or what a scene file may say: 0.5, {"bits": {"pattern": "01", "rate": "10 Hz"}}.

        Raises
        ------
        InputError
            There is no such source, or a drive is none.
        """
        robots = dict(self.robots)
        for name, drive in drives.items():
            robot_name, _, source_name = name.partition(".")
            if name not in self.carried_sources:
                known = ", ".join(self.carried_sources) or "none"
                raise InputError(f"{self.origin}: there is no source {shown(name)}; known: {known}")
            rig = robots[robot_name].rig
            source = rig.sources[source_name].model_copy(update={"drive": self._drive(name, drive)})
            rig = rig.model_copy(update={"sources": {**rig.sources, source_name: source}})
            robots[robot_name] = replace(robots[robot_name], rig=rig)
        return replace(self, robots=robots)

    def _robot(self, name: str) -> PlacedRobot:
        if name not in self.robots:
            known = ", ".join(self.robots)
            raise InputError(f"{self.origin}: there is no robot {shown(name)}; known: {known}")
        return self.robots[name]

    def _sound(self, name: str, pose: Pose) -> Pose:
        """Return a pose that something can stand at, or raise InputError."""
        what = f"{self.origin}: the pose of {name}"
        if not isinstance(pose, Pose):
            raise InputError(f"{what} is {shown(pose)}; wanted a Pose, such as Pose.of((1.0, 2.0, 0.0))")
        place, turn = np.asarray(pose.position_m, dtype=float), np.asarray(pose.rotation, dtype=float)
        if place.shape != (3,) or not (np.abs(place) <= LENGTH.most).all():
            raise InputError(
                f"{what}: its position is {place}; wanted three finite metres, to ±{LENGTH.most:g}"
            )
        if (
            turn.shape != (3, 3)
            or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-9)
            or np.linalg.det(turn) < 0
        ):
            raise InputError(f"{what}: its rotation is no rotation matrix; Pose.of makes one of three angles")
        return pose

    def _drive(self, name: str, drive: Any) -> Drive:
        try:
            return _SOURCE_DRIVE.validate_python(drive)
        except ValidationError as error:
            raise InputError(*explain(error, drive, f"{self.origin}: the drive of {name}")) from None
