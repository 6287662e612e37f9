"""What a lone disc's limb leaves room for: as much as noise says of whole discs, and more of others."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception import RawFrame, detect
from perception.model.window import Camera
from perception.robust.overlap.deblend import LEAST_GAIN, asks_for_more, gain
from perception.robust.overlap.limb import gain_by_limb, may_be_other_shape
from perception.robust.solve import Solution
from tests.unit.perception.robust.test_cut import cut_e_per_s
from tests.unit.perception.robust.test_eclipse import BACKGROUND_E, CAMERA, Place, union_e_per_s
from tests.unit.perception.simulation import expose, random

Array = NDArray[np.float64]
PLACE: Place = (31.3, 31.6, 1.6)
FAINT_E = 80.0


def _faint(mean_e_per_s: Array, key: int) -> RawFrame:
    """Return a frame whose peak is six times the noise of a pixel: the model's own error hardly counts."""
    exposure_s = FAINT_E / float(mean_e_per_s.max())
    return expose(mean_e_per_s * exposure_s + BACKGROUND_E, CAMERA, random(81, key), exposure_s)


def _fitted(frame: RawFrame) -> Solution:
    """Return what one whole disc explains of a frame's only blob."""
    seen: list[Solution | None] = []

    def look(_: object, plain: Sequence[Solution | None], *others: object) -> dict[int, Solution]:
        seen.extend(plain)
        return {}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("perception.robust.explain.cut_discs", look)
        detect(frame, CAMERA)
    (one,) = seen
    assert one is not None
    return one


def test_of_whole_discs_it_gains_what_noise_gives() -> None:
    """Radius 7.5 px: ten harmonics, less place, which the fit has found: χ² of 18.

    Nearly all such discs' pixels ask for more, as there are so many of them; hardly any may be of another shape.
    """
    mean_e_per_s, gains, asking, open_to = union_e_per_s([PLACE]), [], 0, 0
    for key in range(20):
        frame = _faint(mean_e_per_s, key)
        one, camera = _fitted(frame), Camera(CAMERA, frame.exposure_s, frame.gain)
        asking += asks_for_more(one)
        gains.append(gain_by_limb(one, camera))
        open_to += may_be_other_shape(one, camera)
    assert np.mean(gains) == pytest.approx(18.0, abs=4.0 * math.sqrt(2.0 * 18.0 / 20.0))
    assert asking >= 17
    assert open_to <= 2


@pytest.mark.parametrize(
    ("shown", "turn_rad", "times"), [(0.93, 0.3, 2.0), (0.9, 2.0, 1.0), (0.85, 4.0, 1.0)]
)
def test_of_a_cut_disc_it_gains_what_the_edge_does(shown: float, turn_rad: float, times: float) -> None:
    """2 Δ ln L between what fits and what is, 80 to 200, but for what noise adds to the harmonics."""
    mean_e_per_s = cut_e_per_s(PLACE, shown, turn_rad)
    exposure_s = times * FAINT_E / float(mean_e_per_s.max())
    mean_e = mean_e_per_s * exposure_s + BACKGROUND_E
    for key in range(2):
        frame = expose(mean_e, CAMERA, random(82, key), exposure_s)
        one = _fitted(frame)
        box = one.window.box.inside(mean_e.shape)
        truth_e = np.zeros(one.window.image_e.shape)
        truth_e[box.seen_from(one.window.box).slices] = mean_e[box.slices]
        real = gain(one, replace(one, expected_e=truth_e))
        assert real > LEAST_GAIN
        by_limb = gain_by_limb(one, Camera(CAMERA, exposure_s, frame.gain))
        assert 0.85 * real < by_limb < real + 18.0 + 5.0 * math.sqrt(2.0 * 18.0)
        assert may_be_other_shape(one, Camera(CAMERA, exposure_s, frame.gain))


def test_of_a_disc_in_glare_it_gains_nothing() -> None:
    """A tenth of its light spread over 6 px asks for more flares, but all that is left is round."""
    mean_e_per_s = union_e_per_s([PLACE])
    mean_e_per_s = 0.9 * mean_e_per_s + 0.1 * gaussian_filter(mean_e_per_s, 6.0)
    exposure_s = 10.0 * FAINT_E / float(mean_e_per_s.max())
    frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, CAMERA, random(84, 0), exposure_s)
    one, camera = _fitted(frame), Camera(CAMERA, frame.exposure_s, frame.gain)
    assert asks_for_more(one)
    assert not may_be_other_shape(one, camera)
