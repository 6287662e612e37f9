"""Ask whether one LLVM library works, by a render in a process that may come to grief."""

import json
import os
import re
import signal
import site
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"  # where Dr.Jit is told which library to load
PROBE_VERSION = 1  # part of the cache key: to be raised when the probe asks for something else than before
TIME_LIMIT_S = 120.0  # a probe takes about a second; one that takes this long is stuck
DEVIATION_LIMIT = 0.005  # largest relative error of a pixel; its noise is 0.0006 (the seed is fixed)

# -P: the folder of that file must not stand in front of the packages that it imports.
_COMMAND = (sys.executable, "-P", str(Path(__file__).resolve().with_name("probe_render.py")))


@dataclass(frozen=True)
class Answer:
    """What the probe of one library said."""

    library: str  # the one asked for; empty for Dr.Jit's own choice
    usable: bool  # whether it rendered the probe's scene rightly
    version: str = ""  # LLVM's, such as "19.1.7"
    loaded: str = ""  # the file that was in fact loaded; empty where the system does not tell
    reason: str = ""  # why it failed, in one line
    lasting: bool = True  # False if the same question may get another answer next time


def probe(
    library: Path | None,
    *,
    environ: Mapping[str, str] = os.environ,
    time_limit_s: float = TIME_LIMIT_S,
    command: Sequence[str] = _COMMAND,
) -> Answer:
    """Render a tiny scene with `library` (None: Dr.Jit's own choice) in a subprocess, and judge the result.

    An abort, a wrong number, or a time-out is an answer with ``usable`` False, not an exception.
    """
    name = "" if library is None else str(library)
    try:
        with tempfile.TemporaryDirectory(prefix="nir_render-llvm-", ignore_cleanup_errors=True) as folder:
            done = subprocess.run(  # noqa: S603 (our own interpreter and file)
                command,
                env=_environment(name, environ, folder),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=time_limit_s,
                check=False,
            )
    except subprocess.TimeoutExpired:
        return Answer(name, False, reason=f"no answer within {time_limit_s:g} s")
    except OSError as error:
        return Answer(name, False, reason=f"the probe could not be started: {error}", lasting=False)
    if done.returncode != 0:
        killed = done.returncode == -9  # SIGKILL, which comes from outside
        return Answer(name, False, reason=_failure(done.returncode, done.stderr), lasting=not killed)
    return _judge(name, done.stdout)


def _environment(name: str, environ: Mapping[str, str], folder: str) -> dict[str, str]:
    # Dr.Jit keeps compiled kernels in the home folder; one from another LLVM must not hide a failure.
    # The user's own packages also lie there, so their place is named.
    others = {key: value for key, value in environ.items() if key != VARIABLE}
    wish = {VARIABLE: name} if name else {}
    return {**others, **wish, "HOME": folder, "PYTHONUSERBASE": site.getuserbase()}


def _failure(status: int, errors: str) -> str:
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    telling = [line for line in lines if re.search(r"LLVM ERROR|too old|API initialization failed", line)]
    line = (telling or lines[-1:] or ["no message"])[0]
    line = re.sub(r",? ?\b0x[0-9a-f]{6,}:?", "", line)[:160]  # addresses say nothing
    if status >= 0:
        return line
    names = {int(s): s.name for s in signal.Signals}
    return f"the process ended by {names.get(-status, f'signal {-status}')}: {line}"


def _judge(name: str, output: str) -> Answer:
    try:
        result = json.loads(output.splitlines()[-1])
        deviation, version, loaded = float(result["deviation"]), str(result["version"]), str(result["loaded"])
    except (ValueError, LookupError, TypeError):
        return Answer(name, False, reason=f"the probe printed no result: {output[-80:]!r}")
    if not deviation <= DEVIATION_LIMIT:  # also true for NaN
        return Answer(name, False, reason=f"LLVM {version} rendered a wrong radiance, off by {deviation:.3g}")
    return Answer(name, True, version=version, loaded=loaded)
