"""Which LLVM library Dr.Jit should load: found, tried in a process of its own, and remembered.

Several LLVM versions end the whole process in the middle of a render, which nothing inside that process
can catch. So each candidate renders one tiny scene in a subprocess, and only that answer counts. Nothing
but that subprocess imports Mitsuba; the rest needs the standard library alone.
"""

from nir_render.transport.backend.llvm.choice import Choice, choose

__all__ = ["Choice", "choose"]
