"""The program that the probe runs: one tiny render with the LLVM it is given, held to the closed form.

It imports nothing of this project, for it runs as a file, from another folder.
"""

import contextlib
import json
import os
import re
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Print the deviation, LLVM's version, and the library that was loaded, as one JSON object."""
    with contextlib.suppress(ImportError):  # there is no such module on Windows
        import resource

        # An abort that is expected is to leave no file behind.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import drjit as dr

    deviation = _deviation(mi)
    version = ".".join(str(part) for part in dr.detail.llvm_version())
    result = {"deviation": deviation, "version": version, "loaded": _loaded_library()}
    sys.stdout.write(json.dumps(result) + "\n")


def _deviation(mi: Any) -> float:
    """Render a lit floor and return its largest relative error.

    A point light of I = 3 W/sr stands h = 8 m over the middle of a Lambertian floor of reflectance 0.5, so
    that at the distance r from its foot the radiance is 0.5/π · I h / (h² + r²)^(3/2). A rough metal ball
    beside and below the floor is in the picture, lit, and sends nothing to the floor: it is there because
    its BSDF is what some LLVM versions cannot compile.
    """
    import numpy as np

    look = mi.ScalarTransform4f().look_at(origin=[0.5, 0, 3], target=[0.5, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 32, "height": 16, "pixel_format": "luminance"}
    half = {"type": "uniform", "value": 0.5}
    metal = {"type": "roughconductor", "alpha": 0.2, "material": "none"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "sensor": {
                "type": "orthographic",
                "to_world": look @ mi.ScalarTransform4f().scale([2, 2, 1]),
                "film": film | {"rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 64},
            },
            "light": {"type": "point", "position": [0, 0, 8], "intensity": {"type": "uniform", "value": 3.0}},
            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": half}},
            "ball": {"type": "sphere", "center": [1.7, 0, -0.6], "radius": 0.5, "bsdf": metal},
        }
    )
    image = np.array(mi.render(scene, seed=1), dtype=np.float64)[..., 0]
    x_m = (np.arange(32) + 0.5) / 8 - 1.5
    y_m = (np.arange(16) + 0.5) / 8 - 1.0
    on_floor = np.abs(x_m) < 1
    ball = image[:, ~on_floor]
    if not (np.isfinite(ball).all() and ball.max() > 0):
        return float("inf")
    expected = 0.5 / np.pi * 3.0 * 8 / (x_m[on_floor] ** 2 + y_m[:, np.newaxis] ** 2 + 64) ** 1.5
    return float(np.max(np.abs(image[:, on_floor] / expected - 1)))


def _loaded_library() -> str:
    """Return the LLVM library that this process has loaded, or the one asked for where it is not Linux."""
    try:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return os.environ.get("DRJIT_LIBLLVM_PATH", "")
    match = re.search(r"/(.*/)?libLLVM(-\d[\d.]*)?\.so[\d.]*$", maps, re.MULTILINE)
    return match[0] if match else ""


if __name__ == "__main__":
    main()
