"""What all tests share."""

import importlib.util

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip, by name, what needs Mitsuba where it has no wheel."""
    if importlib.util.find_spec("mitsuba") is not None:
        return
    skip = pytest.mark.skip(reason="needs Mitsuba, which is not installed")
    for item in items:
        if item.get_closest_marker("mitsuba") is not None:
            item.add_marker(skip)
