"""Scores worked out by hand: one camera, sources at chosen ranges, detections at chosen errors; a page read back."""

import dataclasses
from collections.abc import Mapping
from html.parser import HTMLParser
from typing import Any

import numpy as np

from nir_render.evaluate.metrics import Score
from nir_render.truth.sources import SourceTruth
from perception.types import Calibration, Detection, RawFrame

TRUTH = SourceTruth(
    camera="r1.front", index=0, time_s=0.0, source="top", robot="r2", u_px=100.0, v_px=100.0, range_m=2.0,
    depth_z_m=2.0, bearing_camera=(0.0, 0.0, 1.0), bearing_body=(1.0, 0.0, 0.0), position_body_m=(2.0, 0.0, 0.0),
    visible_fraction=1.0, direct_e=1e4, mirrored_e=0.0, scattered_e=0.0, background_e=0.0, peak_snr=20.0,
    saturated_px=0, on_fraction=1.0,
)  # fmt: skip
DETECTION = Detection(
    camera="r1.front", index=0, time_s=0.0, u_px=100.0, v_px=100.0, u_sigma_px=0.1, v_sigma_px=0.1, flux_dn=1e4,
    mean_dn=500.0, background_dn=64.0, area_px=20, saturated=False, merged=False, ghost=False, range_m=2.0,
    range_sigma_m=0.01, bearing_body=(1.0, 0.0, 0.0),
)  # fmt: skip


def calibration(camera: str = "r1.front") -> Calibration:
    return Calibration(
        camera=camera, width_px=320, height_px=240, fx_px=480.0, fy_px=480.0, cx_px=159.5, cy_px=119.5,
        rotation_body_camera=np.eye(3), position_body_m=np.zeros(3), system_gain_dn_per_e=1.0, read_noise_e=10.0,
        black_level_dn=64.0, saturation_dn=4095, bit_depth=12, psf_sigma_px=0.7,
        response_angle_rad=np.array([0.0, 1.5]), response_relative=np.ones(2), range_constant_dn_m2_per_s=1e9,
        range_constant_paper_dn_m2_per_s=1e9, source_radius_m=0.01, wavelength_m=940e-9,
    )  # fmt: skip


def truth(**changes: Any) -> SourceTruth:
    return dataclasses.replace(TRUTH, **changes)


def detection(**changes: Any) -> Detection:
    return dataclasses.replace(DETECTION, **changes)


def frame(camera: str = "r1.front", index: int = 0) -> RawFrame:
    return RawFrame(camera, index, 0.1 * index, 1e-3, np.full((240, 320), 70, dtype=np.uint16), 64.0)


def score(
    range_m: float,
    detections: Mapping[str, Detection],
    *,
    limit_m: float = 0.01,
    bearing_limit_deg: float = 0.01,
    countable: bool = True,
) -> Score:
    return Score(truth(range_m=range_m), countable, limit_m, bearing_limit_deg, detections)


class Page(HTMLParser):
    """Collects tags, addresses and text, and holds that every tag is closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]
        if tag not in ("meta", "br", "img"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
