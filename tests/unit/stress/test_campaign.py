"""Campaign documents: what they become, and what is refused before anything runs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from nir_render import InputError
from nir_render.stress.campaign import Campaign, campaign_schema, load_campaign
from nir_render.stress.jobs import Job, plan
from nir_render.stress.sweep import PLANNED, plan_record, status_record
from nir_render.stress.workers.pool import part_file
from nir_render.transport.indirect.guide import group_power
from tests.paths import ROOT

pytestmark = pytest.mark.mitsuba

SHIPPED = sorted((ROOT / "scenes" / "campaigns").glob("*.yaml"))
AXES = {"range": {"path": "robots.r2.position.x", "values": ["1 m", "2 m", "4 m"]},
        "robots.r1.rig.cameras.front.exposure": ["50 us", "1 ms"]}  # fmt: skip


def written(folder: Path, **changes: Any) -> Path:
    document: dict[str, Any] = {
        "format": 1,
        "name": "small",
        "scene": str(ROOT / "scenes" / "one_source.yaml"),
        "set": {"robots.r2.motion": [], "robots.r2.position": "[1, 0.2, 0] m", "clock.frames": 1},
        "axes": AXES,
        "seeds": 2,
        "bounds": {"range_rmse": "5 cm"},
    }
    document |= changes
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
    return file


def planned(folder: Path, **changes: Any) -> tuple[Campaign, list[Job]]:
    campaign = load_campaign(written(folder, **changes))
    return campaign, plan(campaign)


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_the_shipped_campaigns_can_be_read(file: Path) -> None:
    campaign = load_campaign(file)
    assert campaign.name == file.stem
    assert {bound.metric for bound in campaign.bounds} <= set(campaign.metrics)


def test_lamps_of_the_large_campaign_share_their_light() -> None:
    """So 200 scenes of four cameras are 40 renders of each: its lamps take one share of the samples, whatever their flux."""
    campaign = load_campaign(ROOT / "scenes" / "campaigns" / "ranging_clutter_200.yaml")
    (lamp,) = (axis for axis in campaign.axes if axis.name == "lamp")
    powers = set()
    for value in lamp.values:
        snapshot = campaign.scene.with_(dict.fromkeys(lamp.paths, value)).at(0.0)
        powers |= {
            tuple(group_power(snapshot, snapshot.camera(name).camera)) for name in campaign.scene.cameras()
        }
    assert len(lamp.values) == 5
    assert len(powers) == 1


def test_editors_know_campaigns() -> None:
    """The schema is current, knows a good campaign, and finds what is misspelt."""
    kept = json.loads((SHIPPED[0].parent / "campaign.schema.json").read_text(encoding="utf-8"))
    assert kept == campaign_schema(), (
        "run: nir-render schema --campaign > scenes/campaigns/campaign.schema.json"
    )
    validator = Draft202012Validator(kept)
    for file in SHIPPED:
        text = file.read_text(encoding="utf-8")
        assert text.startswith("# yaml-language-server: $schema=campaign.schema.json\n")
        document = yaml.safe_load(text)
        validator.validate(document)
        assert not validator.is_valid(document | {"axis": {}})
        assert not validator.is_valid(document | {"figures": ["recal"]})
        assert not validator.is_valid(document | {"bounds": {"range_rsme": "5 cm"}})


def test_every_combination_gets_every_seed(tmp_path: Path) -> None:
    campaign, jobs = planned(tmp_path)
    assert campaign.seeds == (1, 2)
    assert len(jobs) == len({job.key for job in jobs}) == 3 * 2 * 2
    assert [job.point.values for job in jobs[:4]] == [(0, 0), (0, 0), (0, 1), (0, 1)]
    scene = campaign.scene.with_(jobs[-1].settings)
    assert scene.document.robots["r2"].position_m == (4.0, 0.2, 0.0)
    assert scene.camera("r1.front")[1].exposure_s == 1e-3
    assert (scene.document.seed, scene.document.clock.frames) == (2, 1)


def test_processes_plan_the_same_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign, jobs = planned(tmp_path)
    monkeypatch.setattr("nir_render.stress.jobs._MANY", 2)
    monkeypatch.setattr("nir_render.stress.jobs._CHUNK", 2)
    monkeypatch.setattr("nir_render.stress.jobs.usual_workers", lambda: 2)
    assert plan(campaign) == jobs
    broken = replace(campaign, axes=(replace(campaign.axes[0], values=("0 m", "2 m", "inf m")),))
    with pytest.raises(InputError) as told:
        plan(broken)
    monkeypatch.undo()
    with pytest.raises(InputError) as alone:
        plan(broken)
    assert told.value.problems == alone.value.problems


def test_light_is_shared_where_only_the_exposure_differs(tmp_path: Path) -> None:
    _, jobs = planned(tmp_path)
    assert len({job.light for job in jobs}) == 3 * 2  # each range, each seed
    for job in jobs:
        assert {other.point.values[0] for other in jobs if other.light == job.light} == {job.point.values[0]}


def test_a_job_is_named_by_what_it_does(tmp_path: Path) -> None:
    keys = {job.key for job in planned(tmp_path)[1]}
    assert {job.key for job in planned(tmp_path)[1]} == keys
    renamed = planned(tmp_path, bounds={}, figures=["recall"], description="other words")[1]
    assert {job.key for job in renamed} == keys  # what is made of the results does not change them
    more = planned(tmp_path, seeds=[1, 2, 3])[1]
    assert {job.key for job in more if job.seed < 3} == keys
    others = planned(tmp_path, estimators=["robust"])[1]
    assert not keys & {job.key for job in others}
    dimmer = {"robots.r2.motion": [], "robots.r2.position": "[1, 0.2, 0] m", "clock.frames": 1,
              "robots.r2.rig.sources.top.flux": "0.1 W"}  # fmt: skip
    assert not keys & {job.key for job in planned(tmp_path, set=dimmer)[1]}


def test_a_job_does_not_follow_from_the_scenes_own_seed(tmp_path: Path) -> None:
    base = {"robots.r2.motion": [], "robots.r2.position": "[1, 0.2, 0] m", "clock.frames": 1}
    (tmp_path / "seeded.yaml").write_text(
        (ROOT / "scenes" / "one_source.yaml").read_text().replace("seed: 1", "seed: 7")
    )
    seeded = planned(tmp_path, scene="seeded.yaml", set=base)[1]
    assert [job.key for job in seeded] == [job.key for job in planned(tmp_path, set=base)[1]]


def test_ones_own_estimator_is_known_by_what_its_file_holds(tmp_path: Path) -> None:
    own = tmp_path / "mine.py"
    own.write_text("def none(frame, calibration):\n    return []\n")
    first = planned(tmp_path, estimators=["mine.py:none"])[1]
    own.write_text("import beside_it\ndef none(frame, calibration):\n    return beside_it.NONE\n")
    (tmp_path / "beside_it.py").write_text("NONE = []\n")
    again = planned(tmp_path, estimators=["mine.py:none"])[1]
    assert not {job.key for job in first} & {job.key for job in again}
    (tmp_path / "beside_it.py").write_text("NONE = list()\n")
    other = planned(tmp_path, estimators=["mine.py:none"])[1]
    assert not {job.key for job in again} & {job.key for job in other}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"axes": {"robots.r2.position.x": ["1 m", "2 m"], "robots.r2.positoin": ["x"]}},
         r"axes\.robots\.r2\.positoin: x: .*did you mean 'position'"),
        ({"axes": {"m": {"path": "robots.r2.rig.sources.tpo", "values": ["infra_swarm"]}}},
         r"axes\.m: there is no 'tpo' in robots\.r2\.rig\.sources; did you mean 'top'"),
        ({"axes": {"m": {"path": "materials.paint", "values": [{"type": "diffuse", "reflectance": 0.1}]}}},
         r"axes\.m: there is no 'paint' in materials; known: none"),
        ({"axes": {"name": ["one", "two"]}}, "changes no picture"),
        ({"axes": {"fgo.visibility": ["20 m"]}}, r"'fgo' is no part of a scene"),
        ({"axes": {"robots.r9.rig.cameras.front.exposure": ["1 ms"]}}, r"there is no 'r9' in robots"),
        ({"axes": {"range": ["1 m"]}}, r"axes\.range: 1 m: range: 'range' is no part of a scene"),
        ({"axes": {"x": {"path": "robots.r2.position.x", "values": ["1 m", "2 s"]}}}, r"2 s: .*a length"),
        ({"axes": {"e": {"path": "robots.r1.rig.cameras.front.exposure", "values": ["1 ms", "-1 ms"]}}},
         r"axes\.e: -1 ms: .*greater than 0"),
        ({"axes": {"a": {"path": "render.visibility_rays", "values": [64, 2]}}}, r"axes\.a: 2: .*equal to 16"),
        ({"axes": {"a": {"path": "seed", "values": [1, 2]}}}, "write it under 'seeds'"),
        ({"axes": {"a": {"path": "clock.frames", "values": [1, 2]}}}, "set by 'set' too"),
        ({"bounds": {"range_rsme": "5 cm"}}, r"bounds\.range_rsme: .*did you mean 'range_rmse'"),
        ({"bounds": {"recall": "95 m"}}, r"bounds\.recall: .*length"),
        ({"bounds": {"range_rmse": 0.05}}, "bare number"),
        ({"figures": ["recal"]}, "did you mean 'recall'"),
        ({"estimators": ["robsut"]}, r"estimators: robsut: unknown; known: paper, robust"),
        ({"seeds": [1, 1]}, "different whole numbers"),
        ({"seeds": 0}, "greater than or equal to 1"),
        ({"scene": "nowhere.yaml"}, "there is no such scene file"),
        ({"axis": {}}, "did you mean 'axes'"),
        ({"axes": {}}, "at least 1 item"),
        ({"name": None}, "name: this key is missing"),
        # Each value is right beside the others' first ones; the last combination puts the camera into the box.
        ({"set": {"robots.r2.motion": [], "robots.r2.position": "[1, 0.2, 0] m",
                  "shapes": {"box": {"type": "box", "center": "[9, 0, 0.2] m", "size": "[0.5, 0.5, 0.5] m",
                                     "material": "black"}}},
          "axes": {"a": {"path": "shapes.box.center.x", "values": ["-9 m", "0.06 m"]},
                   "b": {"path": "robots.r1.position", "values": ["[0, 2, 0] m", "[0, 0, 0] m"]}}},
         r"at a = 0\.06 m, b = \[0, 0, 0\] m: .*inside shapes\.box"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_before_anything_runs(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said) as refused:
        planned(tmp_path, **changes)
    assert all(problem.startswith(f"{tmp_path / 'campaign.yaml'}") for problem in refused.value.problems)


def test_two_combinations_that_are_one_scene_are_refused(tmp_path: Path) -> None:
    """Their jobs would be one, and stand at one of two places."""
    axes = {"a": {"path": "fog", "values": [None, {"extinction": "0.1 /m"}, {"extinction": "100 /km"}]}}
    with pytest.raises(
        InputError, match=r"at a = \{extinction: 100 /km\}: the same scene as at a = \{extinction"
    ):
        planned(tmp_path, axes=axes)


def test_limits_are_refined_where_there_are_bounds_and_a_plan_says_so(tmp_path: Path) -> None:
    axes = {"range": {"path": "robots.r2.position.x", "values": ["1 m", "2 m", "4 m"], "refine": "2 %"}}
    with pytest.raises(InputError, match="'refine' finds limits: give 'bounds' too"):
        load_campaign(written(tmp_path, axes=axes, bounds={}))
    campaign, jobs = planned(tmp_path, axes=axes)
    assert plan_record(campaign, jobs, tmp_path / "out")["refined"] == ["range"]
    assert plan_record(*planned(tmp_path), tmp_path / "out")["refined"] == []


def test_what_is_done_is_told_without_planning_anew(tmp_path: Path) -> None:
    """Twelve jobs, five done, one file of a job that is none of them, one half-written."""
    campaign, jobs = planned(tmp_path)
    out = tmp_path / "out"
    with pytest.raises(InputError, match="no sweep has begun there"):
        status_record(campaign, out)
    (out / "jobs").mkdir(parents=True)
    (out / "campaign.json").write_text(json.dumps({"format": 1, "name": "small"}))
    (out / PLANNED).write_text(json.dumps({"format": 1, "jobs": [job.key for job in jobs]}))
    for job in (*jobs[:5], replace(jobs[0], key="0" * 32)):
        part_file(out / "jobs", job).touch()
    (out / "jobs" / f".{jobs[7].key}.parquet.partial-1").touch()
    assert status_record(campaign, out) == {"campaign": "small", "jobs": 12, "done": 5, "others": 1}
    with pytest.raises(InputError, match="holds the campaign 'small', not 'other'"):
        status_record(replace(campaign, name="other"), out)


def test_a_scene_is_no_campaign() -> None:
    with pytest.raises(InputError, match="is a scene"):
        load_campaign(ROOT / "scenes" / "arena.yaml")


def test_too_many_jobs_are_refused(tmp_path: Path) -> None:
    axes = {"a": {"path": "robots.r2.position.x", "from": "1 m", "to": "2 m", "count": 1000},
            "b": {"path": "robots.r2.position.z", "from": "0 m", "to": "1 m", "count": 3}}  # fmt: skip
    file = written(tmp_path, axes={"a": axes["a"] | {"count": 3}, "b": axes["b"]}, seeds=20_000)
    with pytest.raises(InputError, match="are 180000 jobs; at most 100000"):
        load_campaign(file)
