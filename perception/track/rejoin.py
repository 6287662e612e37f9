"""A track that begins where a dark one must be by now goes on with its number."""

import numpy as np
from numpy.typing import NDArray

from perception.track.bank import Bank, replaced
from perception.track.kalman import States

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

REJOIN_ODDS, REJOIN_HITS = 8.0, 2
"""What a track must have gone through that began: less than for a number of its own."""

REJOIN_CHI2 = 28.0
"""χ² of six dimensions, exceeded by one in ten thousand."""


def rejoined(lost: Bank, begun: Bank) -> list[tuple[int, int]]:
    """Return which tracks that begin are the rest of which tracks that are not seen, as pairs of indices."""
    from scipy.optimize import linear_sum_assignment  # loads slowly

    ready = np.flatnonzero((begun.odds >= REJOIN_ODDS) & (begun.hits >= REJOIN_HITS))
    if not (len(ready) and len(lost.number)):
        return []
    rows, columns = (grid.ravel() for grid in np.meshgrid(np.arange(len(lost.number)), ready, indexing="ij"))
    apart, spread, _ = _apart(lost.taken(rows).states, begun.taken(columns).states)
    chi2 = np.einsum("ni,ni->n", apart, np.linalg.solve(spread, apart[:, :, None])[:, :, 0])
    table = np.minimum(chi2, REJOIN_CHI2).reshape(len(lost.number), len(ready))
    pairs = zip(*(side.tolist() for side in linear_sum_assignment(table)), strict=True)
    return [(row, int(ready[k])) for row, k in pairs if table[row, k] < REJOIN_CHI2]


def continued(bank: Bank, tracks: Indices, begun: Bank) -> Bank:
    """Return a bank in which tracks go on as others began, both estimates weighed."""
    old = bank.taken(tracks).states
    new = begun.states
    apart, spread, own = _apart(old, new)
    gain = np.linalg.solve(spread, own.transpose(0, 2, 1)).transpose(0, 2, 1)
    covariance = old.covariance - gain @ own.transpose(0, 2, 1)
    both = States(
        old.mean + np.einsum("nij,nj->ni", gain, apart),
        0.5 * (covariance + covariance.transpose(0, 2, 1)),
        old.common + np.einsum("nij,nj->ni", gain, new.common - old.common),
    )
    anchors = replaced(bank.anchors, tracks, both)
    seen_s, alone_s, hits = bank.seen_s.copy(), bank.alone_s.copy(), bank.hits.copy()
    seen_s[tracks], alone_s[tracks] = begun.seen_s, begun.alone_s
    hits[tracks] += begun.hits
    return bank.with_states(replaced(bank.states, tracks, both))._replace(
        anchor_mean=anchors.mean,
        anchor_covariance=anchors.covariance,
        anchor_common=anchors.common,
        seen_s=seen_s,
        alone_s=alone_s,
        hits=hits,
    )


def _apart(old: States, new: States) -> tuple[Array, Array, Array]:
    """Return the difference of estimates of one state, its covariance, and its covariance with the old error.

    Their errors have the consider state in common, and nothing else.
    """
    shared = old.common[:, :, None] * new.common[:, None, :]
    own = old.covariance - shared
    return new.mean - old.mean, own + new.covariance - shared.transpose(0, 2, 1), own
