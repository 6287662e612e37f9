"""Lights that have been rendered, by the hash of what determines them: in memory, and on disk where asked.

A file (`light_file`) is named by its key. It is written aside, synced and renamed, so several processes may
share a folder; a file that is damaged counts as none. What goes wrong with the folder never stops a run: it
is said once, and lights stay in memory.
"""

import contextlib
import os
import tempfile
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.light.light import Light
from nir_render.light.npz import ASIDE, bytes_of, read_light, write_light

_SUFFIX = ".light.npz"
_ABANDONED_AFTER_S = 3600.0
_PLANS = 64
_MOST_HELD = 512  # small lights, of long runs: each new one looks through them


class LightCache:
    """Lights by key; the least recently used go first.

    The last light of each camera and film stays in memory whatever the limit, of others at most 512; on disk
    the folder may hold `limit_bytes`.
    `reused` and `missed` count the lights that were asked for.
    """

    def __init__(
        self,
        folder: str | Path | None = None,
        limit_bytes: int = 4 * 2**30,
        memory_limit_bytes: int = 2**30,
        say: Callable[[str], None] | None = None,
    ) -> None:
        """Open a cache; without a folder it lives in memory alone.

        `say` is told, once each, where the folder cannot be written and where a light is larger than its
        limit; without it they are Python's warnings. A folder that can only be read is read.

        Raises
        ------
        InputError
            The folder cannot be made, or a limit is negative.
        """
        if min(limit_bytes, memory_limit_bytes) < 0:
            raise InputError("the light cache's limit is negative; wanted bytes, 0 or more")
        self._folder = None if folder is None else Path(folder)
        self._limit_bytes, self._memory_limit_bytes = limit_bytes, memory_limit_bytes
        self._say, self._said = say or _warn, set[str]()
        self._held: OrderedDict[str, Light] = OrderedDict()
        self._plans: OrderedDict[str, NDArray[np.int64]] = OrderedDict()
        self.reused = self.missed = 0
        if self._folder is not None:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"{folder}: cannot be a light cache ({error.strerror or error}); give another folder"
                ) from None
            try:
                tempfile.TemporaryFile(dir=self._folder).close()
            except OSError as error:
                self._say_unwritable(error)

    def get(self, key: str, *, counts: bool = True) -> Light | None:
        """Return the light of a key, None where it is not there or its file is damaged."""
        light = self._held.get(key) or self._read(key)
        if counts:
            self.missed += light is None
            self.reused += light is not None
        if light is not None:
            self._hold(key, light)
        return light

    def put(self, key: str, light: Light) -> None:
        """Keep a light. A disk that is full, or a light above the limit, leaves the folder as it was."""
        self._hold(key, light)
        if self._folder is None:
            return
        size_bytes = bytes_of(light)
        if size_bytes > self._limit_bytes:
            self._say_once(
                "limit",
                f"light cache {self._folder}: a light of {_gib(size_bytes)} is larger than the limit of "
                f"{_gib(self._limit_bytes)} and is not kept there; raise the limit (--light-cache-gib)",
            )
            return
        try:
            write_light(self._folder / f"{key}{_SUFFIX}", light)
        except OSError as error:
            self._say_unwritable(error)
        self._shrink(self._folder)

    def plan(self, key: str, made: Callable[[], NDArray[np.int64]]) -> NDArray[np.int64]:
        """Return the samples of each pixel by their own key, made where they are not in memory."""
        if key not in self._plans:
            self._plans[key] = made()
        self._plans.move_to_end(key)
        while len(self._plans) > _PLANS:
            self._plans.popitem(last=False)
        return self._plans[key]

    def _say_unwritable(self, error: OSError) -> None:
        self._say_once(
            "unwritable",
            f"light cache {self._folder}: cannot be written ({error.strerror or error}); what it holds is "
            "used, new lights are not kept there",
        )

    def _say_once(self, about: str, text: str) -> None:
        if about not in self._said:
            self._said.add(about)
            self._say(text)

    def _hold(self, key: str, light: Light) -> None:
        self._held[key] = light
        self._held.move_to_end(key)
        newest = {_film(one): name for name, one in self._held.items()}
        excess_bytes = sum(map(bytes_of, self._held.values())) - self._memory_limit_bytes
        for name, one in list(self._held.items()):
            if excess_bytes <= 0 and len(self._held) <= _MOST_HELD:
                break
            if newest[_film(one)] != name:
                del self._held[name]
                excess_bytes -= bytes_of(one)

    def _read(self, key: str) -> Light | None:
        if self._folder is None:
            return None
        path = self._folder / f"{key}{_SUFFIX}"
        try:
            light = read_light(path)
        except Exception:  # a damaged archive raises a dozen types, from NumPy, zipfile, zlib, struct, ...
            return None
        with contextlib.suppress(OSError):  # it may be another user's, who alone may set its time
            os.utime(path)  # used now
        return light

    def _shrink(self, folder: Path) -> None:
        """Remove the least recently used files beyond the limit, and what killed writers have left."""
        files: list[tuple[int, Path, int]] = []
        paths: list[Path] = []
        with contextlib.suppress(OSError):  # the folder may be gone
            paths = list(folder.iterdir())
        for path in paths:
            with contextlib.suppress(OSError):  # another process may have removed it
                state = path.stat()
                if ASIDE in path.name and time.time() - state.st_mtime > _ABANDONED_AFTER_S:
                    path.unlink()
                elif path.name.endswith(_SUFFIX):
                    files.append((state.st_mtime_ns, path, state.st_size))
        excess_bytes = sum(size for _, _, size in files) - self._limit_bytes
        for _, path, size in sorted(files):
            if excess_bytes <= 0:
                break
            with contextlib.suppress(OSError):
                path.unlink()
            excess_bytes -= size


def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=5)  # above this, `_say_once`, who calls it, and `put`


def _gib(size_bytes: int) -> str:
    return f"{size_bytes / 2**30:.3g} GiB"


def _film(light: Light) -> tuple[str, tuple[int, ...]]:
    return light.camera, () if light.indirect is None else light.indirect.radiance_per_w.shape
