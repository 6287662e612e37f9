"""The page: what it says, that it needs no network, and that nothing of the user's becomes markup."""

import math
import re
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from nir_render.evaluate.metrics import evaluate
from nir_render.report.drawing import sheet, svg_of
from nir_render.report.page import report_html
from nir_render.report.style import MATPLOTLIB
from nir_render.truth.sources import SourceTruth
from perception.causes import CAUSES, DetectionCauses
from perception.types import Detection, FrameKey
from tests.unit.report.cases import Page, calibration, detection, frame, truth

HOSTILE = "<script>alert('$x$ & y')</script>"


def _page(
    keys: Sequence[FrameKey],
    rows: Sequence[SourceTruth],
    detections: dict[str, list[Detection]],
    manifest: dict[str, Any] | None = None,
    causes: Sequence[DetectionCauses] = (),
) -> tuple[Page, str]:
    cameras = {camera: calibration(camera) for camera, _ in keys}
    html = report_html(
        keys=keys, result=evaluate(keys, rows, cameras, detections), load=lambda key: frame(*key),
        calibrations=cameras, manifest=manifest or {}, folder_name="folder", files=["truth.jsonl", "a b<.json"],
        causes={"robust": causes},
    )  # fmt: skip
    return Page(html), html


ONE = [("r1.front", 0)]


def test_a_ghost_is_shown_as_one_and_is_no_source() -> None:
    """It is drawn and named, and what was found on it is told as a ghost, not as a false alarm."""
    ghost = truth(u_px=200.0, ghost_of="r2.top", range_m=4.0)
    page, _ = _page(ONE, [truth(), ghost], {"robust": [detection(), detection(u_px=200.0)]})
    assert "mirror image of r2.top, 4.000 m away" in page.text
    assert "ghost of r2" in page.text
    assert "Found the one source" in page.text
    assert "1 false alarm" not in page.text


@pytest.mark.parametrize(
    ("keys", "rows", "detections", "said"),
    [
        (ONE, [truth()], {"robust": []}, "Missed 1 of 1 source that could be seen"),
        (ONE, [], {"robust": []}, "No source was there to be ranged."),
        (ONE, [], {"robust": [detection()]}, "1 false alarm"),
        (ONE, [truth()], {"robust": [detection(range_m=math.nan)]}, "No source was ranged."),
        (ONE, [truth()], {"robust": [detection()]}, "Found the one source"),
        (ONE, [truth()], {}, "estimators: none"),
        ([], [], {"robust": []}, "0 frames of 0 cameras"),
    ],
)
def test_pages_of_little(
    keys: list[FrameKey], rows: list[SourceTruth], detections: dict[str, list[Detection]], said: str
) -> None:
    page, _ = _page(keys, rows, detections)
    assert said in page.text


def test_the_page_carries_all_it_shows_and_loads_nothing() -> None:
    page, html = _page(ONE, [truth()], {"paper": [detection(range_m=1.0)], "robust": [detection()]})
    inside = [address for address in page.addresses if address.startswith("data:")]
    assert len(inside) == 1 + 1 + 3  # a frame, a close-up, three plots
    assert sorted(set(page.addresses) - set(inside)) == ["a%20b%3C.json", "truth.jsonl"]
    assert "script" not in page.tags
    assert "http" not in re.sub(r'"data:[^"]*"', "", html)
    assert "url(" not in html


def test_causes_are_drawn_where_they_were_asked_for() -> None:
    parts = dict.fromkeys(CAUSES, 0.0) | {"own_light_m": 0.03, "read_noise_m": 0.04}
    of_one = [DetectionCauses("r1.front", 0, k, 2.0 + k, 0.05, parts, 0.0) for k in range(3)]
    for causes, plots in (([], 3), (of_one, 4)):
        page, _ = _page(ONE, [truth()], {"robust": [detection()]}, causes=causes)
        assert ("What the σ of a range is made of" in page.text) == bool(causes)
        assert sum(address.startswith("data:") for address in page.addresses) == 2 + plots


def test_whatever_comes_from_the_user_is_text() -> None:
    page, html = _page(
        [(HOSTILE, 0)],
        [truth(camera=HOSTILE, robot=HOSTILE, source=HOSTILE)],
        {HOSTILE: [detection(camera=HOSTILE), detection(camera=HOSTILE, u_px=200.0)]},
        {"scene": HOSTILE, "versions": {"nir-render": HOSTILE}, HOSTILE: HOSTILE},
    )
    assert "script" not in page.tags
    assert HOSTILE not in html
    assert page.text.count(HOSTILE) > 8


def test_many_cameras_are_cut_at_eight_and_said() -> None:
    keys = [(f"r{i}.front", 0) for i in range(11)]
    page, _ = _page(keys, [truth(camera=camera) for camera, _ in keys], {"robust": []})
    assert page.text.count("3 more cameras not shown.") == 2  # of pictures, and of the table


def test_the_same_run_gives_the_same_page() -> None:
    def page() -> str:
        return _page(ONE, [truth()], {"mine": [detection()]})[1]

    assert page() == page()


def test_a_long_run_stays_a_small_page() -> None:
    """4000 flares, two estimators; as vectors the marks alone would take megabytes."""
    keys = [("r1.front", index) for index in range(1000)]
    ranges_m = np.linspace(1.0, 10.0, 4000)
    rows = [
        truth(index=i // 4, u_px=40.0 + 60.0 * (i % 4), range_m=float(ranges_m[i]), depth_z_m=float(ranges_m[i]))
        for i in range(4000)
    ]  # fmt: skip
    said = {
        name: [detection(index=row.index, u_px=row.u_px, range_m=factor * row.range_m) for row in rows]
        for name, factor in (("paper", 0.5), ("robust", 1.01))
    }
    _, html = _page(keys, rows, said)
    assert len(html) < 2_000_000


def test_the_same_figure_gives_the_same_svg_again() -> None:
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(2.0)
        axes = figure.subplots(1, 2)
        axes[0].imshow(np.arange(12.0).reshape(3, 4))
        axes[1].plot(np.arange(5.0), rasterized=True)
        first = svg_of(figure)
        assert svg_of(figure) == first
    assert figure.dpi == 130
