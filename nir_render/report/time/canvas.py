"""What films of experiments are drawn with: the pages' colours as OpenCV wants them, and writing."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.report.style import FAINT, GROUND, INK, LINE, PANEL

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]


def bgr(colour: str) -> Colour:
    """Return a colour of the pages as OpenCV wants it.

    >>> bgr("#ff9f1c")
    (28, 159, 255)
    """
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


INK_BGR, FAINT_BGR, GROUND_BGR, PANEL_BGR, LINE_BGR = map(bgr, (INK, FAINT, GROUND, PANEL, LINE))


def write(canvas: Picture, text: str, at: tuple[int, int], size: int, colour: Colour) -> None:
    """Write into a canvas; `at` is where the line of the letters begins, in pixels."""
    cv2.putText(canvas, text, at, colour, _FACE, size)


_FACE = cv2.FontFace("sans")
