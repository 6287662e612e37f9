"""Axes whose values are drawn from unit to unit."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from nir_render.stress.campaign import load_campaign
from nir_render.stress.design.axes import AxisDocument
from tests.paths import SCENES

CENTROID = {"a.centroid": {"mean": "940 nm", "sigma": "4 nm"}}


def values(draw: Any, path: str, count: int = 1000, seed: int = 1) -> list[float]:
    axis = AxisDocument.model_validate({"draw": draw, "count": count, "seed": seed}).axis("unit")
    return [float(str(axis.settings(k)[path]).split()[0]) for k in range(count)]


def test_a_unit_is_the_same_whatever_else_is_drawn() -> None:
    few = AxisDocument.model_validate({"draw": CENTROID, "count": 3}).axis("unit")
    flux = {"a.flux": {"least": "0.1 W", "most": "0.2 W"}}
    many = AxisDocument.model_validate({"draw": {**flux, **CENTROID}, "count": 9}).axis("unit")
    assert many.settings(2)["a.centroid"] == few.settings(2)["a.centroid"]
    assert few.labels == ("unit 1", "unit 2", "unit 3")
    assert many.paths == ("a.flux", "a.centroid")
    other = AxisDocument.model_validate({"draw": CENTROID, "count": 3, "seed": 2}).axis("unit")
    assert other.settings(2) != few.settings(2)


def test_units_are_spread_as_stated() -> None:
    """Kolmogorov and Smirnov against the stated distributions; at 1e-3 a right one fails once in a thousand."""
    normal = values(CENTROID, "a.centroid")
    assert stats.kstest(normal, stats.norm(940.0, 4.0).cdf).pvalue > 1e-3
    cut = values({"a.b": {"mean": 1, "sigma": 0.2, "least": 0.8, "most": 1.3}}, "a.b")
    assert stats.kstest(cut, stats.truncnorm(-1.0, 1.5, 1.0, 0.2).cdf).pvalue > 1e-3
    even = values({"a.b": {"least": "300 mW", "most": "0.5 W"}}, "a.b")
    assert stats.kstest(even, stats.uniform(300.0, 200.0).cdf).pvalue > 1e-3


def test_paths_are_drawn_apart() -> None:
    draw = {"a.b": {"mean": 0, "sigma": 1}, "a.c": {"mean": 0, "sigma": 1}}
    assert abs(np.corrcoef(values(draw, "a.b"), values(draw, "a.c"))[0, 1]) < 4.0 / np.sqrt(1000.0)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"draw": CENTROID}, "'count' is missing"),
        ({"draw": CENTROID, "count": 3, "values": [1]}, "'values' has no place there"),
        ({"draw": {"a.b": {"mean": "940 nm"}}, "count": 3}, "wanted 'mean' and 'sigma'"),
        ({"draw": {"a.b": {"mean": "940 nm", "sigma": "1 s"}}, "count": 3}, "figures of one kind"),
        ({"draw": {"a.b": {"mean": "here", "sigma": "1 s"}}, "count": 3}, "'here' is no number"),
        ({"draw": {"a.b": {"mean": 1, "sigma": 0.01, "least": 2}}, "count": 3}, "not one unit in 1000"),
        ({"draw": {"a.b": {"mean": 1, "sigma": 0}}, "count": 3}, "wanted one above 0"),
    ],
)
def test_a_draw_without_sense_says_so(written: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        AxisDocument.model_validate(written).axis("unit")


def test_the_units_of_the_campaign_keep_the_data_sheets_limits() -> None:
    axis = load_campaign(SCENES / "campaigns/unit_spread.yaml").axes[1]
    for unit in range(len(axis.labels)):
        flux, wavelength = (
            axis.settings(unit)[f"robots.r2.rig.sources.top.unit.{key}"] for key in ("flux", "wavelength")
        )
        assert 0.71 <= flux <= 1.42
        assert abs(float(wavelength.removesuffix(" nm"))) <= 20.0
