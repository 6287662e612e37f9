"""What moves: flares drawn out within an exposure, against many short exposures; discs that bodies hide."""

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render.camera.mean_frame import MeanFrame, mean_frame
from nir_render.scene.scene import Scene, parse_scene
from nir_render.simulation.clock import render

EXPOSURE_S = 10e-3
CIRCLE = {
    "type": "circle", "center": "[2, 0, 0.05] m", "radius": "0.8 m", "speed": "1 m/s", "phase": "120 deg",
}  # fmt: skip
TURNING = {
    "path": {
        "type": "circle", "center": "[0, 0, 0] m", "radius": "5 cm", "period": "8 s", "phase": "-90 deg",
    }
}  # fmt: skip


def _scene(
    r1: dict[str, object],
    path: dict[str, object] | None,
    drive: dict[str, object] | None = None,
    camera: dict[str, object] | None = None,
) -> Scene:
    sources = {"top": {"drive": drive}} if drive else {}
    small = {"sensor": {"columns": 640, "rows": 480}, **(camera or {})}
    rig = {"preset": "infra_swarm", "cameras": {"front": small}}
    other = {"rig": {"preset": "infra_swarm", "sources": sources}}
    robots = {
        "r1": {"rig": rig, **r1},
        "r2": {**other, **({"path": path} if path else {"position": "[1.5, 0.2, 0] m"})},
    }
    return parse_scene({"format": 1, "observe": ["r1.front"], "robots": robots})


def _frame(scene: Scene, middle_s: float, exposure_s: float, *, at_rest: bool) -> MeanFrame:
    world = scene.at(middle_s)
    if at_rest:
        world = world.moved({name: robot.pose for name, robot in world.robots.items()})
    return mean_frame(render(world, "r1.front"), world, exposure_s)


def _flux_and_centre(image: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    v_px, u_px = np.indices(image.shape)
    flux = float(image.sum())
    return flux, np.array([(image * u_px).sum(), (image * v_px).sum()]) / flux


@pytest.mark.parametrize(
    ("r1", "path", "drive", "sub_exposures"),
    [
        ({}, CIRCLE, None, 64),
        # Off for the first millisecond, on for 3 ms, then off.
        ({}, CIRCLE, {"square": {"frequency": "100 Hz", "duty": 0.3, "phase": "6 ms"}}, 80),
        (TURNING, None, None, 64),
    ],
)
def test_a_moving_flare_is_the_mean_of_short_exposures(
    r1: dict[str, object],
    path: dict[str, object] | None,
    drive: dict[str, object] | None,
    sub_exposures: int,
) -> None:
    """A source on a circle at 1 m/s, lit all along or in a part; a camera that turns and goes on.

    Short exposures of what stands still in each differ from what is drawn out by the path's bend: a T²/24 of
    its middle. To 0.01 px and 0.1 %; the flare goes over 2 to 4 px.
    """
    scene = _scene(r1, path, drive)
    drawn = _frame(scene, 0.4, EXPOSURE_S, at_rest=False)
    short_s = EXPOSURE_S / sub_exposures
    summed = np.zeros_like(drawn.electrons)
    for index in range(sub_exposures):
        middle_s = 0.4 - 0.5 * EXPOSURE_S + (index + 0.5) * short_s
        summed += _frame(scene, middle_s, short_s, at_rest=True).electrons
    flux_e, centre_px = _flux_and_centre(drawn.electrons)
    wanted_e, wanted_px = _flux_and_centre(summed)
    assert flux_e == pytest.approx(wanted_e, rel=1e-3)
    np.testing.assert_allclose(centre_px, wanted_px, atol=0.01)
    np.testing.assert_allclose(drawn.electrons, summed, atol=0.01 * summed.max())
    # It is drawn out at all: the same world at rest shows another image.
    still = _frame(scene, 0.4, EXPOSURE_S, at_rest=True).electrons
    assert np.abs(still - summed).max() > 0.05 * summed.max()
    assert drawn.windows[-1].total == pytest.approx(flux_e, rel=1e-6)


@pytest.mark.parametrize("shutter", [{"type": "global"}, {"type": "rolling", "line_time": "20 us"}])
def test_edges_of_a_drive_do_not_move_a_flare(shutter: dict[str, object]) -> None:
    """Straight on at 2 m/s, nearer each moment, ten flashes of 0.3 ms in 10 ms: 100 short exposures, whose ends
    are the edges. To 0.001 px and 1e-5 of the flux, on a path of 5 px; flashes drawn at the middles of the stretches
    that they begin or end in come out 0.008 px beside. Behind a rolling shutter the flare's own row counts,
    and rows differ: 0.01 px and 0.1 %.
    """
    line = [
        {"time": "0 s", "position": "[1.0, 0.8, 0] m"},
        {"time": "1 s", "position": "[2.2, -0.8, 0] m"},
    ]
    scene = _scene({}, None, {"square": {"frequency": "1 kHz", "duty": 0.3}}, {"shutter": shutter})
    robots = {**scene.raw["robots"], "r2": {**scene.raw["robots"]["r2"], "motion": line}}
    del robots["r2"]["position"]
    scene = parse_scene({**scene.raw, "robots": robots})
    drawn = _frame(scene, 0.5, EXPOSURE_S, at_rest=False)
    summed = np.zeros_like(drawn.electrons)
    for index in range(100):
        middle_s = 0.5 + EXPOSURE_S * ((index + 0.5) / 100 - 0.5)
        summed += _frame(scene, middle_s, EXPOSURE_S / 100, at_rest=True).electrons
    (flux_e, centre_px), (wanted_e, wanted_px) = _flux_and_centre(drawn.electrons), _flux_and_centre(summed)
    rolls = shutter["type"] == "rolling"
    assert flux_e == pytest.approx(wanted_e, rel=1e-3 if rolls else 1e-5)
    np.testing.assert_allclose(centre_px, wanted_px, atol=0.01 if rolls else 0.001)


def test_what_rests_is_drawn_as_ever() -> None:
    """A robot whose motion holds has a velocity of zero: its frame is that of one without any, bit by bit."""
    rest = {"motion": [{"time": "0 s", "position": "[1.5, 0.2, 0] m", "hold": "5 s"}]}
    scene, still = _scene({}, None), _scene({}, None)
    held = parse_scene({**still.raw, "robots": {**still.raw["robots"], "r2": {"rig": "infra_swarm", **rest}}})
    one, other = (_frame(world, 1.0, EXPOSURE_S, at_rest=False).electrons for world in (scene, held))
    np.testing.assert_array_equal(one, other)


def test_what_a_moving_box_hides_of_a_disc() -> None:
    """A straight edge moves across a source: the share of its disc that is left is a circular segment.

    The box, 10 cm thick, of r3 goes across the line of sight at 1 m from the lens; its near edge projects to
    the source's distance of 2 m as a line. With x the line's distance from the disc's centre over its radius,
    the share in view is (arccos x − x √(1 − x²))/π. The rays give 0.8 % at an edge.
    """
    body = {"wall": {"type": "box", "center": "[0, 0.5, 0.2] m", "size": "[0.001, 1, 1] m",
                     "material": "black"}}  # fmt: skip
    lens = {"position": "[0, 0, 0.2] m"}
    source = {"top": {"position": "[0, 0, 0.2] m"}}
    eye = {
        "preset": "infra_swarm",
        "cameras": {"front": lens},
        "sources": {"top": {"position": "[0, 0, 1] m"}},
    }
    robots = {
        "r1": {"rig": eye},
        "r2": {"rig": {"preset": "infra_swarm", "sources": source}, "position": "[2, 0, 0] m"},
        "r3": {
            "rig": {"body": body},
            "motion": [{"time": "0 s", "position": "[1, 0.05, 0] m"},
                       {"time": "1 s", "position": "[1, -0.05, 0] m"}],
        },
    }  # fmt: skip
    scene = parse_scene({"format": 1, "observe": ["r1.front"], "robots": robots})
    radius_m = scene.document.robots["r2"].rig.sources["top"].radius_m
    partly = 0
    for time_s in np.linspace(0.3, 0.7, 41):
        light = render(scene, "r1.front", float(time_s))
        row = [light.groups[group] for group in light.direct.group].index("r2.top")
        edge_m = 0.05 - 0.1 * time_s
        # Half the box's thickness nearer; the cone's tangents touch the sphere, not its great circle.
        slope = edge_m / (1.0 - 0.0005 * np.sign(edge_m) * -1.0)
        x = np.clip(slope / np.tan(np.arcsin(radius_m / 2.0)), -1.0, 1.0)
        in_view = (np.arccos(-x) + x * np.sqrt(1.0 - x * x)) / np.pi
        assert light.direct.visible_fraction[row] == pytest.approx(in_view, abs=0.008)
        partly += 0.0 < light.direct.visible_fraction[row] < 1.0
    assert partly >= 5
