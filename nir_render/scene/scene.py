"""A scene: the document of a scene file, checked, and the world that it describes at any time."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from nir_render.errors import InputError, shown
from nir_render.scene.bodies import shapes_at
from nir_render.scene.checks import check, flat_cylinders
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import Robot, SceneDocument
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.materials import realised
from nir_render.scene.emission import Emitter, light_groups
from nir_render.scene.motion import robot_pose, robot_velocity
from nir_render.scene.overrides import apply_overrides
from nir_render.scene.problems import Places, explain
from nir_render.scene.scatter.place import scattered
from nir_render.scene.snapshot import PlacedRobot, Snapshot


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, read and checked.

    `document` holds everything in SI units; `raw` is the document as written, with includes and overrides
    but before presets; `folder` is where file names in it count from; `path` names it in errors. `kept` is
    the world at the time that was asked for last: cameras look at one time by turns.
    """

    document: SceneDocument
    raw: Mapping[str, Any]
    folder: Path
    path: str
    kept: dict[float, Snapshot] = field(init=False, default_factory=dict, repr=False)

    def with_(self, overrides: Mapping[str, Any]) -> "Scene":
        """Return a copy changed at dotted paths.

        >>> from nir_render import load_scene
        >>> scene = load_scene("scenes/arena.yaml").with_({"fog.visibility": "50 m"})
        >>> round(scene.document.fog.extinction_per_m, 3)
        0.08
        """
        return parse_scene(apply_overrides(self.raw, overrides), self.folder, self.path, overrides)

    def cameras(self) -> list[str]:
        """Return the names, `robot.camera`, of the cameras that take frames."""
        names = [name for selector in self.document.observe for name in self.document.cameras_of(selector)]
        return list(dict.fromkeys(names))

    def camera(self, name: str) -> tuple[Robot, Camera]:
        """Return the robot and the camera named `robot.camera`; raise InputError where there is none."""
        if "." not in name or not self.document.cameras_of(name):
            raise InputError(
                f"{self.path}: there is no camera {shown(name)}; known: {', '.join(self.all_cameras())}"
            )
        robot, camera = name.split(".")
        return self.document.robots[robot], self.document.robots[robot].rig.cameras[camera]

    def all_cameras(self) -> list[str]:
        """Return the names of all cameras, observing or not."""
        return [name for robot in self.document.robots for name in self.document.cameras_of(robot)]

    def sources(self) -> dict[str, tuple[Robot, Source]]:
        """Return robot and source of each light group, by name `robot.source`."""
        return {
            f"{name}.{source_name}": (robot, source)
            for name, robot in self.document.robots.items()
            for source_name, source in robot.rig.sources.items()
        }

    def emitters(self) -> dict[str, Emitter]:
        """Return what each light group is: `robot.source`, `beacons.name`, `lamps.name`, `sun`, `sky`."""
        document = self.document
        spheres = {name: source for name, (_, source) in self.sources().items()}
        spheres |= {f"beacons.{name}": source for name, source in (document.beacons or {}).items()}
        return light_groups(spheres, document.shining_lamps, document.sun, document.skylight)

    def at(self, time_s: float) -> Snapshot:
        """Return the world of this scene at a time, robots where their motions have brought them.

        >>> from nir_render import load_scene
        >>> world = load_scene("scenes/one_source.yaml").at(0.0)
        >>> list(world.robots), world.groups
        (['r1', 'r2'], ('r1.top', 'r2.top'))
        """
        world = self.kept.get(time_s)
        if world is None:
            world = self._at(time_s)
            self.kept.clear()
            self.kept[time_s] = world
        return world

    def _at(self, time_s: float) -> Snapshot:
        document = self.document
        return Snapshot(
            time_s=time_s,
            robots={
                name: PlacedRobot(robot.rig, robot_pose(robot, time_s), robot_velocity(robot, time_s))
                for name, robot in document.robots.items()
            },
            standing=shapes_at(document.shapes, time_s),
            materials={name: realised(material) for name, material in document.materials.items()},
            lamps=document.shining_lamps,
            sun=document.sun,
            fog=document.fog,
            render=document.render,
            seed=document.seed,
            origin=self.path,
            skylight=document.skylight,
            beacons=document.beacons or {},
        )

    def resolved_yaml(self) -> str:
        """Return the document with everything expanded, in SI units; it loads to the same scene."""
        # Scattered robots are among the others, where they stand.
        data = self.document.model_dump(mode="json", by_alias=True, exclude_none=True, exclude={"scatter"})
        for robot in data["robots"].values():
            if robot["motion"] or "path" in robot:
                del robot["position"], robot["orientation"]
            if not robot["motion"]:
                del robot["motion"]
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=110)


def parse_scene(
    raw: Mapping[str, Any], folder: Path = Path(), path: str = "scene", overrides: Iterable[str] = ()
) -> Scene:
    """Return the scene of a document in Python: the mapping that a scene file would hold.

    Parameters
    ----------
    folder
        Where file names in it count from.
    path
        What names it in errors.
    overrides
        The dotted paths that were laid over it, for errors too.

    Raises
    ------
    InputError
        A line per problem.
    """
    try:
        document = SceneDocument.model_validate(raw, context={"folder": folder})
    except ValidationError as error:
        raise InputError(*explain(error, raw, path, overrides)) from None
    problems = flat_cylinders(document) if document.scatter else []  # of these nothing can be kept clear
    if not problems:
        try:
            document = scattered(document)
        except InputError as error:
            problems = list(error.problems)
        else:
            problems = check(document)
    if problems:
        places = Places(path, overrides)
        raise InputError(*(places.tell_of(problem) for problem in problems))
    return Scene(document, raw, folder, path)
