"""Answers that are dear to find, kept from one run to the next in files of the user's cache folder.

A file is a JSON object of answers by key. It is only a memory: where it is absent, broken or of another
version it holds nothing, and where it cannot be written the answers are found again. Of two processes that
write at once the later wins; what the other found is found again.
"""

import contextlib
import json
import os
import secrets
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_MOST_ANSWERS = 64


def cache_file(name: str, environ: Mapping[str, str] = os.environ, system: str = sys.platform) -> Path | None:
    """Return a file in this program's cache folder of the user, or None for a user without a home."""
    try:
        home = Path.home()
    except RuntimeError:
        return None
    if system == "win32":
        base = Path(environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif system == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(environ.get("XDG_CACHE_HOME", ""))
        # The XDG specification has relative paths ignored.
        base = base if base.is_absolute() else home / ".cache"
    return base / "nir_render" / name


def read_answers(file: Path | None) -> dict[str, dict[str, Any]]:
    """Return the answers of a file by key, each an object of JSON; none where there is no such file."""
    if file is None:
        return {}
    try:
        answers = json.loads(file.read_text(encoding="utf-8"))["answers"]
        return {key: fields for key, fields in answers.items() if isinstance(fields, dict)}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}


def write_answers(file: Path | None, answers: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the newest answers, the last ones, to a file, aside first: it is whole at any time."""
    if file is None:
        return
    newest = dict(list(answers.items())[-_MOST_ANSWERS:])
    aside = file.with_name(f".{file.name}.{os.getpid()}-{secrets.token_hex(4)}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with aside.open("x", encoding="utf-8") as written:
            written.write(json.dumps({"format": 1, "answers": newest}, indent=1) + "\n")
            written.flush()
            os.fsync(written.fileno())
        aside.replace(file)
    except OSError:
        # What cannot be kept costs the time of finding it again, nothing else.
        with contextlib.suppress(OSError):
            aside.unlink()
