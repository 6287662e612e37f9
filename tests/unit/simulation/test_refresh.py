"""Indirect light between two renders: what is interpolated, how far it is off, how often it is rendered."""

import itertools
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.camera.mean_frame import electron_rates, exposed_frame
from nir_render.camera.render_noise import render_noise
from nir_render.errors import InputError
from nir_render.scene.scene import parse_scene
from nir_render.simulation.refresh import RefreshError, interpolation_error, rates_between
from nir_render.transport.render import direct_light

ROWS, COLUMNS = 48, 64
CAMERA = {
    "orientation": {"yaw": "0 deg"},
    "lens": {"focal_length": "0.2 mm", "f_number": 2.0, "transmission": 0.9},
    "filter": "bp940_10nm_behind",
    "sensor": {"preset": "mt9m031", "rows": ROWS, "columns": COLUMNS},
    "point_spread": {"sigma": "0.6 px"},
    "exposure": "1 ms",
}
TALKS = {"drive": {"bits": {"pattern": "0110100", "rate": "40 Hz"}}}


def _scene(reach_m: float = 1.2, **render: Any) -> nr.Scene:
    """Return a robot that drives along a wall, and a camera that sees both."""
    glare = {"glare": {"share": "10 %", "core_radius": "3 px", "exponent": 1.5}}
    return parse_scene(
        {
            "format": 1,
            "seed": 5,
            "clock": {"frames": 16, "frame_rate": "20 Hz"},
            "observe": ["r1"],
            "render": {"indirect": {"scale": 2, "samples": 64, "max_depth": 3} | render},
            "robots": {
                "r1": {
                    "rig": {
                        "cameras": {"front": CAMERA | {"point_spread": {"sigma": "0.6 px", **glare}}},
                        "sources": {"top": {"preset": "infra_swarm", "position": "[0, 0, 0.3] m", **TALKS}},
                    }
                },
                "r2": {
                    "rig": "infra_swarm",
                    "motion": [
                        {"time": "0 s", "position": f"[1.2, {-0.5 * reach_m}, 0] m"},
                        {"time": "1 s", "position": f"[1.2, {0.5 * reach_m}, 0] m"},
                    ],
                },
            },
            "materials": {"grey": {"type": "diffuse", "reflectance": 0.5}},
            "shapes": {
                "wall": {
                    "type": "rectangle",
                    "center": "[1.6, 0, 0] m",
                    "size": "[5, 5] m",
                    "normal": [-1, 0, 0],
                    "material": "grey",
                }
            },
        }
    )


def test_the_electrons_between_two_renders_are_their_weighted_sum_and_the_frames_own_direct_light() -> None:
    scene = _scene()
    name, exposure_s = "r1.front", 1e-3
    first, last = (electron_rates(nr.render(scene, name, time_s), scene.at(time_s)) for time_s in (0.2, 0.6))
    world = scene.at(0.5)
    direct = electron_rates(direct_light(world, name, 5), world)
    between = rates_between(direct, ((0.25, first), (0.75, last)))
    assert direct.light.indirect is None

    def indirect_e(rates: Any, time_s: float) -> Any:
        whole = exposed_frame(rates, exposure_s, 0.01).electrons
        world = scene.at(time_s)
        alone = electron_rates(direct_light(world, name, 5), world)
        return whole - exposed_frame(alone, exposure_s, 0.01).electrons

    ends = 0.25 * indirect_e(first, 0.2) + 0.75 * indirect_e(last, 0.6)
    assert ends.max() > 4.0
    np.testing.assert_allclose(indirect_e(between, 0.5), ends, rtol=1e-4, atol=1e-3)
    group = between.light.groups.index("r2.top")
    image = 0.25 * first.group_image(group) + 0.75 * last.group_image(group)
    np.testing.assert_allclose(between.group_image(group), image, rtol=1e-6)
    # Two renders are independent: variances add up with the squares of the weights.
    of = [render_noise(exposed_frame(rates, exposure_s, 0.01)) for rates in (first, last, between)]
    assert of[2].mean_share == pytest.approx(0.0625 * of[0].mean_share + 0.5625 * of[1].mean_share, rel=0.05)


def test_a_run_holds_still_what_it_interpolates_to_a_render_of_each_frame() -> None:
    each = list(nr.simulate(_scene(0.6)))
    shared = list(nr.simulate(_scene(0.6, every="0.4 s")))
    assert [len(shot.refresh) for shot in shared] == [1] + 15 * [0]
    np.testing.assert_array_equal(each[0].frame.data_dn, shared[0].frame.data_dn)
    held = each[0].mean.electrons
    off, off_held, noise = [], [], []
    for own, between in itertools.islice(zip(each, shared, strict=True), 1, 8):
        variance = own.mean.electrons + 30.0
        error = between.mean.electrons - own.mean.electrons
        off.append((error**2).sum() / variance.sum())
        off_held.append(((held - own.mean.electrons)[:12] ** 2).sum() / variance[:12].sum())
        noise.append(own.noise.share_behind_lens + between.noise.share_behind_lens)
        assert own.truth[0].range_m == between.truth[0].range_m
        assert own.truth[0].direct_e == between.truth[0].direct_e
    # What is left is mostly noise of rendering; held light would be off far more (rows without the flare).
    assert np.mean(off) < 2.0 * np.mean(noise) + 0.01
    assert off_held[-1] > 10.0 * off[-1]


def test_half_the_interval_has_nearly_a_quarter_of_the_error() -> None:
    scene = _scene(0.9, samples=2048, scale=4, max_depth=2)
    rates = {
        time_s: electron_rates(nr.render(scene, "r1.front", time_s), scene.at(time_s))
        for time_s in (0.3, 0.4, 0.5, 0.6, 0.7)
    }
    wide = interpolation_error(rates[0.3], rates[0.7], rates[0.5], (0.3, 0.5, 0.7))
    near = interpolation_error(rates[0.4], rates[0.6], rates[0.5], (0.4, 0.5, 0.6))
    # Of second order, so a sixteenth of the square, but for where the source's own disc hides the wall.
    assert 8.0 < wide.mean_share / near.mean_share < 17.0
    assert (wide.apart_s, near.apart_s) == pytest.approx((0.4, 0.2))
    assert (near.camera, near.time_s) == ("r1.front", 0.5)


def test_the_interval_follows_from_the_error() -> None:
    target = "0.5 % of temporal variance"
    spent = {}
    for reach_m in (0.05, 1.2):
        found = [one for shot in nr.simulate(_scene(reach_m, error=target)) for one in shot.refresh]
        kept = [one for one in found if one.keeps(0.005)]
        spent[reach_m] = max((one.apart_s for one in kept), default=0.0), len(found)
    (slow_s, slow_measured), (fast_s, fast_measured) = spent[0.05], spent[1.2]
    assert slow_s == pytest.approx(0.8)
    assert slow_measured == 1
    assert fast_s < 0.7
    assert fast_measured > 1


def test_a_flares_share_counts_beyond_its_noise() -> None:
    error = RefreshError("r1.front", 0.0, 0.5, 0.04, 0.0025, 0.0)
    assert not error.keeps(0.05)
    assert not RefreshError("r1.front", 0.0, 0.5, 0.06, 0.0, 0.0).keeps(0.05)
    assert RefreshError("r1.front", 0.0, 0.5, 0.04, 0.0025, 0.0005).keeps(0.05)


def test_either_a_time_or_a_target() -> None:
    with pytest.raises(InputError, match="write one of them"):
        _scene(every="0.5 s", error="5 % of temporal variance")
