"""What is to be fitted: a window, what may lie in it, and first guesses of its flares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.layout import UNUSABLE, Structure, View, even
from perception.robust.search.structure import joined

Array = NDArray[np.float64]

Start = tuple[float, float, float]
"""First guess of (u_px, v_px, ln range) of a flare, its range as the flux alone says."""

Motion = tuple[float, float]
"""How far a flare moves along u and v during the exposure, in pixels; m and -m are the same."""


@dataclass(frozen=True, eq=False)
class Window:
    """A square part of a frame to be explained by flares, in electrons.

    Attributes
    ----------
    box
        Where it is; it may reach beyond the frame.
    image_e, state
        Shape (height, width); the state of a pixel is one of `model.layout`'s.
    floor_e2, clip_e, prnu
        Variance of a dark pixel, electrons at which one clips, relative spread of the pixels' responses.
    structure, structure_e
        What may lie on the background beside flares, and its standard deviation; None and 0 where it is even.
    on_edges
        Whether that structure is not the frame's texture but something sharper, found in the window itself.
    known_e, unsure
        Light that is there beside flares and background, shape (height, width); None where there is none. And
        what is not known of it, which lies on top of any structure; None where nothing is.
    features
        Straight edges or highlights on the background, with what is not known of them; None where none are.
    to_beat
        −2 ln L of a fit that is worth no further step if it is sure to be less likely.
    """

    box: PixelBox
    image_e: Array
    state: NDArray[np.uint8]
    floor_e2: float
    clip_e: float
    prnu: float
    structure: Structure | None = None
    structure_e: float = 0.0
    on_edges: bool = False
    known_e: Array | None = None
    unsure: Structure | None = None
    features: Structure | None = None
    to_beat: float = math.inf

    @cached_property
    def view(self) -> View:
        """The window as compiled loops see it."""
        known_e = np.zeros(self.image_e.shape) if self.known_e is None else self.known_e
        return View(self.box.top, self.box.left, self.image_e, self.state, self.floor_e2, known_e)

    @cached_property
    def beside(self) -> Structure:
        """All that may lie beside flares and even background."""
        whole = self.structure
        for more in (self.unsure, self.features):
            if more is not None:
                whole = joined(whole, more)
        return even(self.image_e.size) if whole is None else whole

    @property
    def is_even(self) -> bool:
        """Whether the background has neither structure nor features; halos of flares it may have."""
        return self.features is None and self.structure_e == 0.0

    @property
    def diagonal_px(self) -> float:
        """How far apart its corners are: of a disc in it whose radius is larger no limb is seen."""
        return math.hypot(*self.image_e.shape)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which pixels count, clipped ones too."""
        return np.not_equal(self.state, UNUSABLE)


@dataclass(frozen=True, eq=False)
class Problem:
    """A window, first guesses of its flares, of its background, and of how each moves; None: none does."""

    window: Window
    starts: Sequence[Start]
    background_e: float
    motions: Sequence[Motion] | None = None
