"""The one place where Mitsuba is imported and its variant chosen, once per process."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.transport.backend import llvm

Array = NDArray[np.float64]

LLVM_VARIANT = "llvm_ad_mono"
SCALAR_VARIANT = "scalar_rgb"  # Mitsuba's wheels carry no scalar_mono; all spectra here are plain numbers
_VARIABLE = "NIR_RENDER_VARIANT"
_FARTHEST_M = 1e9  # well within float32


@dataclass(frozen=True)
class Backend:
    """Mitsuba with its variant set, and why that one."""

    mi: Any
    dr: Any
    variant: str
    reason: str

    @property
    def vectorised(self) -> bool:
        """Whether rays travel as arrays rather than one by one."""
        return not self.variant.startswith("scalar")

    @property
    def compiler(self) -> str:
        """What compiles rendering for this machine, such as "LLVM 19.1.7"; empty where nothing does."""
        if not self.variant.startswith("llvm"):
            return ""
        return f"LLVM {'.'.join(map(str, self.dr.detail.llvm_version()))}"


@cache
def backend() -> Backend:
    """Return Mitsuba, imported with the fastest variant that works here.

    The environment variable NIR_RENDER_VARIANT asks for another one.

    Raises
    ------
    InputError
        Mitsuba is not installed, or the variant asked for does not load.
    """
    asked = os.environ.get(_VARIABLE)
    variant, reason = (asked, f"{_VARIABLE} asks for it") if asked else _choose()
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise InputError(
            f"Mitsuba cannot be imported ({error}); rendering needs it: pip install mitsuba==3.9.1 "
            "(there are no wheels for Linux on ARM and Macs with Intel processors)"
        ) from None
    if variant not in mitsuba.variants():
        raise InputError(f"{_VARIABLE}={variant}: no such variant; known: {', '.join(mitsuba.variants())}")
    mitsuba.set_variant(variant)
    return Backend(mitsuba, drjit, variant, reason)


class _Loaded:
    """A module of the backend, which loads when the first of its names is asked for."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what looks at an object, such as doctest, asks it for these
            raise AttributeError(name)
        return getattr(getattr(backend(), self._module), name)


# Mitsuba and Dr.Jit, as the rest of this room writes them.
mi: Any = _Loaded("mi")
dr: Any = _Loaded("dr")


def _choose() -> tuple[str, str]:
    choice = llvm.choose()
    if not choice.usable:
        return SCALAR_VARIANT, "no usable LLVM was found; the scalar variant is 4 to 6 times slower"
    if choice.library is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(choice.library)
    return LLVM_VARIANT, f"LLVM {choice.version} works"


def traces_one_scene() -> bool:
    """Tell whether a kernel can trace rays in one scene alone, as on a GPU: a second one seems empty."""
    return backend().variant.startswith("cuda")


def set_threads(count: int) -> None:
    """Let rendering use `count` threads."""
    dr.set_thread_count(count)


def shape_number(shape: Any) -> int:
    """Return the number by which rays of a vectorised variant tell a shape that they meet."""
    return int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])


def blocked(
    scene: Any,
    origins_m: Array,
    directions: Array,
    reach_m: Array,
    shapes: Sequence[Any] = (),
    own: NDArray[np.int64] | None = None,
) -> NDArray[np.bool_]:
    """Tell which rays hit a shape that is not their own before their reach, which may be infinite.

    Parameters
    ----------
    origins_m, directions, reach_m
        Shape (n, 3), (n, 3), (n,).
    shapes, own
        Each ray's own shape is `shapes[own]`; −1 where it has none, as all have without `own`. Shape (n,).

    Returns
    -------
    Shape (n,).
    """
    reach_m = np.minimum(reach_m, _FARTHEST_M)
    own = np.full(len(reach_m), -1) if own is None else own
    if not len(reach_m):
        return np.zeros(0, dtype=bool)  # Dr.Jit ends the process on arrays of no value
    if backend().vectorised:
        ray = mi.Ray3f(
            mi.Point3f(origins_m.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32))
        )
        ray.maxt = mi.Float(reach_m.astype(np.float32))
        hit = scene.ray_intersect_preliminary(ray)
        hits = np.array(hit.is_valid(), dtype=bool)
        found = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
        numbers = [shape_number(shape) for shape in shapes]
        return np.asarray(hits & ((own < 0) | (found != np.array([*numbers, 0])[own])), dtype=bool)
    hits = np.zeros(len(reach_m), dtype=bool)
    for index, (origin, direction, reach) in enumerate(zip(origins_m, directions, reach_m, strict=True)):
        mine = shapes[own[index]] if own[index] >= 0 else None
        ray = mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(*map(float, direction)))
        ray.maxt = float(reach)
        hit = scene.ray_intersect_preliminary(ray)
        hits[index] = hit.is_valid() and hit.shape != mine
    return hits


def gpu_usable() -> bool:
    """Tell whether Dr.Jit finds a CUDA GPU."""
    return bool(dr.has_backend(dr.JitBackend.CUDA))
