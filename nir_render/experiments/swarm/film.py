"""The film of a run of the swarm, and its last picture: both from what was drawn as it went."""

import shutil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError

FILM, PICTURE = "film.mp4", "swarm.png"
PICTURES = "pictures"
"""Where they lie in a run's folder, by the number of their set."""

MOST_PICTURES = 450
_RATE_HZ = 30.0
_SMALL = (cv2.IMWRITE_PNG_COMPRESSION, 9)
_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 90)


def picture_file(number: int, last: bool) -> str:
    """Return the name of a set's picture in a run's folder: the last one loses nothing."""
    return f"{PICTURES}/{number:06d}" + (".png" if last else ".jpg")


def encoded(picture: NDArray[np.uint8], last: bool) -> bytes:
    """Return a picture as that file."""
    done, buffer = cv2.imencode(".png", picture, _SMALL) if last else cv2.imencode(".jpg", picture, _QUALITY)
    if not done:
        raise RuntimeError("OpenCV could not encode a picture of the swarm")
    return buffer.tobytes()


def show_run(run: Path, folder: Path) -> tuple[str | None, str | None]:
    """Make film and last picture of a run in the experiment's folder.

    Returns
    -------
    Their names; None of a film where the run has no two pictures or OpenCV cannot write VP9, None of a
    picture where the run has none.

    Raises
    ------
    InputError
        A picture of the run is broken.
    """
    files = sorted((run / PICTURES).glob("*.*g"))
    if not files:
        return None, None
    shutil.copyfile(files[-1], folder / PICTURE)
    if len(files) < 2:
        return None, PICTURE
    rows, columns = _read(files[0]).shape[:2]
    aside = folder / f".partial-{FILM}"
    writer = cv2.VideoWriter(str(aside), cv2.VideoWriter.fourcc(*"vp09"), _RATE_HZ, (columns, rows))
    if not writer.isOpened():
        aside.unlink(missing_ok=True)
        return None, PICTURE
    for file in files:
        writer.write(_read(file))
    writer.release()
    aside.replace(folder / FILM)
    return FILM, PICTURE


def _read(file: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(file))
    if picture is None:
        raise InputError(f"{file}: no picture; remove the folder of this seed, and it runs anew")
    return np.asarray(picture, dtype=np.uint8)
