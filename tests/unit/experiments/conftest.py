"""What tests of closed loops share."""

import pytest

from nir_render.experiments.loop import film


@pytest.fixture
def short_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of three pictures: the full ones of a run cost more than the run."""
    monkeypatch.setattr(film, "_MOST_PICTURES", 3)
