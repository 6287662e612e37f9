"""Random numbers that depend on what they are for, never on when they are drawn."""

import hashlib

import numpy as np


def generator(seed: int, stage: str, camera: str, frame: int) -> np.random.Generator:
    """Return a counter-based generator (Philox) keyed by (run seed, stage, camera, frame).

    The key is a hash, so that neighbouring seeds and frames have nothing in common.
    """
    key = hashlib.blake2b(f"{seed}|{stage}|{camera}|{frame}".encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(key, "little")))
