from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from nir_render.scene.problems import explain
from nir_render.stress.design.axes import Axis, AxisDocument


def axis(written: Any, name: str = "robots.r2.position.x") -> Axis:
    return AxisDocument.model_validate(written).axis(name)


def test_a_list_is_an_axis_and_its_name_is_its_path() -> None:
    read = axis(["3 m", "1 m", "250 cm"])
    assert read.paths == ("robots.r2.position.x",)
    assert read.values == ("1 m", "250 cm", "3 m")  # in order; as written
    assert read.numbers == (1.0, 2.5, 3.0)
    assert read.values_si == (1.0, 2.5, 3.0)
    assert (read.unit, read.labels, read.log) == ("m", ("1 m", "2.5 m", "3 m"), False)
    assert read.settings(1) == {"robots.r2.position.x": "250 cm"}


def test_a_value_keeps_the_digits_it_was_written_with() -> None:
    read = axis({"path": ["a.b", "a.c"], "values": ["0.3 ms", "20 us"]}, "exposure")
    assert read.numbers == (0.02, 0.3)  # in the first one's unit
    assert read.values_si == pytest.approx((20e-6, 0.3e-3), rel=1e-15)
    assert read.settings(0) == {"a.b": "20 us", "a.c": "20 us"}


def test_ranges_by_steps_and_by_ratios() -> None:
    steps = axis({"from": 0.1, "to": 0.7, "count": 4})
    assert steps.values == (0.1, 0.3, 0.5, 0.7)
    ratios = axis({"from": "20 us", "to": "2 ms", "count": 3, "spacing": "log"})
    assert ratios.values == ("20 us", "200 us", "2000 us")
    assert ratios.values_si == pytest.approx((2e-5, 2e-4, 2e-3), rel=1e-12)
    assert ratios.log
    whole = axis({"from": 2, "to": 8, "count": 3}, "render.indirect.max_depth")
    assert whole.values == (2, 5, 8)
    assert all(isinstance(value, int) for value in whole.values)


def test_what_is_no_number_has_labels() -> None:
    mixed = axis({"values": [{"type": "diffuse", "reflectance": 0.5}, "steel.yaml"]}, "materials.wall")
    assert mixed.labels == ("{reflectance: 0.5, type: diffuse}", "steel.yaml")
    assert mixed.numbers is None
    named = axis({"values": ["20 m", None], "labels": ["fog", "clear"]}, "fog")
    assert (named.labels, named.numbers, named.values) == (("fog", "clear"), None, ("20 m", None))


def test_spacing_of_a_list_is_read_off_it() -> None:
    assert axis([1, 10, 100]).log
    assert axis([1, 2, 4, 8]).log
    assert not axis([1, 2, 3, 4]).log
    assert not axis([0, 1, 10]).log
    assert not axis([1, 100]).log  # two tell nothing


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"from": "1 m", "to": "5 s", "count": 3}, "a length and a time"),
        ({"from": "1 m", "to": "5", "count": 3}, "a length and a fraction"),
        ({"from": "here", "to": "5 m", "count": 3}, "'here' is no number"),
        ({"from": 0.0, "to": 5.0, "count": 3, "spacing": "log"}, "above 0"),
        ({"from": "1 m", "to": "100 cm", "count": 3}, "the same"),
        ({"from": "1 m", "to": "5 m"}, "needs 'from', 'to' and 'count'"),
        (["1 m", "100 cm"], "stands twice"),
        (["a", "a"], "stands twice"),
    ],
)  # fmt: skip
def test_an_axis_without_sense_says_so(written: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        axis(written)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"from": "1 m", "count": 3}, "needs 'from', 'to' and 'count'"),
        ({"values": [1], "count": 3}, "write either"),
        ({"path": "a.b"}, "write either"),
        ({"values": [1, 2], "labels": ["one"]}, "as many"),
        ({"values": [1, 2], "labels": ["one", "one"]}, "the same"),
        ({"valeus": [1, 2]}, "did you mean 'values'"),
        ({"values": []}, "at least 1"),
        ("1 m", "stands where keys with values are wanted"),
    ],
)  # fmt: skip
def test_an_axis_badly_written_says_so(written: Any, said: str, tmp_path: Path) -> None:
    (tmp_path / "axis.yaml").write_text(yaml.safe_dump(written))
    with pytest.raises(ValidationError) as refused:
        AxisDocument.model_validate(written)
    (problem,) = explain(refused.value, written, str(tmp_path / "axis.yaml"))
    assert said in problem
