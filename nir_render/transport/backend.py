"""The one place where Mitsuba is imported and its variant chosen, once per process."""

import os
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.transport import llvm

Array = NDArray[np.float64]

LLVM_VARIANT = "llvm_ad_mono"
SCALAR_VARIANT = "scalar_rgb"  # Mitsuba's wheels carry no scalar_mono; all spectra here are plain numbers
_VARIABLE = "NIR_RENDER_VARIANT"


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
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise InputError(
            f"Mitsuba cannot be imported ({error}); rendering needs it: pip install mitsuba==3.9.1 "
            "(there are no wheels for Linux on ARM and Macs with Intel processors)"
        ) from None
    if variant not in mi.variants():
        raise InputError(f"{_VARIABLE}={variant}: no such variant; known: {', '.join(mi.variants())}")
    mi.set_variant(variant)
    return Backend(mi, dr, variant, reason)


def _choose() -> tuple[str, str]:
    choice = llvm.choose()
    if not choice.usable:
        return SCALAR_VARIANT, "no usable LLVM was found; the scalar variant is 4 to 6 times slower"
    if choice.library is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(choice.library)
    return LLVM_VARIANT, f"LLVM {choice.version} works"


def set_threads(count: int) -> None:
    """Let rendering use `count` threads."""
    backend().dr.set_thread_count(count)


def blocked(scene: Any, own: Any, origins_m: Array, directions: Array, reach_m: Array) -> NDArray[np.bool_]:
    """Tell which rays hit a shape other than `own` before their reach; (n, 3), (n, 3), (n,) → (n,)."""
    mi = backend().mi
    if backend().vectorised:
        ray = mi.Ray3f(
            mi.Point3f(origins_m.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32))
        )
        ray.maxt = mi.Float(reach_m.astype(np.float32))
        hit = scene.ray_intersect_preliminary(ray)
        others = hit.is_valid() if own is None else hit.is_valid() & (hit.shape != mi.ShapePtr(own))
        return np.array(others, dtype=bool)
    hits = np.zeros(len(reach_m), dtype=bool)
    for index, (origin, direction, reach) in enumerate(zip(origins_m, directions, reach_m, strict=True)):
        ray = mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(*map(float, direction)))
        ray.maxt = float(reach)
        hit = scene.ray_intersect_preliminary(ray)
        hits[index] = hit.is_valid() and hit.shape != own
    return hits


def gpu_usable() -> bool:
    """Tell whether Dr.Jit finds a CUDA GPU."""
    dr = backend().dr
    return bool(dr.has_backend(dr.JitBackend.CUDA))
