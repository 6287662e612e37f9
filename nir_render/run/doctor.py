"""What this machine renders with, and whether a tiny render agrees with its closed form."""

import os
from typing import Any

from nir_render.run.manifest import versions


def examine() -> dict[str, Any]:
    """Return versions, variant and why, LLVM, threads, GPU, and the check.

    The check renders a source of 1 W at 0.5 m that a camera sees from 0.5 m by Mitsuba's own path tracer,
    and compares its radiance with Φ / (4π² r²).
    """
    from nir_render.transport.backend import doctor_scene, llvm
    from nir_render.transport.backend import variant as backend

    mitsuba = backend.backend()
    choice = llvm.choose()
    rendered, expected = doctor_scene.radiance_of_source()
    error = abs(rendered / expected - 1.0)
    return {
        **versions(),
        "variant": mitsuba.variant,
        "variant_reason": mitsuba.reason,
        "llvm": f"{choice.version} ({choice.loaded})" if choice.usable else "none that works",
        "threads": mitsuba.dr.thread_count(),
        "cores": os.cpu_count(),
        "gpu": "usable" if backend.gpu_usable() else "none",
        "check": f"radiance of a source: rendered {rendered:.6g}, closed form {expected:.6g} W/(m² sr)",
        "check_error": error,
        "check_holds": error < 1e-4,
    }
