"""The closed loop: bases, eyes of three kinds, runs that are killed and go on."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.errors import InputError
from nir_render.experiments.flocking.loop import Flocking, Loop
from nir_render.experiments.flocking.outcome import ARENA, outcome_of
from nir_render.experiments.flocking.page import write_outcome
from nir_render.experiments.loop import runs
from nir_render.experiments.loop.frame_sight import FrameSight
from nir_render.experiments.loop.measurement_sight import MeasurementSight
from nir_render.experiments.loop.world import Base, World
from perception.model.fisher import flare_limit
from perception.model.ranging import flux_at_one_metre_dn


def _arena(**changes: Any) -> Scene:
    return load_scene(ARENA).with_(changes)


def _bare() -> Scene:
    """Without walls and lamps: no light but straight from sources."""
    return load_scene(ARENA).with_({"shapes": {}, "lamps": {}, "illuminance": None, "materials": {}})


def test_a_base_gathers_speed_and_keeps_to_its_limit() -> None:
    """0.2 m/s² for 0.1 s steps: 0.02, 0.04, … 0.1 m/s; places by the velocity after each change."""
    world = World(_bare(), {"leader": np.zeros(2)}, Base(), seed=1)
    for _ in range(8):
        world.step({"leader": np.array([3.0, 4.0])}, 0.1)
    mover = world.movers["leader"]
    assert mover.velocity_m_per_s == pytest.approx([0.06, 0.08])
    gone_m = 0.1 * (0.02 + 0.04 + 0.06 + 0.08 + 4 * 0.1)
    assert mover.place_m == pytest.approx([0.6 * gone_m, 0.8 * gone_m])
    assert [record.time_s for record in world.odometry("leader")] == pytest.approx(0.1 * np.arange(9))
    assert world.odometry("leader")[-1].position_m == pytest.approx(
        [*mover.place_m, 0.0]
    )  # it states no noise


def test_measurements_scatter_by_their_bound() -> None:
    """2 m ahead: of 600 draws mean and σ of range and place, against the bound at that very place."""
    places_m = {"leader": np.array([2.06, 0.0]), "follower1": np.zeros(2)}
    scene = _bare()
    world = World(scene, places_m, Base(), seed=1)
    sight = MeasurementSight(scene, "follower1", seed=4)
    snapshot = world.snapshot()
    known = sight._known["follower1.front"]
    found = []
    for index in range(600):
        frame = dataclasses.replace(_frame(sight), index=index)
        found += [hit for hit in sight._images_and_detections(frame, snapshot)[1] if 1.5 < hit.range_m < 2.5]
    assert len(found) == 600
    range_m = float(np.hypot(2.0, 0.08))
    v_px = known.cy_px - known.fy_px * 0.08 / 2.0
    flux_e = (
        float(flux_at_one_metre_dn(known.cx_px, v_px, 2e-4, 1.0, known))
        / range_m**2
        / known.system_gain_dn_per_e
    )
    bound = flare_limit(known, known.cx_px, v_px, range_m, flux_e, 0.0)
    ranges_m, columns_px = np.array([hit.range_m for hit in found]), np.array([hit.u_px for hit in found])
    assert ranges_m.mean() == pytest.approx(range_m, abs=4.0 * bound.range_sigma_m / np.sqrt(600))
    assert ranges_m.std() == pytest.approx(
        bound.range_sigma_m, rel=0.12
    )  # 4 σ of a σ from 600, and the look-up
    assert columns_px.mean() == pytest.approx(known.cx_px, abs=4.0 * bound.u_sigma_px / np.sqrt(600))
    assert columns_px.std() == pytest.approx(bound.u_sigma_px, rel=0.12)
    assert np.mean([hit.range_sigma_m for hit in found]) == pytest.approx(bound.range_sigma_m, rel=0.03)


def test_who_is_hidden_in_part_seems_fainter_and_farther() -> None:
    """Of .64 of the light: 1.25 times as far, to the bound; whole hidden ones are not found, others as before."""
    scene = _bare()
    places_m = {
        "leader": np.array([2.06, 0.0]),
        "follower2": np.array([2.06, 0.3]),
        "follower3": np.array([2.06, -0.3]),
        "follower1": np.zeros(2),
    }
    snapshot = World(scene, places_m, Base(), seed=1).snapshot()
    visible = {"follower1.front": {"leader.top": 0.64, "follower2.top": 0.0}}
    part, whole = (MeasurementSight(scene, "follower1", seed=4, visible=some) for some in (visible, {}))
    seen, free = (
        sorted(sight._images_and_detections(_frame(sight), snapshot)[1], key=lambda hit: hit.u_px)
        for sight in (part, whole)
    )
    assert (len(seen), len(free)) == (2, 3)
    (ahead,) = (hit for hit in seen if abs(hit.u_px - free[1].u_px) < 1.0)
    assert ahead.range_m == pytest.approx(1.25 * free[1].range_m, rel=1e-6)
    assert ahead.flux_dn == pytest.approx(0.64 * free[1].flux_dn, rel=0.02)
    (aside,) = (hit for hit in seen if hit is not ahead)
    assert (aside.u_px, aside.range_m) in [(hit.u_px, hit.range_m) for hit in (free[0], free[2])]


def _frame(sight: MeasurementSight) -> Any:
    return sight._exposed("follower1.front", 0, 0.0)


@pytest.mark.parametrize(("apart_m", "merged"), [(0.005, 1), (0.012, 0)])
def test_two_in_one_place_are_one_flare_without_a_range(apart_m: float, merged: int) -> None:
    """2 m ahead 5 mm are 1.2 px, and 12 mm 2.9 px."""
    scene = _bare()
    places_m = {
        "leader": np.array([2.06, 0.0]),
        "follower2": np.array([2.06, apart_m]),
        "follower1": np.zeros(2),
    }
    world = World(scene, {**places_m, "follower3": np.array([-3.0, 0.0])}, Base(), seed=1)
    sight = MeasurementSight(scene, "follower1", seed=4)
    hits = [
        hit for hit in sight._images_and_detections(_frame(sight), world.snapshot())[1] if hit.u_px > 630.0
    ]
    assert sum(hit.merged for hit in hits) == merged
    assert all(np.isnan(hit.range_m) == hit.merged for hit in hits)


@pytest.mark.parametrize("level", ["truth", "measurements"])
def test_a_run_that_is_killed_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, level: str
) -> None:
    scene, plan = load_scene(ARENA), Flocking(level=level, lasts_s=3.0)
    for folder in ("whole", "killed"):
        (tmp_path / folder / "runs").mkdir(parents=True)
    runs.run_seed(scene, plan, 3, tmp_path / "whole")
    monkeypatch.setattr(runs, "_SAVED_STEPS", 10)
    step, steps = Loop.step, 0

    def dies(loop: Loop) -> Any:
        nonlocal steps
        steps += 1
        if steps == 18:
            raise KeyboardInterrupt
        return step(loop)

    monkeypatch.setattr(Loop, "step", dies)
    with pytest.raises(KeyboardInterrupt):
        runs.run_seed(scene, plan, 3, tmp_path / "killed")
    monkeypatch.setattr(Loop, "step", step)
    assert (tmp_path / "killed" / "runs" / "0003.state").exists()
    runs.run_seed(scene, plan, 3, tmp_path / "killed")
    whole, killed = (
        {
            path.relative_to(tmp_path / folder): path.read_bytes()
            for path in (tmp_path / folder).rglob("*.json*")
        }
        for folder in ("whole", "killed")
    )
    assert whole == killed
    assert not (tmp_path / "killed" / "runs" / "0003.state").exists()


@pytest.mark.mitsuba
def test_robots_that_see_by_frames_know_where_the_others_are() -> None:
    """Four looks without walls: all four others, within 3 cm, and at the third look already."""
    loop = Loop(_bare(), Flocking(level="frames", lasts_s=0.4), seed=0)
    for _ in range(loop.steps):
        loop.step()
    assert all(count == 4 for seen in loop.neighbours[2:] for count in seen.values())
    for name, sight in loop.sights.items():
        assert isinstance(sight, FrameSight)
        own_m = loop.world.movers[name].place_m
        others_m = [mover.place_m - own_m for other, mover in loop.world.movers.items() if other != name]
        for neighbour in sight.look(loop.world).neighbours:
            assert min(np.hypot(*(neighbour.place_m - place_m)) for place_m in others_m) < 0.03


@pytest.mark.usefixtures("short_film")
def test_robust_robots_keep_their_spacing_and_the_paper_s_do_not(tmp_path: Path) -> None:
    """By truth: 1.00 m between neighbours, and 0.8 m by the law with the paper's figures."""
    scene = load_scene(ARENA)
    outcomes = {
        law: outcome_of(scene, Flocking(law=law, level="truth"), range(2), tmp_path / law, 1, lambda *_: None)
        for law in ("robust", "paper")
    }
    assert all(run.spacing.valid and run.spacing.error_m < 0.002 for run in outcomes["robust"].runs)
    assert all(run.spacing.error_m > 0.15 for run in outcomes["paper"].runs)
    assert np.mean([run.spacing.all_pairs_m for run in outcomes["paper"].runs]) == pytest.approx(1.0, abs=0.1)
    page = write_outcome(outcomes["robust"], tmp_path / "robust").read_text()
    assert "Spacing error below 5 cm in 2 of 2 runs" in page
    other = dataclasses.replace(outcomes["robust"].plan, spacing_m=1.2)
    with pytest.raises(InputError, match="runs of another plan"):
        outcome_of(scene, other, range(2), tmp_path / "robust", 1, lambda *_: None)
