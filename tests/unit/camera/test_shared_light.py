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
# Each way of being lit once: drives that are independent, dark half of the time.
BITS = tuple("".join(str(way >> robot & 1) for way in range(32)) for robot in range(5))
TIMES_S = np.arange(0.05, 3.2, 0.1)  # mid-bit


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
    """Indirect light, 1 for each group times its brightness, .5 to 1.5 of it across the film, each its own way."""
    groups = scene.at(0.0).groups
    down, across = np.meshgrid(
        np.linspace(-0.5, 0.5, ROWS // 2), np.linspace(-0.5, 0.5, COLUMNS // 2), indexing="ij"
    )
    turn_rad = np.arange(len(groups))[:, None, None, None]
    uneven = 1.0 + 0.7 * (np.cos(turn_rad) * down + np.sin(turn_rad) * across)
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
    lit_s = 3.15  # all are lit in the last bit
    np.testing.assert_allclose(
        exposed_frame(one, 1e-3, lit_s).electrons, exposed_frame(other, 1e-3, lit_s).electrons, rtol=1e-5
    )


@pytest.mark.parametrize(("most_share", "watts"), [(1e-2, 1.0), (0.1, 1.0), (0.1, 30.0)])
def test_the_faintest_share_and_are_off_by_what_is_said(
    scene: Scene, most_share: float, watts: float
) -> None:
    """The brightest stay alone. Over all ways of being lit the mean square is what is said, in every block.

    Also where one sends far more than the others, to whom the mean of drives then hardly is their own.
    """
    brightness = [1.0, 0.1, 0.2 / watts, 0.4, 0.8, 200.0]
    scene = scene.with_({"robots.b1.rig.sources.top.unit.flux": watts})
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
    shape = ROWS // 2, 2, COLUMNS // 2, 2
    off_e = np.reshape(off_e, (-1, *shape)).mean(axis=(2, 4))
    lit_e = exposed_frame(apart, exposure_s, TIMES_S[-1]).electrons.reshape(shape).mean(axis=(1, 3))
    share = (off_e**2).mean(axis=0) / (
        lit_e + dark_variance_e2(scene.camera("r1.front")[1].sensor, exposure_s)
    )
    assert share.mean() == pytest.approx(shared.mean_share, rel=0.1)
    assert share.max() == pytest.approx(shared.worst_share, rel=0.1)


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
