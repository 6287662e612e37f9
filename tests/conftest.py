"""What all tests share."""

import importlib.util
import os

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip, by name, what needs Mitsuba where it has no wheel, or a vectorised variant where there is none.

    And what is long, and says again what others say, unless it is asked for.
    """
    if "AT_LENGTH" not in os.environ:
        _skip(items, "at_length", "minutes: AT_LENGTH=1 make verify runs it too")
    if importlib.util.find_spec("mitsuba") is None:
        _skip(items, "mitsuba", "needs Mitsuba, which is not installed")
        return
    if any(item.get_closest_marker("vectorised") for item in items):
        from nir_render.transport.backend.variant import backend

        if not backend().vectorised:
            _skip(items, "vectorised", "needs an LLVM or CUDA variant")


def _skip(items: list[pytest.Item], marker: str, reason: str) -> None:
    for item in items:
        if item.get_closest_marker(marker) is not None:
            item.add_marker(pytest.mark.skip(reason=reason))
