"""Scores of tracks against truth: HOTA, IDF1, CLEAR MOT and GOSPA, from similarities at each instant.

HOTA: Luiten et al., Int. J. Comput. Vis. 129, 548 (2021). IDF1: Ristani et al., ECCV workshops (2016). CLEAR:
Bernardin and Stiefelhagen, EURASIP J. Image Video Process. (2008). GOSPA: Rahmathullah et al., FUSION (2017).
Where the papers leave ties open the choices are TrackEval's, so that figures can be compared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Similarities from which on a pair counts; HOTA is the mean over them."""

MATCH = 0.5
"""The similarity from which on a pair counts in IDF1 and CLEAR."""

_EPSILON = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Instant:
    """Who is there, whom a tracker says is there, and how like they are, at one time.

    `truth`, shape (n,), and `tracks`, shape (m,), are identities, none twice; `similarity`, shape (n, m), is
    from 0 to 1.
    """

    truth: NDArray[np.int64]
    tracks: NDArray[np.int64]
    similarity: Array


@dataclass(frozen=True)
class TrackScores:
    """Scores over all instants; NaN where there is nothing to score.

    `hota`, with its parts `detection_accuracy` and `association_accuracy`; `idf1`; `mota` with `switches` and
    `fragments`, `hits`, `misses` and `false_alarms`.
    """

    hota: float
    detection_accuracy: float
    association_accuracy: float
    idf1: float
    mota: float
    switches: int
    fragments: int
    hits: int
    misses: int
    false_alarms: int


def track_scores(instants: Sequence[Instant]) -> TrackScores:
    """Score a tracker over the instants of one observer, or those of several, one after the other.

    Several have no identity in common. An instant of another between two of one would break its runs.

    Raises
    ------
    ValueError
        An identity stands twice in an instant.
    """
    for instant in instants:
        for who in (instant.truth, instant.tracks):
            if len(np.unique(who)) < len(who):
                raise ValueError("an identity stands twice in one instant; give each of them once")
    truth_names, track_names = (
        np.unique(np.concatenate([np.empty(0, np.int64), *ids]))
        for ids in ([each.truth for each in instants], [each.tracks for each in instants])
    )
    numbered = [
        Instant(
            np.searchsorted(truth_names, each.truth),
            np.searchsorted(track_names, each.tracks),
            each.similarity,
        )
        for each in instants
    ]
    shape = (len(truth_names), len(track_names))
    hota, detection, association = _hota(numbered, shape)
    clear = _clear(numbered, shape)
    return TrackScores(hota, detection, association, _idf1(numbered, shape), *clear)


def _counts(instants: Sequence[Instant], shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return in how many instants each of the truth, and each track, is there."""
    truth, tracks = np.zeros(shape[0]), np.zeros(shape[1])
    for instant in instants:
        truth[instant.truth] += 1.0
        tracks[instant.tracks] += 1.0
    return truth, tracks


def _hota(instants: Sequence[Instant], shape: tuple[int, int]) -> tuple[float, float, float]:
    truth_count, track_count = _counts(instants, shape)
    overlap = np.zeros(shape)
    for instant in instants:
        similar = instant.similarity
        union = similar.sum(axis=0)[None, :] + similar.sum(axis=1)[:, None] - similar
        share = np.divide(similar, union, out=np.zeros_like(similar), where=union > _EPSILON)
        overlap[np.ix_(instant.truth, instant.tracks)] += share
    both = truth_count[:, None] + track_count[None, :]
    alignment = overlap / (both - overlap)
    matched = np.zeros((len(ALPHAS), *shape))
    for instant in instants:
        at = np.ix_(instant.truth, instant.tracks)
        rows, columns = linear_sum_assignment(-alignment[at] * instant.similarity)
        passes = instant.similarity[rows, columns] >= ALPHAS[:, None] - _EPSILON
        matched[:, instant.truth[rows], instant.tracks[columns]] += passes
    hits = matched.sum(axis=(1, 2))
    present = truth_count.sum() + track_count.sum()
    if present == 0.0:
        return math.nan, math.nan, math.nan
    association = (matched * matched / np.maximum(1.0, both - matched)).sum(axis=(1, 2)) / np.maximum(
        1.0, hits
    )
    detection = hits / (present - hits)
    return (
        float(np.sqrt(detection * association).mean()),
        float(detection.mean()),
        float(association.mean()),
    )


def _idf1(instants: Sequence[Instant], shape: tuple[int, int]) -> float:
    """Return 2 IDTP / (truth + tracks), identities paired once for all."""
    truth_count, track_count = _counts(instants, shape)
    together = np.zeros(shape)
    for instant in instants:
        together[np.ix_(instant.truth, instant.tracks)] += instant.similarity >= MATCH
    rows, columns = linear_sum_assignment(-together)
    present = truth_count.sum() + track_count.sum()
    return float(2.0 * together[rows, columns].sum() / present) if present else math.nan


def _clear(instants: Sequence[Instant], shape: tuple[int, int]) -> tuple[float, int, int, int, int, int]:
    """Return MOTA, switches, fragments, hits, misses, false alarms.

    A pair of the instant before stays one where it may.
    """
    last_track = np.full(shape[0], -1)  # of each truth, at any time before
    just_before = np.full(shape[0], -1)  # of each truth, in the last instant in which it was there
    runs = np.zeros(shape[0])
    switches = hits = misses = false_alarms = 0
    for instant in instants:
        similar = np.where(instant.similarity >= MATCH - _EPSILON, instant.similarity, 0.0)
        goes_on = just_before[instant.truth][:, None] == instant.tracks[None, :]
        rows, columns = linear_sum_assignment(-(1000.0 * goes_on * (similar > 0.0) + similar))
        paired = similar[rows, columns] > 0.0
        truth, tracks = instant.truth[rows[paired]], instant.tracks[columns[paired]]
        switches += int(((last_track[truth] >= 0) & (last_track[truth] != tracks)).sum())
        runs[truth] += just_before[truth] < 0
        last_track[truth] = tracks
        if instant.similarity.size:  # as TrackEval does: an instant without any of either breaks nothing
            just_before[:] = -1
            just_before[truth] = tracks
        hits += len(truth)
        misses += len(instant.truth) - len(truth)
        false_alarms += len(instant.tracks) - len(truth)
    fragments = int(np.maximum(runs - 1.0, 0.0).sum())
    total = hits + misses
    mota = (hits - false_alarms - switches) / total if total else math.nan
    return mota, switches, fragments, hits, misses, false_alarms


def gospa_m(apart_m: Array, cut_off_m: float = 1.0, power: float = 2.0) -> float:
    """Return the GOSPA distance (α = 2) of two sets of points from their distances, shape (n, m).

    (min Σ dᵖ over pairs + cᵖ / 2 for each of the unpaired)^(1/p), in metres; 0 for two empty sets.
    """
    n, m = apart_m.shape
    capped = np.minimum(apart_m, cut_off_m) ** power
    rows, columns = linear_sum_assignment(capped)
    paired = apart_m[rows, columns] < cut_off_m
    alone = n + m - 2 * int(paired.sum())
    return float((capped[rows, columns][paired].sum() + 0.5 * cut_off_m**power * alone) ** (1.0 / power))
