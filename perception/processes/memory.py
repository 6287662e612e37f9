"""Memory in which processes find the frames that they are handed."""

import contextlib
import errno
import secrets
import shutil
from dataclasses import dataclass, replace
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np

from perception.types import RawFrame

SHARED = Path("/dev/shm")  # noqa: S108 (its free space is read)


@dataclass(frozen=True)
class Place:
    """Where the pixels of a frame lie; and all pieces of memory that were there then: others are let go."""

    memory: str
    shape: tuple[int, ...]
    dtype: str
    pieces: frozenset[str]


Handed = tuple[RawFrame, Place]
"""A frame without its pixels, and where these lie."""


class Memory:
    """Memory that processes share, a piece for each frame that is in it."""

    def __init__(self) -> None:
        self._all: dict[str, SharedMemory] = {}
        self._free: list[str] = []
        self._made: str | None = None

    def place(self, frame: RawFrame) -> Handed | None:
        """Put a frame's pixels into memory; None if they are no array of integers or floats, or empty.

        Raises
        ------
        OSError
            There is no room.
        """
        pixels = frame.data_dn
        if not (isinstance(pixels, np.ndarray) and pixels.dtype.kind in "iuf" and pixels.size):
            return None
        name = next((each for each in self._free if self._all[each].size >= pixels.nbytes), None)
        if name is None:
            while self._free:  # too small, all of them
                _forget(self._all.pop(self._free.pop()))
            name = self._make(pixels.nbytes)
        else:
            self._free.remove(name)
        np.copyto(np.ndarray(pixels.shape, pixels.dtype, self._all[name].buf), pixels)
        without = replace(frame, data_dn=np.empty((0, 0), dtype=np.uint16))
        return without, Place(name, pixels.shape, pixels.dtype.str, frozenset(self._all))

    def _make(self, size: int) -> str:
        free = shutil.disk_usage(SHARED).free if SHARED.is_dir() else size
        if size > free:  # what writes there is ended by the kernel, without an error
            raise OSError(
                errno.ENOSPC,
                f"shared memory has room for {free} bytes, a frame needs {size}: "
                "make it larger, as by Docker's --shm-size",
                str(SHARED),
            )
        self._made = name = f"perception_{secrets.token_hex(6)}"  # known before it is there: Ctrl-C may come
        self._all[name] = SharedMemory(name, create=True, size=size)
        return name

    def reuse(self, handed: Handed) -> None:
        """Take a frame's memory for another."""
        self._free.append(handed[1].memory)

    def close(self) -> None:
        """Give all of it back."""
        self._free.clear()
        if self._made is not None and self._made not in self._all:
            with contextlib.suppress(FileNotFoundError):
                _forget(SharedMemory(self._made))
        while self._all:
            _forget(self._all.popitem()[1])


def _forget(memory: SharedMemory) -> None:
    memory.close()
    with contextlib.suppress(FileNotFoundError):
        memory.unlink()


def taken(handed: Handed, held: dict[str, SharedMemory]) -> RawFrame:
    """Return a frame as it lies in memory; what is there no more is held no longer."""
    frame, place = handed
    for gone in held.keys() - place.pieces:
        held.pop(gone).close()
    if place.memory not in held:
        held[place.memory] = SharedMemory(place.memory)
    return replace(frame, data_dn=np.ndarray(place.shape, place.dtype, held[place.memory].buf))
