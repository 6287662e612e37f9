"""Random numbers that depend on what they are for, never on when they are drawn."""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def generator(seed: int, stage: str, camera: str, frame: int) -> np.random.Generator:
    """Return a counter-based generator (Philox) keyed by (run seed, stage, camera, frame).

    The key is a hash, so that neighbouring seeds and frames have nothing in common.
    """
    return np.random.Generator(np.random.Philox(key=_philox_key(seed, stage, camera, frame)))


@dataclass(frozen=True)
class RandomKey:
    """Whose random numbers: those of one frame of one camera, in one stage of a run."""

    seed: int
    stage: str
    camera: str
    frame: int

    def words(self, purpose: str, block: int, count: int) -> NDArray[np.uint32]:
        """Return random 32-bit words, shape (count,), of a part of the frame.

        Each block has a range of Philox's counter of its own: blocks may be drawn in any order, by anyone.
        """
        key = _philox_key(self.seed, f"{self.stage}/{purpose}", self.camera, self.frame)
        philox = np.random.Philox(key=key, counter=block << 192)
        return philox.random_raw((count + 1) // 2).view(np.uint32)[:count]


def _philox_key(seed: int, stage: str, camera: str, frame: int) -> int:
    key = hashlib.blake2b(f"{seed}|{stage}|{camera}|{frame}".encode(), digest_size=16).digest()
    return int.from_bytes(key, "little")
