"""Labels of what pixels show: numbers of keys, by where they are first seen."""

import numpy as np
import pytest

from nir_render.transport.indirect.labels import _numbered


@pytest.mark.parametrize(("keys", "step"), [(1, 1), (127, 1), (128, 2**17), (129, 256), (5000, 2**49 + 512)])
def test_keys_are_numbered_by_where_they_are_first_seen(keys: int, step: int) -> None:
    """As by sorting; also more of them than the table first has room for, and such as fall into one place."""
    drawn = np.random.default_rng(keys).integers(0, keys, 20_000) * step
    drawn = np.repeat(drawn, np.random.default_rng(1).integers(1, 5, drawn.size))
    labels, seen = _numbered(drawn)
    unique, first, inverse = np.unique(drawn, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    np.testing.assert_array_equal(labels, rank[inverse])
    np.testing.assert_array_equal(seen, unique[np.argsort(first)])
    assert labels.dtype == np.int32
