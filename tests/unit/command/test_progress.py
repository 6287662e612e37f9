"""What a long command says while one waits."""

import time

import pytest

from nir_render.command.terminal import progress
from nir_render.command.terminal.progress import progress_bar


@pytest.mark.parametrize(
    ("compiles", "done", "told"), [(True, 0, True), (True, 1, False), (False, 0, False)]
)  # fmt: skip
def test_a_first_step_that_takes_long_is_told_of_once(
    compiles: bool, done: int, told: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_SLOW_AFTER_S", 0.05)
    with progress_bar("perceive", compiles=compiles) as move:
        move(0, 3)
        move(done, 3)
        time.sleep(0.3)
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("compiles its loops now, once: about a minute") == told
