"""What a reference holds: what each stage was given, what it made of it, and what made it."""

import hashlib
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.timing.exposure_control import Setting
from nir_render.light.light import Light
from nir_render.regress.following import Following
from nir_render.scene.documents.materials import texture_of
from nir_render.scene.documents.shapes import Mesh
from nir_render.scene.meshes.read import files_of_mesh
from nir_render.scene.scene import Scene
from nir_render.transport.fingerprint import code_hash, package_versions
from perception.types import Calibration, Detection, RawFrame

_PACKAGES = ("numpy", "scipy", "opencv-python-headless")
_OF_TRANSPORT = (
    "variant", "compiler", "nir-render", "mitsuba", "drjit", "numpy", "processor", "code of transport",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ReferenceLight:
    """The light of one camera with one geometry.

    Attributes
    ----------
    light
        The mean of many renders with seeds of their own; `variance` and `samples` are those of the mean.
    third
        Third cumulant of one sample, summed over tiles of 8 × 8 pixels, shape (groups, tile rows, tile
        columns); None without indirect light.
    third_edges
        The same of the pixels along edges, as `edge_image` has them; None where there are none.
    own_hash
        SHA-256 of the light that the scene renders with its own samples and seed, which is none of these.
    own_radiance_per_w
        The indirect light of that, shape as of `light`'s, pixels along edges apart; None without, and in
        older references.
    third_multiple
        As `third`, of the light of many turns alone; None where nothing is averaged.
    """

    light: Light
    third: NDArray[np.float64] | None
    third_edges: NDArray[np.float64] | None
    own_hash: str
    own_radiance_per_w: NDArray[np.float32] | None = None
    third_multiple: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class ReferenceShot:
    """One frame: the reference's light through the scene's camera.

    `light` counts the reference's lights; `electrons` are the expected ones, shape (rows, columns). `chosen`
    is what automatic exposure makes of this frame and those before it (`make.choices`); None without one.
    """

    light: int
    electrons: NDArray[np.float32]
    frame: RawFrame
    chosen: Setting | None = None


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference of one scene.

    Attributes
    ----------
    document
        The scene as `document_of` gives it.
    seed
        The scene's, with which its own light was rendered and its noise drawn.
    renders
        How many renders the lights are the mean of.
    made_by
        What the bits follow from besides the scene: `transport` that of light, `other` that of all else.
    calibrations
        By camera.
    detections
        By estimator.
    history
        Why it was made, and each time that it was made anew: `reason` and `time`.
    following
        Odometry, and what each estimator follows and reads; None where the reference is older than this.
    """

    document: Mapping[str, Any]
    seed: int
    renders: int
    made_by: Mapping[str, Mapping[str, str]]
    lights: tuple[ReferenceLight, ...]
    shots: tuple[ReferenceShot, ...]
    calibrations: Mapping[str, Calibration]
    detections: Mapping[str, tuple[Detection, ...]]
    history: tuple[Mapping[str, str], ...]
    following: Following | None = None

    def own_samples(self, light: ReferenceLight) -> int:
        """Return the samples in a pixel of the render with the scene's own seed; 0 without indirect light."""
        many = light.light.indirect
        return 0 if many is None else many.samples // self.renders


def document_of(scene: Scene) -> dict[str, Any]:
    """Return a scene with everything expanded as plain data.

    Meshes and pictures are told by their names beside the scene, and by their hashes.
    """
    data = scene.document.model_dump(mode="json", by_alias=True, exclude_none=True)
    for name, shape in scene.document.shapes.items():
        if isinstance(shape, Mesh):
            data["shapes"][name] |= _told_file(scene, "file", *files_of_mesh(shape.file))
    for name, material in scene.document.materials.items():
        texture = texture_of(material)
        if texture is not None:
            data["materials"][name]["reflectance"] |= _told_file(scene, "texture", Path(texture.texture))
    return data


def _told_file(scene: Scene, key: str, file: Path, *parts: Path) -> dict[str, str]:
    """Return a file's name, and the hash of what it and the files that it is read from hold."""
    contents = b"".join(one.read_bytes() for one in (file, *parts))
    return {
        key: Path(os.path.relpath(file, scene.folder)).as_posix(),
        "sha256": hashlib.sha256(contents).hexdigest(),
    }


def changes_of(before: Mapping[str, Any], after: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what differs between two documents, a line each: `seed: 1 → 2`."""
    old, new = leaves(before), leaves(after)
    return tuple(
        f"{path}: {_short(old.get(path))} → {_short(new.get(path))}"
        for path in dict.fromkeys([*old, *new])
        if old.get(path) != new.get(path)
    )


def _short(value: Any) -> str:
    """Write a value in a line; the beginning of a hash says as much."""
    text = "nothing" if value is None else str(value)
    return text if len(text) < 60 else f"{text[:24]}…"


def leaves(node: Any, path: str = "") -> dict[str, Any]:
    """Return every leaf of nested data by its dotted path; what is empty is as good as left out."""
    children = (
        node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
    )
    found = {
        inner: leaf
        for key, value in children
        for inner, leaf in leaves(value, f"{path}.{key}" if path else str(key)).items()
    }
    return found if isinstance(node, Mapping | list) else {path: node}


def made_by() -> dict[str, dict[str, str]]:
    """Return what the bits follow from besides the scene, by name: of light, and of all that comes after."""
    from nir_render.transport.backend.variant import backend  # Mitsuba loads only where light is rendered
    from nir_render.transport.cache_key import versions

    light = versions(backend().variant, backend().compiler)
    transport = {
        name: value.removeprefix(f"{name} ") for name, value in zip(_OF_TRANSPORT, light, strict=True)
    }
    # NumPy computes with the widest instructions that a processor has and its user allows; sines and
    # arctangents come from the C library.
    machine = {"instructions": _instructions(), "libc": " ".join(platform.libc_ver())}
    transport |= machine
    other = {"python": platform.python_version(), "processor": transport["processor"], **machine}
    other |= package_versions(*_PACKAGES)
    return {"transport": transport, "other": other | {"code": _code_hash()}}


@cache
def _instructions() -> str:
    """Return how many of its sets of instructions NumPy uses, and a hash of which."""
    features: Mapping[str, bool] = np._core._multiarray_umath.__cpu_features__  # type: ignore[attr-defined]
    used = sorted(name for name, enabled in features.items() if enabled)
    return f"{len(used)} sets, {hashlib.sha256(' '.join(used).encode()).hexdigest()[:12]}"


@cache
def _code_hash() -> str:
    import nir_render
    import perception

    roots = [Path(str(package.__file__)).parent for package in (nir_render, perception)]
    return code_hash(*((root, sorted(root.rglob("*.py"))) for root in roots))


def by_group_and_node(values: NDArray[Any]) -> NDArray[Any]:
    """Return values of shape (group, node, …) with groups and nodes on one axis, nodes running fastest."""
    return values.reshape(-1, *values.shape[2:])


def edge_image(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return values of pixels in a list, shape (…, n), as images of eight columns, filled up with zeros."""
    missing = -values.shape[-1] % 8
    padded = np.concatenate([values, np.zeros((*values.shape[:-1], missing))], axis=-1)
    return np.asarray(padded.reshape(*values.shape[:-1], -1, 8), dtype=np.float64)
