"""Light that is found again: the same bits as rendered, and rendered only where geometry is new."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from nir_render import LightCache, Scene, load_scene, render, simulate
from nir_render.scene.snapshot import Snapshot
from nir_render.transport import render as transport
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect import groups, stock
from tests.physics.rooms import plain

pytestmark = pytest.mark.mitsuba


def _scene(folder: Path, settings: dict[str, Any]) -> Scene:
    """The diffuse room, 40 × 30 pixels; r2 stands still until 2.1 s, then moves off and is back at 3.9 s."""
    document = plain("diffuse room")
    document["robots"]["r1"]["rig"]["cameras"]["c"]["sensor"] |= {
        "columns": 40,
        "rows": 30,
        "pixel_pitch": "90 um",
    }
    source = document["robots"]["r2"]
    stops = [("0 s", 2.4), ("2.1 s", 2.4), ("3 s", 2.6), ("3.9 s", 2.4)]
    document["robots"]["r2"] = {
        "rig": source["rig"],
        "motion": [{"time": time, "position": f"[{x}, 1.1, 0.5] m"} for time, x in stops],
    }
    document["render"] = {"indirect": {"scale": 1, "max_depth": 4}}
    path = folder / "room.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return load_scene(path, settings)


FIXED: dict[str, Any] = {"render.indirect.samples": 8}
TARGET: dict[str, Any] = {
    "render.noise": "100 % of temporal variance",
    "robots.r1.rig.cameras.c.exposure": "1 us",
}


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times at which indirect light was rendered, by whichever renderer this machine uses."""
    times_s: list[float] = []
    whole, other = groups.indirect, stock.indirect

    def by_groups(snapshot: Snapshot, *rest: Any, **named: Any) -> Any:
        times_s.append(snapshot.time_s)
        return whole(snapshot, *rest, **named)

    def by_stock(snapshot: Snapshot, *rest: Any) -> Any:
        times_s.append(snapshot.time_s)
        return other(snapshot, *rest)

    monkeypatch.setattr(groups, "indirect", by_groups)
    monkeypatch.setattr(stock, "indirect", by_stock)
    return times_s


def _bits(light: Any) -> list[bytes]:
    part, table = light.indirect, light.direct
    arrays = [part.radiance_per_w, part.variance, table.direction, table.irradiance_per_w, table.seen]
    return [np.ascontiguousarray(array).tobytes() for array in arrays]


@pytest.mark.parametrize("settings", [FIXED, TARGET], ids=["fixed count", "target"])
def test_a_hit_from_disk_has_the_bits_of_the_render_and_renders_nothing(
    settings: dict[str, Any], tmp_path: Path, rendered: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = _scene(tmp_path, settings)
    fresh = render(scene, "r1.c", seed=3)
    filled = render(scene, "r1.c", seed=3, cache=LightCache(tmp_path / "lights"))
    assert len(rendered) == 2

    def nothing(*_: Any, **__: Any) -> Any:
        raise AssertionError

    for name in ("pilot", "world_on_device"):
        monkeypatch.setattr(groups, name, nothing)
    monkeypatch.setattr(transport, "direct_table", nothing)
    found = render(scene, "r1.c", seed=3, cache=LightCache(tmp_path / "lights"))
    assert len(rendered) == 2
    assert _bits(fresh) == _bits(filled) == _bits(found)
    assert (found.camera, found.time_s, found.seed, found.groups) == (fresh.camera, 0.0, 3, fresh.groups)


def test_equal_geometry_gives_equal_bits_at_another_time(tmp_path: Path, rendered: list[float]) -> None:
    scene = _scene(tmp_path, FIXED)
    start, rest, away = (render(scene, "r1.c", time_s, seed=3) for time_s in (0.0, 1.5, 3.0))
    assert len(rendered) == 3  # no cache, no reuse
    assert _bits(start) == _bits(rest)
    assert rest.time_s == 1.5
    assert _bits(away) != _bits(start)
    # Not by moving the same samples along: other geometry draws other random numbers.
    assert start.indirect is not None
    assert away.indirect is not None
    noisy = start.indirect.variance > 0.0
    assert (away.indirect.radiance_per_w == start.indirect.radiance_per_w)[noisy].mean() < 0.01


def test_another_seed_is_another_light(tmp_path: Path) -> None:
    scene, cache = _scene(tmp_path, FIXED), LightCache()
    one, other = (render(scene, "r1.c", seed=seed, cache=cache) for seed in (1, 2))
    assert _bits(one) != _bits(other)


@pytest.mark.parametrize("settings", [FIXED, TARGET], ids=["fixed count", "target"])
def test_a_run_renders_as_often_as_geometry_changes(
    settings: dict[str, Any], tmp_path: Path, rendered: list[float]
) -> None:
    """Nine frames, half a second apart: at rest until 2 s, under way at 2.5, 3 and 3.5 s, at rest again at 4 s."""
    timing = {"clock": {"frames": 9, "frame_rate": "2 Hz"}, "robots.r1.rig.cameras.c.exposure": "1 us"}
    cache = LightCache()
    shots = list(simulate(_scene(tmp_path, settings | timing), cache=cache))
    assert np.round(rendered, 3).tolist() == [0.0, 2.5, 3.0, 3.5]
    assert (cache.missed, cache.reused) == (4, 5)
    assert shots[8].light.indirect is shots[0].light.indirect


def test_a_blinking_robot_costs_nothing(tmp_path: Path, rendered: list[float]) -> None:
    scene, cache = _scene(tmp_path, FIXED), LightCache()
    first = render(scene, "r1.c", cache=cache)
    for flux in ("0.9 W", "1.1 W", "1 W"):
        again = render(scene.with_({"robots.r2.rig.sources.s.flux": flux}), "r1.c", cache=cache)
        assert again.indirect is first.indirect
    assert len(rendered) == 1


def test_variant_is_part_of_the_key(
    tmp_path: Path, rendered: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, cache = _scene(tmp_path, FIXED), LightCache()
    render(scene, "r1.c", cache=cache)
    monkeypatch.setattr(transport, "versions", lambda variant, _compiler: (variant, "other"))
    render(scene, "r1.c", cache=cache)
    assert len(rendered) == 2
    assert backend().variant


def test_what_is_built_for_one_camera_serves_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The world is brought to the device once, and the second camera's light has the bits that it has alone."""
    scene = _scene(tmp_path, TARGET)
    camera = scene.raw["robots"]["r1"]["rig"]["cameras"]["c"]
    world = scene.with_({"robots.r1.rig.cameras.d": {**camera, "orientation": {"yaw": "20 deg"}}}).at(0.0)
    alone = transport.render(world, "r1.d", 3)
    builds: list[float] = []
    whole = groups.world_on_device

    def counted(snapshot: Snapshot, *rest: Any) -> Any:
        builds.append(snapshot.time_s)
        return whole(snapshot, *rest)

    monkeypatch.setattr(groups, "world_on_device", counted)
    kept: dict[Hashable, Any] = {}
    both = [transport.render(world, name, 3, kept=kept) for name in ("r1.c", "r1.d")]
    assert len(builds) == backend().vectorised
    assert _bits(both[1]) == _bits(alone)
    assert _bits(both[0]) != _bits(alone)
