"""Films of runs, and what is kept of a run as it goes."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from nir_render import load_scene
from nir_render.errors import InputError
from nir_render.experiments.flocking.loop import Flocking
from nir_render.experiments.flocking.outcome import ARENA
from nir_render.experiments.loop.film import film_into
from nir_render.experiments.loop.journal import Journal, Told, check_whole
from nir_render.experiments.loop.runs import run_folder, run_seed
from nir_render.export.mcap_file import export_mcap


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a flock that sees by measurements."""
    folder = tmp_path_factory.mktemp("flock")
    run_seed(load_scene(ARENA), Flocking(lasts_s=2.0), 1, folder)
    return folder


def test_a_run_is_kept_as_a_run_folder(run: Path, tmp_path: Path) -> None:
    record = json.loads((run / "runs" / "0001.json").read_text())
    done = export_mcap(run_folder(run, 1), tmp_path / "run.mcap")
    places_m = []
    with AnyReader([done.file]) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic == "/tf":
                (one,) = reader.deserialize(raw, connection.msgtype).transforms  # type: ignore[attr-defined]
                if one.child_frame_id == "follower1":
                    places_m.append([one.transform.translation.x, one.transform.translation.y])
    number = record["robots"].index("follower1")
    assert np.array(places_m) == pytest.approx(np.array(record["places_m"])[:, number], abs=1e-6)
    assert done.messages["/follower1/tracks/robust"] >= 17  # tracks begin at the third set


def test_a_film_shows_where_robots_are(run: Path, tmp_path: Path) -> None:
    """Its last picture: as many as steps; the leader's yellow, and whom follower1 follows ringed around it."""
    assert film_into(run_folder(run, 1), Flocking(lasts_s=2.0), "a flock", tmp_path / "film.mp4")
    film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    pictures = []
    while (got := film.read())[0]:
        pictures.append(got[1])
    assert len(pictures) == 20
    assert pictures[0].shape == (640, 1120, 3)
    above = pictures[-1][66:612, 20:580].astype(int)
    yellow = (abs(above - [0x66, 0xD1, 0xFF]).sum(axis=2) < 60).sum()
    assert yellow > 0.5 * np.pi * 8.0**2
    assert abs(pictures[-1].astype(int) - pictures[0].astype(int)).max() > 100


def test_a_journal_goes_on_from_where_it_was_saved(tmp_path: Path) -> None:
    """What a killed process wrote after its last save comes again, once."""
    journal = Journal.begin(tmp_path, [])
    journal.write(Told({"poses.jsonl": [{"a": 1}]}))
    saved = dict(journal.lengths)
    journal.write(Told({"poses.jsonl": [{"a": 2}], "tracks.robust.jsonl": [{"b": 1}]}))
    again = Journal(tmp_path, saved)
    again.write(Told({"poses.jsonl": [{"a": 2}], "tracks.robust.jsonl": []}))
    again.write(Told({"poses.jsonl": [{"a": 3}], "tracks.robust.jsonl": [{"b": 2}]}))
    lines = (tmp_path / "poses.jsonl").read_text().splitlines()
    assert [json.loads(line)["a"] for line in lines] == [1, 2, 3]
    assert (tmp_path / "tracks.robust.jsonl").read_text() == '{"b": 2}\n'
    check_whole(again)
    (tmp_path / "poses.jsonl").write_text("")
    with pytest.raises(InputError, match="shorter than the run's saved state says"):
        check_whole(again)
