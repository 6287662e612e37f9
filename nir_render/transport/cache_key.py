"""What determines light, as a hash: two lights of one key are the same bits.

In it: bodies and their materials, where and how large what shines is and how it spreads its light, fog, the
camera's rays, how finely is sampled, the seed, and what computes: versions, compiler and processor. Not in
it: what is arithmetic afterwards, such as flux, spectra, filter, exposure, gain and noise.

Two things follow from that arithmetic all the same, and are in it: `power`, in coarse steps, by which lights
are chosen (`render.group_power`), and with a target for the noise the samples of each pixel. So a change of
flux, spectrum or filter leaves the key as it is where the samples are fixed and no group's step changes; one
of exposure, gain or noise, where the samples are fixed.

Everything goes into SHA-256 in one way: each value behind a tag of its type and its length, floats by their
bytes.
"""

import hashlib
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from nir_render.camera.optics.lens import corner_directions
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.base import Same
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.fog import Fog
from nir_render.scene.documents.materials import MaterialDocument
from nir_render.scene.documents.matter.texture import TextureDocument
from nir_render.scene.documents.shapes import Mesh, ShapeDocument
from nir_render.scene.documents.times.drives import FULL_DRIVE
from nir_render.scene.emission import Emitter
from nir_render.scene.meshes.read import files_of_mesh
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import PlacedCamera, Snapshot
from nir_render.transport.backend.llvm.choice import cpu_name
from nir_render.transport.fingerprint import code_hash, matching, package_versions

_PACKAGES = ("nir-render", "mitsuba", "drjit", "numpy")
# Files of this package that decide the bits of light: a change of one is another version.
_DOUBLE = struct.Struct("<d")
_CODE = (
    "transport/**/*.py",
    "scene/**/*.py",
    "scattering/*.py",
    "data/droplets/tables/*.csv",
    "light/enlarge.py",
    "camera/optics/lens.py",
    "camera/optics/apertures.py",
    "geometry.py",
)

# Of a shape: its material is told beside it; a snapshot has it where its motion has brought it.
_ELSEWHERE = {"material", "materials", "motion", "between", "path"}

Sampled = NDArray[np.int64] | int | str | tuple[str, NDArray[np.int64]] | None


@dataclass(frozen=True, eq=False)
class Site:
    """A camera, `robot.camera`, in the world at one time."""

    snapshot: Snapshot
    name: str

    @cached_property
    def _placed(self) -> PlacedCamera:
        return self.snapshot.camera(self.name)

    @property
    def camera(self) -> Camera:
        """The device."""
        return self._placed.camera

    @property
    def pose(self) -> Pose:
        """The pose of its axes in the world."""
        return self._placed.pose


def geometry_key(site: Site) -> str:
    """Return the hash of what is where, and of the rays that look at it: 64 hexadecimal digits."""
    snapshot = site.snapshot
    return digest(
        {
            "shapes": [
                (name, _shape(shape), _material(snapshot.materials[shape.material]))
                for name, shape in snapshot.shapes.items()
            ],
            "lamps": [
                (name, lamp.center_m, lamp.size_m, lamp.normal) for name, lamp in snapshot.lamps.items()
            ],
            "sun": None if snapshot.sun is None else snapshot.sun.direction,
            # Not there where there is none, so that the random numbers of such scenes are what they were.
            **({} if snapshot.skylight is None else {"sky": snapshot.skylight.sky.cie}),
            "sources": [
                (name, placed.pose.position_m, placed.source.radius_m)
                # A source that shines the same in all directions may turn as it likes.
                + (() if placed.source.pattern is None else (placed.source.pattern, placed.pose.rotation))
                for name, placed in snapshot.sources.items()
            ],
            "fog": _fog(snapshot.fog),
            "camera": (site.name, site.pose.position_m, site.pose.rotation, _corners(site.camera)),
        }
    )


def light_key(
    site: Site,
    geometry: str,
    seed: int,
    power: NDArray[np.float64],
    samples: Sampled,
    made_by: Sequence[str],
) -> str:
    """Return the hash of everything that determines a light: 64 hexadecimal digits.

    Parameters
    ----------
    geometry
        The site's `geometry_key`.
    power
        What each group counts when lights are chosen, shape (groups,).
    samples
        Samples per pixel: one number, one for each pixel, or None where there is no indirect light; of a
        pilot its name, and the pixels where they are chosen.
    made_by
        What computes it: `versions`.
    """
    settings = site.snapshot.render
    return digest(
        {
            "geometry": geometry,
            "seed": seed,
            "power": power,
            "samples": samples,
            "settings": (settings.indirect.scale, settings.indirect.max_depth, settings.visibility_rays),
            "made_by": list(made_by),
        }
    )


def plan_key(site: Site, geometry: str, seed: int, made_by: Sequence[str]) -> str:
    """Return the hash of what the samples of a target for the noise follow from: 64 hexadecimal digits.

    That is the pilot, and all that turns its light into electrons. The arguments are those of `light_key`.
    """
    settings = site.snapshot.render
    return digest(
        {
            "geometry": geometry,
            "seed": seed,
            "settings": settings,
            "camera": site.camera,
            "emitters": {name: _fully_lit(emitter) for name, emitter in site.snapshot.emitters.items()},
            "made_by": list(made_by),
        }
    )


def _fully_lit(emitter: Emitter) -> Emitter:
    """Return an emitter as it is planned for: what blinks is fully lit."""
    if isinstance(emitter, Sun | Skylight) or emitter.drive.constant is not None:
        return emitter
    return emitter.model_copy(update={"drive": FULL_DRIVE})


def versions(variant: str, compiler: str) -> tuple[str, ...]:
    """Return what the bits of light follow from, besides the scene.

    That is Mitsuba's variant, what compiles its code (`Backend.compiler`), the versions of what computes
    light, the processor with its instruction sets, the hash of this package's part.
    """
    return (variant, compiler, *_versions())


@dataclass(frozen=True)
class _Written:
    """What has been written already."""

    text: bytes


def _shape(shape: ShapeDocument) -> _Written:
    """Return a shape without the name of its material, and a mesh by what its file holds."""
    if isinstance(shape, Mesh):
        files = tuple(_file(str(file)) for file in files_of_mesh(shape.file))
        return _of_fields(shape, file=files[0] if len(files) == 1 else files)
    return _plain_shape(Same(shape))


@lru_cache(maxsize=8192)  # those of a campaign's scenes are the same objects
def _plain_shape(same: Same[ShapeDocument]) -> _Written:
    return _of_fields(same.part)


def _of_fields(shape: ShapeDocument, **others: object) -> _Written:
    fields = {name: getattr(shape, name) for name in type(shape).model_fields if name not in _ELSEWHERE}
    return _Written(_canonical((type(shape).__name__, fields | others)))


def _material(material: MaterialDocument) -> tuple[str, dict[str, Any]]:
    """Return a material by what it does to light, and a picture by what its file holds.

    What it does not say, as all materials once did not, does not count: others keep their random numbers.
    """
    fields = {name: getattr(material, name) for name in type(material).model_fields}
    kept = {name: value for name, value in fields.items() if name != "evidence" and value is not None}
    for name, value in kept.items():
        if isinstance(value, TextureDocument):
            kept[name] = (_file(value.texture), value.of)
    return type(material).__name__, kept


def _file(name: str) -> tuple[str, str]:
    """Return a file's kind, and the hash of what it holds."""
    file = Path(name)
    state = file.stat()
    return file.suffix.lower(), _content(str(file), state.st_mtime_ns, state.st_size)


def _fog(fog: Fog | None) -> tuple[str, dict[str, Any]] | None:
    """Return a fog; droplets and profile count only where there are some: others keep their numbers."""
    if fog is None:
        return None
    fields = {name: getattr(fog, name) for name in type(fog).model_fields}
    for name in ("droplets", "profile"):
        if fields[name] is None:
            del fields[name]
    return type(fog).__name__, fields


@lru_cache(maxsize=64)
def _content(file: str, _changed_ns: int, _size: int) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


@lru_cache(maxsize=64)
def _corners(camera: Camera) -> str:
    return digest(corner_directions(camera))


@cache
def _versions() -> tuple[str, ...]:
    code = code_hash(matching(Path(__file__).parents[1], _CODE))
    packages = package_versions(*_PACKAGES)
    return (*(f"{name} {version}" for name, version in packages.items()), cpu_name(), code)


def digest(value: Any) -> str:
    """Return the hash of plain data, arrays and models: 64 hexadecimal digits."""
    return hashlib.sha256(_canonical(value)).hexdigest()


def _canonical(value: Any) -> bytes:
    parts: list[bytes] = []
    _write(value, parts.append)
    return b"".join(parts)


def _write(value: Any, write: Callable[[bytes], None]) -> None:
    """Write the canonical bytes of plain data, arrays and models; what is most is asked for first."""
    kind = type(value)
    if kind is float:
        write(b"d" + _DOUBLE.pack(value))
    elif kind is str:
        write(_text(value))
    elif kind is tuple or kind is list:
        write(b"l%d;" % len(value))
        for item in value:
            _write(item, write)
    elif value is None:
        write(b"n")
    elif kind is dict:
        write(b"m%d;" % len(value))
        for key, item in value.items():
            _write(key, write)
            _write(item, write)
    elif kind is _Written:
        write(value.text)
    elif isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in kind.model_fields}
        _write((kind.__name__, fields), write)
    elif isinstance(value, bool | int | np.integer):
        write(b"i%d;" % int(value))
    elif isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        write(f"a{array.dtype.str}{array.shape};".encode())
        write(array.tobytes())
    else:
        _write(_plain(value), write)


def _plain(value: object) -> str | float | tuple[Any, ...] | dict[Any, Any]:
    """Return what is some kind of plain data as such."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, tuple | list):
        return tuple(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} has no canonical bytes")


@lru_cache(maxsize=4096)
def _text(value: str) -> bytes:
    text = value.encode()
    return b"s%d;%b" % (len(text), text)
