"""Scenes on which the light-group integrator is held against Mitsuba's own: text of scene files.

Sources are 8 to 20 cm large, because Mitsuba's sphere light loses digits where it is small and far. All of
them are either wholly in the camera's view or wholly out of it: the share that the direct table holds of a
partly hidden one is sampled by rays, and would be seen here.
"""

from pathlib import Path
from typing import Any

import yaml

from nir_render import Scene, load_scene

WIDTH_PX, HEIGHT_PX = 160, 120
FOCAL_PX, SIGMA_PX = 80.0, 0.7

_HEAD = """
format: 1
observe: [r1.c]
render: {indirect: {scale: 1, samples: 64, max_depth: 8}}
"""

_CAMERA = """{rig: {cameras: {c: {
    lens: {focal_length: 1.8 mm, f_number: 2.0, transmission: 0.9},
    sensor: {columns: 160, rows: 120, pixel_pitch: 22.5 um, quantum_efficiency: 0.15, full_well: 1.0e+7 e,
             read_noise: 1 e, system_gain: 0.0004 DN/e, black_level: 10 DN, bit_depth: 12 bit},
    point_spread: {sigma: 0.7 px}, exposure: 1 ms}}}, position: "%s m"}"""


def _camera(position: str) -> str:
    return _CAMERA % position


def _source(position: str, radius: str = "8 cm") -> str:
    spectrum = "{gaussian: {centroid: 940 nm, fwhm: 42 nm}}"
    return f'{{rig: {{sources: {{s: {{flux: 1 W, radius: {radius}, spectrum: {spectrum}}}}}}}, position: "{position} m"}}'


DIFFUSE_ROOM = f"""{_HEAD}
robots:
  r1: {_camera("[0.4, -0.3, 1.1]")}
  r2: {_source("[2.4, 1.1, 0.5]")}
  r3: {_source("[3.0, -1.0, 1.4]")}
  r4: {_source("[3.6, 0.8, 0.3]")}
materials:
  white: {{type: diffuse, reflectance: 0.8}}
  grey: {{type: diffuse, reflectance: 0.4}}
shapes:
  floor: {{type: rectangle, center: "[2.5, 0, 0] m", size: "[5, 4] m", normal: [0, 0, 1], material: grey}}
  ceiling: {{type: rectangle, center: "[2.5, 0, 2.5] m", size: "[5, 4] m", normal: [0, 0, -1], material: white}}
  front: {{type: rectangle, center: "[5, 0, 1.25] m", size: "[4, 2.5] m", normal: [-1, 0, 0], material: white}}
  back: {{type: rectangle, center: "[0, 0, 1.25] m", size: "[4, 2.5] m", normal: [1, 0, 0], material: grey}}
  left: {{type: rectangle, center: "[2.5, 2, 1.25] m", size: "[5, 2.5] m", normal: [0, -1, 0], material: white}}
  right: {{type: rectangle, center: "[2.5, -2, 1.25] m", size: "[5, 2.5] m", normal: [0, 1, 0], material: grey}}
  crate: {{type: box, center: "[2.9, -0.3, 0.35] m", size: "[0.5, 0.5, 0.7] m", orientation: {{yaw: 25 deg}}, material: white}}
lamps:
  one: {{center: "[2.5, 0.3, 2.4] m", size: "[0.6, 0.4] m", luminous_flux: 3000 lm, temperature: 2856 K}}
"""

GLOSSY_CORRIDOR = f"""{_HEAD}
robots:
  r1: {_camera("[0.2, 0.1, 1.0]")}
  r2: {_source("[2.2, 0.5, 0.8]")}
  r3: {_source("[3.0, -0.5, 1.5]")}
  r4: {_source("[3.8, 0.2, 0.4]")}
materials:
  metal: {{type: rough_conductor, index: 1.4, extinction_index: 9.2, roughness: 0.25}}
  brushed: {{type: rough_conductor, index: 1.4, extinction_index: 9.2, roughness: 0.5}}
  gloss: {{type: plastic, index: 1.5, reflectance: 0.3, roughness: 0.2}}
  white: {{type: diffuse, reflectance: 0.7}}
shapes:
  floor: {{type: rectangle, center: "[3, 0, 0] m", size: "[6, 2] m", normal: [0, 0, 1], material: gloss}}
  ceiling: {{type: rectangle, center: "[3, 0, 2.2] m", size: "[6, 2] m", normal: [0, 0, -1], material: brushed}}
  left: {{type: rectangle, center: "[3, 1, 1.1] m", size: "[6, 2.2] m", normal: [0, -1, 0], material: metal}}
  right: {{type: rectangle, center: "[3, -1, 1.1] m", size: "[6, 2.2] m", normal: [0, 1, 0], material: gloss}}
  front: {{type: rectangle, center: "[6, 0, 1.1] m", size: "[2, 2.2] m", normal: [-1, 0, 0], material: white}}
"""

MIRROR_ROOM = f"""{_HEAD}
robots:
  r1: {_camera("[0, -0.6, 1.0]")}
  r2: {_source("[2.2, 0.2, 0.7]", "20 cm")}
  r3: {_source("[3.2, -1.4, 1.3]", "20 cm")}
materials:
  white: {{type: diffuse, reflectance: 0.7}}
  silver: {{type: mirror, reflectance: 0.9}}
shapes:
  floor: {{type: rectangle, center: "[2.5, 0, 0] m", size: "[5, 4] m", normal: [0, 0, 1], material: white}}
  front: {{type: rectangle, center: "[5, 0, 1.25] m", size: "[4, 2.5] m", normal: [-1, 0, 0], material: white}}
  left: {{type: rectangle, center: "[2.5, 2, 1.25] m", size: "[5, 2.5] m", normal: [0, -1, 0], material: white}}
  mirror: {{type: rectangle, center: "[4.95, -0.3, 1.1] m", size: "[2.8, 1.8] m", normal: [-1, 0, 0], material: silver}}
lamps:
  one: {{center: "[2.5, -0.5, 2.4] m", size: "[0.6, 0.6] m", luminous_flux: 3000 lm, temperature: 2856 K}}
"""

OCCLUDERS = f"""{_HEAD}
robots:
  r1: {_camera("[0, 0, 0.8]")}
  r2: {_source("[2.6, 0.8, 0.9]")}
  r3: {_source("[3.0, -0.4, 0.5]")}
  r4: {_source("[2.4, -1.3, 0.3]", "6 cm")}
materials:
  white: {{type: diffuse, reflectance: 0.7}}
  grey: {{type: diffuse, reflectance: 0.35}}
shapes:
  floor: {{type: rectangle, center: "[2.5, 0, 0] m", size: "[5, 5] m", normal: [0, 0, 1], material: white}}
  front: {{type: rectangle, center: "[4.5, 0, 1.5] m", size: "[5, 3] m", normal: [-1, 0, 0], material: grey}}
  post: {{type: cylinder, start: "[1.6, 0.5, 0] m", end: "[1.6, 0.5, 1.8] m", radius: 15 cm, material: grey}}
  ball: {{type: sphere, center: "[2.2, -0.3, 0.5] m", radius: 30 cm, material: white}}
  small: {{type: sphere, center: "[2.9, 1.3, 0.3] m", radius: 25 cm, material: grey}}
  crate: {{type: box, center: "[3.3, 0.3, 0.3] m", size: "[0.5, 0.7, 0.6] m", orientation: {{yaw: -20 deg}}, material: white}}
  # A box open to the front, with a source in it.
  bottom: {{type: rectangle, center: "[2.4, -1.3, 0.05] m", size: "[0.6, 0.6] m", normal: [0, 0, 1], material: white}}
  top: {{type: rectangle, center: "[2.4, -1.3, 0.55] m", size: "[0.6, 0.6] m", normal: [0, 0, 1], material: white}}
  near: {{type: rectangle, center: "[2.4, -1.0, 0.3] m", size: "[0.6, 0.5] m", normal: [0, 1, 0], material: white}}
  far: {{type: rectangle, center: "[2.4, -1.6, 0.3] m", size: "[0.6, 0.5] m", normal: [0, 1, 0], material: white}}
  end: {{type: rectangle, center: "[2.7, -1.3, 0.3] m", size: "[0.6, 0.5] m", normal: [1, 0, 0], material: white}}
"""

THIN_FOG = f"""{_HEAD}
fog: {{extinction: "0.05 /m", albedo: 0.9995, phase: {{type: henyey_greenstein, g: 0.85}}}}
robots:
  r1: {_camera("[0, 0, 1.0]")}
  r2: {_source("[2.4, 0.8, 0.6]")}
  r3: {_source("[3.2, -0.9, 1.2]")}
materials:
  white: {{type: diffuse, reflectance: 0.7}}
  gloss: {{type: plastic, index: 1.5, reflectance: 0.3, roughness: 0.3}}
shapes:
  floor: {{type: rectangle, center: "[2.5, 0, 0] m", size: "[6, 5] m", normal: [0, 0, 1], material: gloss}}
  front: {{type: rectangle, center: "[5, 0, 1] m", size: "[3, 2] m", normal: [-1, 0, 0], material: white}}
  post: {{type: cylinder, start: "[2.8, 0.1, 0] m", end: "[2.8, 0.1, 1.5] m", radius: 10 cm, material: white}}
lamps:
  one: {{center: "[2.5, 0, 2.2] m", size: "[0.6, 0.4] m", luminous_flux: 3000 lm, temperature: 2856 K}}
"""

DENSE_FOG = f"""{_HEAD}
fog: {{extinction: "0.3 /m", albedo: 0.9995, phase: {{type: henyey_greenstein, g: 0.85}}}}
robots:
  r1: {_camera("[0.3, 0, 1.0]")}
  r2: {_source("[2.2, 0.7, 0.7]")}
  r3: {_source("[3.0, -0.8, 1.3]")}
materials:
  white: {{type: diffuse, reflectance: 0.7}}
  grey: {{type: diffuse, reflectance: 0.4}}
shapes:
  floor: {{type: rectangle, center: "[2, 0, 0] m", size: "[4, 4] m", normal: [0, 0, 1], material: grey}}
  ceiling: {{type: rectangle, center: "[2, 0, 2.5] m", size: "[4, 4] m", normal: [0, 0, -1], material: white}}
  front: {{type: rectangle, center: "[4, 0, 1.25] m", size: "[4, 2.5] m", normal: [-1, 0, 0], material: white}}
  back: {{type: rectangle, center: "[0, 0, 1.25] m", size: "[4, 2.5] m", normal: [1, 0, 0], material: grey}}
  left: {{type: rectangle, center: "[2, 2, 1.25] m", size: "[4, 2.5] m", normal: [0, -1, 0], material: white}}
  right: {{type: rectangle, center: "[2, -2, 1.25] m", size: "[4, 2.5] m", normal: [0, 1, 0], material: grey}}
"""

ROOMS = {
    "diffuse room": DIFFUSE_ROOM, "glossy corridor": GLOSSY_CORRIDOR, "mirror room": MIRROR_ROOM, "occluders": OCCLUDERS,
    "thin fog": THIN_FOG, "dense fog": DENSE_FOG,
}  # fmt: skip


def plain(room: str) -> dict[str, Any]:
    """Return a room as plain data."""
    document: dict[str, Any] = yaml.safe_load(ROOMS[room])
    return document


def load_room(room: str, folder: Path, samples: int) -> Scene:
    """Write a room to `room.yaml` in a folder, and load it with so many samples a pixel."""
    path = folder / "room.yaml"
    path.write_text(yaml.safe_dump(plain(room), sort_keys=False))
    return load_scene(path, {"render.indirect.samples": samples})


def groups(document: dict[str, Any]) -> list[str]:
    """Return the light groups of a room's document: its sources, then its lamps."""
    sources = [
        f"{robot}.{name}"
        for robot, entry in document["robots"].items()
        for name in entry["rig"].get("sources", {})
    ]
    return [*sources, *(f"lamps.{name}" for name in document.get("lamps", {}))]
