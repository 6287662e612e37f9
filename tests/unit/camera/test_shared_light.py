"""Indirect light of many groups in one image: what it is, what stays exact, and what it leaves off."""

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.camera.mean_frame import electron_rates, exposed_frame
from nir_render.camera.sensor.read_out import dark_variance_e2
from nir_render.camera.shared_light import shared_light
from nir_render.light.light import NO_SOURCES, Indirect, Light
from tests.paths import SCENES

ROWS, COLUMNS = 48, 64
CAMERA = "robots.r1.rig.cameras.front"
BITS = ("0101101111", "0110111011", "0011011111", "1101010111", "0111101011")
TIMES_S = np.arange(0.05, 1.0, 0.1)  # mid-bit


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Five robots that blink each by itself, and the observer, whose source is constant."""
    base = load_scene(SCENES / "one_source.yaml")
    robot = {**base.raw["robots"]["r2"], "motion": []}
    others = {
        f"b{number}": {
            **robot,
            "position": f"[{2 + number}, 0, 0] m",
            "rig": {
                "preset": "infra_swarm",
                "sources": {"top": {"drive": {"bits": {"pattern": bits, "rate": "10 Hz"}}}},
            },
        }
        for number, bits in enumerate(BITS)
    }
    for one in others.values():
        del one["motion"]
    small = {"preset": "mt9m031", "columns": COLUMNS, "rows": ROWS, "pixel_pitch": "75 um"}
    return base.with_({"robots": {"r1": base.raw["robots"]["r1"], **others}}).with_(
        {f"{CAMERA}.sensor": small, f"{CAMERA}.filter": None}
    )


def _light(scene: Scene, brightness: list[float]) -> Light:
    """Indirect light, 1 for each group times its brightness, uneven from block to block."""
    groups = scene.at(0.0).groups
    uneven = np.random.default_rng(5).uniform(0.5, 1.5, (len(groups), 1, ROWS // 2, COLUMNS // 2))
    radiance = 1e-4 * uneven * np.array(brightness)[:, None, None, None]
    indirect = Indirect(radiance.astype(np.float32), np.zeros_like(radiance, dtype=np.float32), 2, 16)
    return Light("r1.front", 0.0, 1, groups, (940e-9,), NO_SOURCES, indirect)


def test_what_shares_an_image_is_driven_by_the_mean(scene: Scene) -> None:
    """Of groups 1 to 3 the sum, lit by the share of them that is; groups 4 and 5 as they are alone."""
    light, world = _light(scene, [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]), scene.at(0.0)
    apart, together = electron_rates(light, world), electron_rates(light, world, [1, 2, 3])
    assert (len(apart.drives), len(together.drives)) == (6, 6)
    assert together.images is not None
    assert len(together.images) == 4  # the constant one, two alone, three in one
    assert apart.images is not None
    number = {group: apart.drive[group] for group in range(6)}
    for time_s in TIMES_S:
        lit = [int(bits[int(time_s / 0.1)]) for bits in BITS]
        shared = sum(lit[:3]) / 3.0 * sum(apart.images[number[group]] for group in (1, 2, 3))
        alone = sum(lit[group - 1] * apart.images[number[group]] for group in (4, 5))
        got = exposed_frame(together, 1e-3, time_s).electrons
        np.testing.assert_allclose(got, 1e-3 * (shared + alone), rtol=1e-5)


def test_all_are_lit_as_without_sharing(scene: Scene) -> None:
    light, world = _light(scene, [1.0] * 6), scene.at(0.0)
    one, other = electron_rates(light, world), electron_rates(light, world, range(6))
    lit_s = 0.9  # bit 9 is lit in all
    np.testing.assert_allclose(
        exposed_frame(one, 1e-3, lit_s).electrons, exposed_frame(other, 1e-3, lit_s).electrons, rtol=1e-5
    )


@pytest.mark.parametrize("most_share", [1e-2, 0.1])
def test_the_faintest_share_and_are_off_by_less_than_is_said(scene: Scene, most_share: float) -> None:
    """The brightest stay alone. Over time the mean square, in blocks, stays below the bound of the worst."""
    brightness = [1.0, 0.1, 0.2, 0.4, 0.8, 200.0]
    light, world, exposure_s = _light(scene, brightness), scene.at(0.0), 1e-3
    shared = shared_light(light, world, exposure_s, most_share)
    assert list(shared.groups) == list(range(1, 1 + len(shared.groups)))
    assert 5 not in shared.groups
    assert 0.0 < shared.mean_share <= shared.worst_share <= most_share
    apart, together = electron_rates(light, world), electron_rates(light, world, shared.groups)
    off_e, frame_e = [], []
    for time_s in TIMES_S:
        frame = exposed_frame(apart, exposure_s, time_s).electrons
        off_e.append(exposed_frame(together, exposure_s, time_s).electrons - frame)
        frame_e.append(frame)
    lit = np.mean(frame_e, axis=0) + dark_variance_e2(scene.camera("r1.front")[1].sensor, exposure_s)
    share = np.mean(np.square(off_e), axis=0) / lit
    assert 0.0 < share.mean() < 1.2 * shared.mean_share  # blocks are enlarged, which is not quite a block
    assert share.max() < 1.2 * shared.worst_share


def test_one_alone_and_glare_share_nothing(scene: Scene) -> None:
    light = _light(scene, [1.0] * 6)
    assert shared_light(light, scene.at(0.0), 1e-3, 0.0).groups == ()
    glare = scene.with_(
        {f"{CAMERA}.point_spread.glare": {"share": 0.02, "core_radius": "10 px", "exponent": 1.5}}
    )
    with_glare = _light(glare, [1e-3] * 6)
    assert shared_light(with_glare, glare.at(0.0), 1e-3, 0.1).groups == ()


@pytest.mark.parametrize(
    "place",
    [(slice(0, 5), slice(0, 7)), (slice(20, 21), slice(30, 34)), (slice(40, ROWS), slice(50, COLUMNS))],
)
def test_a_part_of_a_group_s_image_is_that_part(scene: Scene, place: tuple[slice, slice]) -> None:
    """To the same bits: at corners, too, and in a single pixel's height, where the blur reaches far beyond."""
    rates = electron_rates(_light(scene, [1.0] * 6), scene.at(0.0))
    assert np.array_equal(rates.group_image(3, place), rates.group_image(3)[place])
