"""Structure as products of cosines: the same as the same structure as any columns, and the sums it takes."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.layout import CLIPPED, SEEN, UNUSABLE, Structure, View, any_of
from perception.model.likelihood.cosines import cosine_sums
from perception.model.likelihood.pixels import expectation, slopes, take_last_step
from perception.model.likelihood.products import factorised, inverted, solved, variance_of
from perception.model.window import Camera, lay_out
from perception.robust.search.structure import joined, structure_of
from tests.unit.perception.robust.test_eclipse import CAMERA
from tests.unit.perception.simulation import random

Array = NDArray[np.float64]

SIDE, CLIP_E = 19, 3e3
FLARES = ((11.3, 8.6, math.log(2.1)), (14.2, 12.9, math.log(2.6)))


def _structures() -> tuple[Structure, Structure]:
    """A structure of waves, and two more columns; and the same of columns alone."""
    correlation = tuple(np.exp(-(np.arange(40.0) ** 2) / 30.0).tolist())
    more = any_of(random(1).random((2, SIDE**2)), np.diag([0.3, 0.7]))
    structure = joined(structure_of(correlation, SIDE, 4.0), more)
    return structure, any_of(np.concatenate([structure.waves, structure.columns]), structure.precision)


def _slopes(structure: Structure, *, of_average: bool) -> tuple[Array, Array, Array]:
    """λ, gradient and information of two flares, on structure, with a dead and a clipped pixel."""
    camera = Camera(CAMERA, 1e-3, 1.0)
    u_px, v_px, log_range = np.array(FLARES).T
    sources, imaged = lay_out(camera, u_px, v_px, log_range)
    assert imaged.all()
    state = np.full((SIDE, SIDE), SEEN, dtype=np.uint8)
    state[2, 5], state[8, 9] = UNUSABLE, CLIPPED
    image_e = random(2).poisson(200.0, (SIDE, SIDE)).astype(np.float64)
    view = View(3, 2, image_e, state, 30.0, random(3).random((SIDE, SIDE)))
    known = camera.known(CLIP_E)
    layout = known.layout(len(FLARES), structure.amplitudes)
    values = random(4).random(layout.size)
    layout.of_sources(values)[:, :3] = FLARES
    pixels, rows = SIDE**2, layout.size - len(structure.order)
    expected, variance, jacobian = np.empty(pixels), np.empty(pixels), np.empty((rows, pixels))
    gradient, information = np.empty(layout.size), np.empty((layout.size, layout.size))
    expectation(values, view, sources, structure, known, expected, jacobian, variance)
    slopes(
        view, structure, layout.background + 1, values, expected, jacobian, variance,
        layout.prior(structure, known.motion_px), CLIP_E, of_average, gradient, information,
    )  # fmt: skip
    return expected, gradient, information


@pytest.mark.parametrize("of_average", [False, True])
def test_waves_are_columns_like_any_other(of_average: bool) -> None:
    """λ, gradient and information are those of the same columns summed pixel by pixel, to rounding."""
    waves, columns = _structures()
    assert len(waves.order) > 20
    for of_waves, of_columns in zip(
        _slopes(waves, of_average=of_average), _slopes(columns, of_average=of_average), strict=True
    ):
        assert of_waves == pytest.approx(of_columns, rel=1e-11, abs=1e-11 * np.abs(of_columns).max())


def test_light_is_that_of_all_columns() -> None:
    """What is taken off to have the flares alone."""
    waves, columns = _structures()
    amplitudes = random(5).normal(size=waves.amplitudes)
    assert waves.light(amplitudes) == pytest.approx(amplitudes @ columns.columns, rel=1e-12, abs=1e-12)
    assert waves.log_determinant == pytest.approx(columns.log_determinant, rel=1e-12)


@pytest.mark.parametrize("side", [4, 5, 6, 7, 33])
def test_sums_with_cosines(side: int) -> None:
    """Rows left over when four are taken at once count, too."""
    image = random(6, side).random((side, side))
    cosines = np.cos(np.pi * np.arange(8)[:, None] * (np.arange(side) + 0.5) / side)
    assert cosine_sums(image, cosines, 6)[:, :6] == pytest.approx(cosines[:6] @ image @ cosines[:6].T)


def test_inverse_by_its_factor() -> None:
    """Solution, variances, inverse and determinant of a matrix whose scales are far apart."""
    root = random(7).normal(size=(14, 20))
    scales = np.logspace(-6.0, 6.0, 14)
    matrix = scales[:, None] * (root @ root.T) * scales
    right = scales * random(8).normal(size=14)
    scale, factor, solution, inverse = np.empty(14), np.empty((14, 14)), np.empty(14), np.empty((14, 14))
    wanted = np.linalg.inv(root @ root.T) / scales / scales[:, None]
    log_det = float(np.linalg.slogdet(root @ root.T)[1] + 2.0 * np.log(scales).sum())
    assert factorised(matrix, scale, factor) == pytest.approx(log_det, rel=1e-12)
    solved(scale, factor, right, solution)
    assert solution * scales == pytest.approx(wanted @ right * scales, rel=1e-9)
    variances = [variance_of(scale, factor, one) for one in range(14)]
    assert variances == pytest.approx(np.diagonal(wanted).tolist(), rel=1e-10)
    assert inverted(matrix, inverse) == pytest.approx(log_det, rel=1e-12)
    assert inverse * scales * scales[:, None] == pytest.approx(wanted * scales * scales[:, None], rel=1e-9)


@pytest.mark.parametrize("at", [0, 3])
def test_a_singular_matrix_has_no_factor(at: int) -> None:
    """Nor one with a diagonal that is not positive, or not finite; nothing is written then."""
    for wrong in (0.0, -1.0, math.nan, math.inf):
        matrix, inverse = np.eye(5), np.full((5, 5), 7.0)
        matrix[at, at] = wrong
        assert math.isnan(inverted(matrix, inverse))
        assert (inverse == 7.0).all()
    twice = np.ones((5, 5))
    assert math.isnan(inverted(twice, inverse))


@pytest.mark.parametrize("kind", [0, 1])
def test_a_last_step_goes_where_the_whole_expectation_is(kind: int) -> None:
    """But for the square of a step in all unknowns, of waves or of any columns: a tenth of it errs by a hundredth."""
    structure, camera = _structures()[kind], Camera(CAMERA, 1e-3, 1.0)
    sources, _ = lay_out(camera, *np.array(FLARES).T)
    seen = np.full((SIDE, SIDE), SEEN, dtype=np.uint8)
    view = View(3, 2, np.zeros((SIDE, SIDE)), seen, 30.0, random(3).random((SIDE, SIDE)))
    known = camera.known(CLIP_E)
    layout = known.layout(len(FLARES), structure.amplitudes)
    first, rows = layout.background + 1, layout.size - len(structure.order)
    errors, changes = [], []
    for share in (1.0, 0.1):
        values, shift = random(4).random(layout.size), share * 0.02 * random(7).normal(size=layout.size)
        layout.of_sources(values)[:, :3] = FLARES
        told, there = ((np.empty(SIDE**2), np.empty((rows, SIDE**2)), np.empty(SIDE**2)) for _ in range(2))
        expectation(values + shift, view, sources, structure, known, *there)
        expectation(values, view, sources, structure, known, *told)
        before, aim = told[0].copy(), values + shift
        take_last_step(view, structure, known, first, shift, values, told[1], told[0], told[2])
        assert values == pytest.approx(aim, rel=1e-15)
        errors.append(np.abs(told[0] - there[0]).max())
        changes.append(np.abs(there[0] - before).max())
        lit_e = np.maximum(told[0], 0.0)
        assert told[2] == pytest.approx(lit_e + (known.prnu * lit_e) ** 2 + 30.0, rel=1e-12)
    assert errors[1] == pytest.approx(0.01 * errors[0], rel=0.2)
    assert errors[1] < 0.01 * changes[1]
