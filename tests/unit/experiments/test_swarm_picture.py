"""What is drawn of a swarm: where robots and tracks are, who said who it is, and the film of it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from nir_render import load_scene
from nir_render.experiments.swarm.film import FILM, PICTURE, encoded, picture_file, show_run
from nir_render.experiments.swarm.hall import HALL, OBSERVER
from nir_render.experiments.swarm.picture import Moment, SwarmPicture
from nir_render.report.style import FAIR, GOOD
from nir_render.scene.pose import Pose
from nir_render.simulation.calibration import calibration
from perception import Message, RawFrame, Track

CAMERA = f"{OBSERVER}.front"
TURN = Pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))  # it looks along y


def _track(number: int, x_m: float, y_m: float, seen: bool = True) -> Track:
    detections = ((CAMERA, 0, number),) if seen else ()
    place = np.array([x_m, y_m, 0.28])
    return Track(OBSERVER, 1.0, number, place, np.zeros(3), 1e-6 * np.eye(6), detections)


def _has(picture: np.ndarray, colour: str, left: int, top: int) -> bool:
    """Tell whether a ring of five pixels about a place has a colour of the pages."""
    around = picture[top - 7 : top + 8, left - 7 : left + 8].astype(int)
    bgr = [int(colour[i : i + 2], 16) for i in (5, 3, 1)]
    return bool((abs(around - bgr).sum(axis=2) < 60).any())


def test_tracks_are_drawn_where_they_are() -> None:
    """By hand: 584 px for a hall of 10 m about (316, 352); ahead, body x, is y of the world, up the picture."""
    known = calibration(load_scene(HALL), CAMERA)
    places_m = np.array([[0.0, 0.0], [0.0, 2.0], [-1.0, 3.0]])
    words = [Message(OBSERVER, 7, 0.0, 5.5, 2, "x", confidence=1.0, frames=5)]
    counts = np.full((known.height_px, known.width_px), round(known.black_level_dn), dtype=np.uint16)
    frame = RawFrame(CAMERA, 0, 1.0, 1e-4, counts, known.black_level_dn)
    moment = Moment(1.0, [frame], [_track(4, 2.0, 0.0), _track(7, 3.0, 1.0)], words)
    picture = SwarmPicture(places_m, TURN, {CAMERA: known}, 10.0).drawn(moment)
    step_px = 58.4
    assert _has(picture, FAIR, 316, round(352 - 2 * step_px))
    assert not _has(picture, GOOD, 316, round(352 - 2 * step_px))
    assert _has(picture, GOOD, round(316 - step_px), round(352 - 3 * step_px))
    assert not _has(picture, FAIR, round(316 + step_px), round(352 - 3 * step_px))
    assert picture.shape[0] % 2 == 0
    # In the strip, 968 px of 1280: ahead is the middle; the source is 0.08 m above a lens 0.06 m ahead.
    strip = picture[-140:]
    columns = np.flatnonzero((abs(strip.astype(int) - [10, 165, 229]).sum(axis=2) < 60).any(axis=0))
    assert columns.mean() == pytest.approx(16 + 968 * (known.cx_px + 0.5) / known.width_px, abs=1.0)


def test_a_film_and_the_last_picture(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "pictures").mkdir(parents=True)
    assert show_run(run, tmp_path) == (None, None)
    for number in range(4):
        picture = np.full((40, 60, 3), 60 * number, dtype=np.uint8)
        (run / picture_file(number, number == 3)).write_bytes(encoded(picture, number == 3))
    film, last = show_run(run, tmp_path)
    assert last == PICTURE
    drawn = cv2.imread(str(tmp_path / PICTURE))
    assert drawn is not None
    assert np.unique(drawn).tolist() == [180]
    if film is None:
        pytest.skip("this OpenCV cannot write VP9")
    shown = cv2.VideoCapture(str(tmp_path / FILM))
    assert shown.get(cv2.CAP_PROP_FRAME_COUNT) == 4
