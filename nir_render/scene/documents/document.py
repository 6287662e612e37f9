"""The model of a whole scene file."""

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import (
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from nir_render.errors import shown
from nir_render.geometry import rectangle_frame
from nir_render.scene.documents.ambient.lamps import IlluminanceDocument, Lamp
from nir_render.scene.documents.ambient.sun import Sky, Skylight, Sun
from nir_render.scene.documents.base import Document, Fraction, Name, Positive, Time
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.files import expand_preset, preset_names
from nir_render.scene.documents.fog import Fog
from nir_render.scene.documents.materials import MaterialDocument, is_black
from nir_render.scene.documents.robots.robot import Robot, Scatter
from nir_render.scene.documents.shapes import ShapeDocument, by_material
from nir_render.scene.documents.times.clocks import Clock
from nir_render.scene.documents.times.motion import Waypoint
from nir_render.spectra.lambert import polygon_share

__all__ = ["Clock", "Robot", "SceneDocument", "Waypoint"]

DEFAULT_NOISE = 0.05
_MOST_NAMED = 40  # of what is known, in a message
_LARGEST_SEED = 2**63 - 1
_LEAST_PERCENT, _MOST_PERCENT = 0.1, 100.0
_NOISE_EXAMPLE = "5 % of temporal variance"
_NOISE_FORM = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*%\s+of\s+temporal\s+variance\s*")


def parse_noise(text: object) -> float:
    """Read "5 % of temporal variance" as the share 0.05.

    Raises
    ------
    ValueError
        It is written otherwise, or lies outside 0.1 to 100 %.
    """
    match = _NOISE_FORM.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{shown(text)} is no target for the noise; write it such as {_NOISE_EXAMPLE!r}")
    percent = float(match[1])
    if not _LEAST_PERCENT <= percent <= _MOST_PERCENT:
        raise ValueError(
            f"{shown(text)} lies outside {_LEAST_PERCENT:g} to {_MOST_PERCENT:g} %; take one within"
        )
    return percent / 100.0


def format_noise(share: float) -> str:
    """Write a share so that `parse_noise` reads it."""
    return f"{100.0 * share:.12g} % of temporal variance"


@dataclass(frozen=True)
class _Share:
    """Annotation of a model's field: the target as text in the document, its share in the model."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            parse_noise,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(format_noise),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "pattern": f"^{_NOISE_FORM.pattern}$", "examples": [_NOISE_EXAMPLE]}


NoiseTarget = Annotated[float, _Share()]


CLEAR_DEPTH = 8
"""The longest path in clear air where a scene does not say it."""


class IndirectSettings(Document):
    """How finely light by way of walls and lamps is sampled: pixels of scale × scale, samples in each.

    Without `samples` the render settings' `noise` says how many each pixel gets. While something moves it is
    rendered for each frame; with `every` so often, and interpolated between; with `error` as often as keeps
    the error of interpolating below that share, and below 0.2 % of any flare's flux. `max_depth` is the most
    stretches of a path; without, 8 in clear air, and in fog what its optical depth asks for.
    """

    example: ClassVar[str] = "{samples: 64}"

    scale: Annotated[int, Field(ge=1, le=16)] = 2
    samples: Annotated[int, Field(ge=4, le=65536)] | None = None
    max_depth: Annotated[int, Field(ge=2, le=256)] | None = None
    every_s: Annotated[Time, Positive] | None = None
    error: NoiseTarget | None = None

    @field_validator("samples")
    @classmethod
    def _power_of_two(cls, samples: int | None) -> int | None:
        if samples is not None and samples & (samples - 1):
            lower = 1 << (samples.bit_length() - 1)
            raise ValueError(
                f"{samples} is no power of two: only these render to the same bits on any machine; "
                f"take {lower} or {2 * lower}"
            )
        return samples

    @model_validator(mode="after")
    def _one_way_to_refresh(self) -> Self:
        if self.every_s is not None and self.error is not None:
            raise ValueError("'every' fixes how often light is rendered, 'error' finds it: write one of them")
        return self


class WavelengthSettings(Document):
    """Wavelengths that light is carried at where materials vary: few that keep `error`, at most `most`."""

    example: ClassVar[str] = "{error: 0.1 %}"

    error: Annotated[Fraction, Field(ge=1e-6, le=1)] = 1e-3
    most: Annotated[int, Field(ge=1, le=64)] = 24


class RenderSettings(Document):
    """How finely the transport of light is sampled.

    `noise` is the target: the variance that rendering may add, as a share of shot and read noise; 5 % unless
    `indirect.samples` fixes a count, then None.
    """

    example: ClassVar[str] = '{noise: "5 % of temporal variance"}'

    noise: NoiseTarget | None = None
    indirect: IndirectSettings = IndirectSettings()
    wavelengths: WavelengthSettings = WavelengthSettings()
    visibility_rays: Annotated[int, Field(ge=16, le=65536)] = 1024

    @model_validator(mode="before")
    @classmethod
    def _noise_is_no_switch(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and isinstance(data.get("noise"), bool):  # YAML's off and on
            raise ValueError(
                "'noise' is a target, no switch: write it such as '5 % of temporal variance', or leave it "
                "out and fix the samples in its place, such as indirect: {samples: 64}"
            )
        return data

    @model_validator(mode="after")
    def _target_or_count(self) -> Self:
        if self.noise is not None and self.indirect.samples is not None:
            raise ValueError(
                "'noise' is a target, 'indirect.samples' a fixed count: write one of them, "
                "or set the other to null"
            )
        if self.noise is None and self.indirect.samples is None:
            object.__setattr__(self, "noise", DEFAULT_NOISE)
        return self


class SceneDocument(Document):
    """A scene: robots with sources and cameras, surroundings, and when frames are taken by whom.

    `beacons` are what others let shine: spheres as robots' sources are, where the scene puts them. `scatter`
    adds groups of robots at random free places.
    """

    format: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. -]{0,99}$")] = "scene"
    seed: Annotated[int, Field(ge=0, le=_LARGEST_SEED)] = 0
    clock: Clock = Clock()
    render: RenderSettings = RenderSettings()
    observe: Annotated[tuple[str, ...], Field(min_length=1)]
    robots: dict[Name, Robot] = {}
    scatter: dict[Name, Scatter] | None = None
    materials: dict[Name, MaterialDocument] = {}
    shapes: dict[Name, ShapeDocument] = {}
    lamps: dict[Name, Lamp] = {}
    illuminance: IlluminanceDocument | None = None
    sun: Sun | None = None
    sky: Sky | None = None
    beacons: dict[Name, Source] | None = None
    fog: Fog | None = None

    @model_validator(mode="before")
    @classmethod
    def _expand_materials(cls, data: Any, info: ValidationInfo) -> Any:
        """Let materials stand on a preset of `data/materials`, and shapes name one that the scene does not.

        `wall: concrete`, `wall: {preset: concrete, deviation: 1}`; what is called as a preset and is of no
        type of its own is that one, changed: `concrete: {deviation: 1}`.
        """
        if not isinstance(data, dict) or not isinstance(data.get("materials") or {}, dict):
            return data
        folder = info.context["folder"] if info.context else Path()
        known = set(preset_names("materials"))
        materials = dict(data.get("materials") or {})
        for name, written in materials.items():
            if isinstance(written, dict) and not written.keys() & {"type", "preset"} and name in known:
                written = {"preset": name, **written}
            try:
                materials[name] = expand_preset(written, "materials", folder)
            except ValueError as error:
                place = name if re.fullmatch(r"[\w-]{1,100}", str(name)) else shown(name)
                raise ValueError(f"materials.{place}: {error}") from None
        named: set[str] = set()
        for shape in data["shapes"].values() if isinstance(data.get("shapes"), dict) else ():
            if isinstance(shape, dict):
                of_slots = shape.get("materials")
                named |= {str(shape.get("material"))}
                named |= set(map(str, of_slots.values())) if isinstance(of_slots, dict) else set()
        for name in sorted(named & known - set(materials)):
            materials[name] = expand_preset(name, "materials", folder)
        return {**data, "materials": materials} if materials else data

    @model_validator(mode="after")
    def _add_scattered_robots(self) -> Self:
        """Add them at the origin: `scene.scatter.place` finds their places once all else is read."""
        added: dict[str, Robot] = {}
        for group, scatter in (self.scatter or {}).items():
            for name in scatter.names(group):
                if name in self.robots or name in added:
                    raise ValueError(
                        f"scatter.{group}: there is a robot {name!r} already; rename one of them"
                    )
                added[name] = Robot.model_construct(rig=scatter.rig)
        if not self.robots and not added:
            raise ValueError("robots: there is none; write such as robots: {r1: {rig: infra_swarm}}")
        if added:
            object.__setattr__(self, "robots", {**self.robots, **added})
        return self

    @model_validator(mode="after")
    def _expand_materials_of_bodies(self, info: ValidationInfo) -> Self:
        """Let the bodies of rigs name presets too: rigs may be presets themselves, so these come last."""
        named = {shape.material for shape in self.all_shapes().values()} - set(self.materials)
        found = {
            name: expand_preset(name, "materials", info.context["folder"] if info.context else Path())
            for name in sorted(named & set(preset_names("materials")))
        }
        if found:
            read = TypeAdapter(dict[Name, MaterialDocument]).validate_python(found, context=info.context)
            object.__setattr__(self, "materials", {**self.materials, **read})
        return self

    @model_validator(mode="after")
    def _names_exist(self) -> Self:
        for place, shape in self.all_shapes().items():
            if shape.material not in self.materials:
                names = list(dict.fromkeys([*self.materials, *preset_names("materials")]))
                near = difflib.get_close_matches(shape.material, names, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names)}"
                raise ValueError(f"{place}.material: there is no material {shown(shape.material)}; {hint}")
        for name in self.observe:
            if not self.cameras_of(name):
                names = [
                    f"{robot}.{camera}" for robot in self.robots for camera in self.robots[robot].rig.cameras
                ]
                known = ", ".join(names[:_MOST_NAMED])
                known += f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
                raise ValueError(
                    f"observe: there is no robot or camera {shown(name)}; known cameras: {known or 'none'}"
                )
        return self

    @model_validator(mode="after")
    def _sky_has_its_sun(self) -> Self:
        if self.sky is None:
            return self
        if self.sun is None or (self.sun.air is None and self.sky.irradiance_w_per_m3 is None):
            raise ValueError(
                "sky: its light follows from the sun's place and 'air'; write such as sun: {azimuth: 30 deg, "
                "elevation: 40 deg, air: g173} (clouds: 0 hides its disc)"
            )
        return self

    @model_validator(mode="after")
    def _lamps_reach_the_plane(self) -> Self:
        if self.illuminance is None:
            return self
        messengers = [name for name, lamp in self.lamps.items() if lamp.drive.mean is None]
        if messengers:
            raise ValueError(
                f"illuminance: the lamp {messengers[0]!r} sends messages, which have no mean; leave "
                "'illuminance' out and write its 'luminous_flux'"
            )
        if not self.written_illuminance_lx > 0.0:
            raise ValueError(
                "illuminance: no lamp shines on the plane; add one in front of it, or move or turn the plane"
            )
        return self

    @cached_property
    def written_illuminance_lx(self) -> float:
        """What lamps, as they are written, bring to the plane of `illuminance` directly; 0 without one."""
        plane = self.illuminance
        return 0.0 if plane is None else sum(_brought_lx(lamp, plane) for lamp in self.lamps.values())

    @property
    def skylight(self) -> Skylight | None:
        """The sky under its sun, None without one."""
        if self.sky is None:
            return None
        assert self.sun is not None  # a sky without a sun has been refused
        return Skylight.model_construct(sky=self.sky, sun=self.sun)

    @cached_property
    def shining_lamps(self) -> dict[str, Lamp]:
        """The lamps, scaled to `illuminance` where there is one."""
        if self.illuminance is None:
            return self.lamps
        factor = self.illuminance.level_lx / self.written_illuminance_lx
        return {
            name: lamp.model_copy(update={"luminous_flux_lm": factor * lamp.luminous_flux_lm})
            for name, lamp in self.lamps.items()
        }

    def cameras_of(self, selector: str) -> list[str]:
        """Return the cameras, `robot.camera`, that `r1` or `r1.front` selects; empty where there are none."""
        robot, _, camera = selector.partition(".")
        if robot not in self.robots:
            return []
        cameras = self.robots[robot].rig.cameras
        if camera:
            return [selector] if camera in cameras else []
        return [f"{robot}.{name}" for name in cameras]

    def all_shapes(self) -> dict[str, ShapeDocument]:
        """Return the scene's shapes and those of the robots' bodies, by their place; each of one material."""
        bodies = {
            f"robots.{robot}.rig.body.{name}": shape
            for robot, carrier in self.robots.items()
            for name, shape in carrier.rig.body.items()
        }
        return by_material({f"shapes.{name}": shape for name, shape in self.shapes.items()} | bodies)

    def has_indirect_light(self) -> bool:
        """Tell whether light comes other than straight from sources: from a lamp, off a body, off fog."""
        sources = bool(self.beacons) or any(robot.rig.sources for robot in self.robots.values())
        if not (sources or self.lamps or self.sun is not None):
            return False
        if self.lamps or self.sky is not None:
            return True
        return reflects_or_scatters(self.all_shapes(), self.materials, self.fog)

    def frame_times_s(self) -> list[float]:
        """Return the start of each frame's exposure."""
        return [self.clock.start_s + index / self.clock.frame_rate_hz for index in range(self.clock.frames)]


def _brought_lx(lamp: Lamp, plane: IlluminanceDocument) -> float:
    half_u_m, half_v_m, normal = rectangle_frame(lamp.normal, lamp.size_m, 0.0).T
    corners_m = np.array(lamp.center_m) + [
        u * half_u_m + v * half_v_m for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    facing = np.array(plane.facing) / np.linalg.norm(plane.facing)
    share = polygon_share(corners_m, normal, np.array(plane.at_m), facing)
    assert lamp.drive.mean is not None  # messengers have been refused
    return lamp.drive.mean * lamp.luminous_flux_lm / (lamp.size_m[0] * lamp.size_m[1]) * share


def reflects_or_scatters(
    shapes: Mapping[str, ShapeDocument], materials: Mapping[str, MaterialDocument], fog: Fog | None
) -> bool:
    """Tell whether any body reflects or passes light, or fog scatters it."""
    used = [materials[name] for name in {shape.material for shape in shapes.values()}]
    absorbing = all(is_black(material) for material in used)
    return not absorbing or (fog is not None and fog.albedo * fog.extinction_per_m > 0.0)
