"""Workers that are killed at a bad moment."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
from distributed import Client
from distributed.comm import CommClosedError

from nir_render.stress.workers.pool import _Context, _tell_workers


@pytest.mark.parametrize(("kills", "survives"), [(0, True), (3, True), (4, False)])
def test_a_worker_killed_while_it_is_told_does_not_end_the_campaign(kills: int, survives: bool) -> None:
    """Dask then closes the line to all of them; four times in a row is no accident."""
    told: list[Any] = []

    def register_plugin(plugin: Any, name: str) -> None:
        told.append(plugin)
        if len(told) <= kills:
            raise CommClosedError("Stream is closed")

    client = cast("Client", SimpleNamespace(register_plugin=register_plugin))
    context = cast("_Context", None)
    if survives:
        _tell_workers(client, context, "name")
        assert len(told) == kills + 1
    else:
        with pytest.raises(CommClosedError):
            _tell_workers(client, context, "name")
