"""Signals of a source that sends, by hand: box exposures, Gaussian noise, a clock that drifts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.types import Signal

EXPOSURE_S = 1e-3


def bits_of(word: int) -> list[int]:
    """Start 0, seven bits from the lowest, even parity, two stop bits."""
    data = [word >> k & 1 for k in range(7)]
    return [0, *data, sum(data) % 2, 1, 1]


def signal(
    packets: Sequence[tuple[float, int]],
    seconds: float,
    noise: float,
    rng: np.random.Generator,
    fps: float = 30.0,
    drift: float = 0.0,
    dropped: float = 0.0,
    begins_s: float = 0.0,
    repeats: int = 5,
) -> Signal:
    """Return the signal of a source of amplitude 1 that sends words at times, from `begins_s` on."""
    time_s = np.arange(begins_s + rng.uniform(0.0, 1.0 / fps), seconds, 1.0 / fps)
    time_s = time_s[rng.random(len(time_s)) >= dropped]
    level = lit(packets, time_s, drift, repeats)
    sigma = np.full(len(time_s), noise)
    return Signal(
        "r1", 1, time_s, np.full(len(time_s), EXPOSURE_S), level + noise * rng.normal(size=len(time_s)),
        sigma, sigma,
    )  # fmt: skip


def lit(
    packets: Sequence[tuple[float, int]], time_s: NDArray[np.float64], drift: float = 0.0, repeats: int = 5
) -> NDArray[np.float64]:
    """Return the share of each exposure in which the source is lit: by 64 instants in it."""
    at_s = time_s[:, None] + EXPOSURE_S * ((np.arange(64) + 0.5) / 64.0 - 0.5)
    level = np.ones(at_s.shape)
    for start_s, word in packets:
        bits = np.array(bits_of(word) * repeats)
        number = np.floor((at_s - start_s) / (0.1 * (1.0 + drift))).astype(int)
        inside = (number >= 0) & (number < len(bits))
        level[inside] = bits[number[inside]]
    return np.asarray(level.mean(axis=1))
