"""Documents that no machine should choke on, and what their authors are told."""

import time
from pathlib import Path

import pytest

from nir_render import InputError, load_scene
from nir_render.scene.text.yaml_text import parse_yaml
from nir_render.stress.campaign import load_campaign

GOOD = """format: 1
observe: [a]
robots:
  a: {rig: infra_swarm}
"""
CAMPAIGN = """format: 1
name: c
scene: scene.yaml
axes:
  robots.a.position: ["[0, 0, 0] m", "[1, 0, 0] m"]
"""
BOMB = "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


def _told(folder: Path, text: str, name: str = "scene.yaml") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_scene(path) if name == "scene.yaml" else load_campaign(path)
    return str(caught.value).replace(str(path), name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: &z [*z]\n", "scene.yaml, line 5: the alias *z stands inside what it names; write out what is meant"),
        ("fog: &a {b: *a}\n", "scene.yaml, line 5: the alias *a stands inside what it names"),
        (BOMB, "with its aliases written out the file holds more than 50000 values"),
        ("x0: &x0 {a: 1}\n" + "".join(f"x{n}: &x{n} {{<<: [*x{n - 1}, *x{n - 1}]}}\n" for n in range(1, 40)),
         "with its aliases written out the file holds more than 50000 values"),
        ("fog: " + "[" * 5000, "scene.yaml, line 5: values are nested more than 32 deep; take some of the brackets out"),
        ("fog: *mist\n", "an alias (*name) without its anchor"),
        ("fog: [1, 2\n", "a list that lacks its ']', or a comma"),
        ("fog:\n\tx: 1\n", "line 6: a tab; indent with spaces"),
        ("fog: 'x\n", "a quote that is not closed"),
        ("fog: a: b\n", "line 5: a ':' where no key can be"),
        ("fog: !!int abc\n", "a tag ('!!…') or a number does not fit"),
        ("fog: !mist 3\n", "a tag ('!…'), or a value that YAML takes for one"),
        ("fog: {<<: {a: 1}}\n", "line 5: '<<' is not read here; take a preset, or write the keys out"),
        ("1: x\n", "line 5: the key '1' is not a name; write it as text, in quotes"),
        ("no: x\n", "line 5: the key 'no' is not a name"),
        ("fog: \x07\n", "holds the character '\\x07', which YAML does not take; take it out"),
        ("seed: 1:30:00\n", "line 5: YAML takes '1:30:00' for the number 5400, in base 60; put it in quotes"),
        ("seed: 010\n", "line 5: YAML takes '010' for the octal number 8"),
        ("name: 2020-01-01\n", "line 5: YAML takes '2020-01-01' for a date"),
        ("clock: {frames: no}\n", "scene.yaml:5: clock: 'frames' is false; nothing here is true or false"),
        ("shapes: {w: {type: rectangle, center: '[3,0,0] m', size: '[1,1] m', material: black, normal: [no, 0, 1]}}\n",
         "scene.yaml:5: shapes.w: 'normal' holds false; nothing here is true or false"),
    ],
)  # fmt: skip
def test_what_yaml_makes_of_a_text_is_told_with_the_line(tmp_path: Path, text: str, said: str) -> None:
    started = time.process_time()
    assert said in _told(tmp_path, GOOD + text)
    assert time.process_time() - started < 2.0


def test_an_unknown_key_has_its_line_and_hides_nothing(tmp_path: Path) -> None:
    told = _told(tmp_path, GOOD + "clok: {frames: 3}\nseed: x\nfogg: 3\nrobot: {}\nclock: {framse: 3}\n")
    assert told.splitlines() == [
        "scene.yaml:6: seed: 'x' is no whole number; write it in digits, such as 3",
        "scene.yaml:9: clock: unknown key 'framse'; did you mean 'frames'?",
        "scene.yaml:5: unknown key 'clok'; did you mean 'clock'?",
        "scene.yaml:7: unknown key 'fogg'; did you mean 'fog'?",
        "scene.yaml:8: unknown key 'robot'; did you mean 'robots'?",
    ]


def test_a_misspelt_key_is_not_missing_besides(tmp_path: Path) -> None:
    told = _told(tmp_path, GOOD.replace("observe", "obsrve"))
    assert told == "scene.yaml:2: unknown key 'obsrve'; did you mean 'observe'?"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("clock: {frames: 1000000000}\n", "clock.frames: input should be less than or equal to 1e+06"),
        ("clock: {frames: 1000, frame_rate: 1e-300 Hz}\n", "clock: the last frame is at 9.99e+302 s, beyond the 1e+09 s"),
        ("seed: 99999999999999999999\n", "scene.yaml:5: seed: input should be less than or equal to 9.22337e+18"),
        ("include: [" + "x" * 300 + ".yaml]\n", "is too long for the name of a file; give one that exists"),
        ("shapes: {m: {type: mesh, file: " + "x" * 300 + ".ply, material: black}}\n", "is too long for the name of a file"),
        ("lamps: {l: " + "x" * 300 + ".yaml}\n", "scene.yaml:5: lamps.l: 'xxx"),
        ("shapes: {s: {type: plane, size: '[1, 1] m', material: black}}\n",
         "shapes.s: there is no type 'plane'; did you mean 'rectangle'? write it such as {type: rectangle, center:"),
        ("shapes: {s: {type: sphere, center: '[1e300, 0, 0] m', radius: 1 m, material: black}}\n",
         "shapes.s.center: '[1e300, 0, 0] m' is beyond 1e+06 m, the largest length that is taken; check number and unit"),
        ("fog: {visibility: 1e-12 m}\n", "fog: visibility: '1e-12 m' is too short: its extinction is beyond 1e+09 1/m"),
        ("shapes: " + "x" * 100_000 + "\n", "shapes: 'xxxx"),
    ],
)  # fmt: skip
def test_what_is_beyond_all_scenes_is_refused_at_once(tmp_path: Path, text: str, said: str) -> None:
    started = time.process_time()
    told = _told(tmp_path, GOOD + text)
    assert said in told
    assert len(told) < 600
    assert time.process_time() - started < 2.0


def test_a_hold_that_adds_nothing_is_refused(tmp_path: Path) -> None:
    motion = "motion: [{time: 1 s, hold: 1e-20 s, position: '[0,0,0] m'}, {time: 2 s, position: '[1,0,0] m'}]"
    told = _told(tmp_path, GOOD.replace("rig: infra_swarm", f"rig: infra_swarm, {motion}"))
    assert (
        "robots.a: motion: the hold of 1e-20 s is too short to count at 1 s; lengthen it, or leave it out"
        in told
    )


def test_a_million_frames_are_checked_at_once(tmp_path: Path) -> None:
    """A robot goes to and fro before a box, and its camera is in it at the far end, the last frame, alone."""
    motion = "motion: [{time: 0 s, position: '[0,0,0] m'}, {time: 999999 s, position: '[2,0,0] m'}]"
    box = "shapes: {b: {type: box, center: '[2.56, 0, 0.2] m', size: '[1,1,1] m', material: black}}\n"
    clock = "clock: {frames: 1000000, frame_rate: 1 Hz}\n"
    rig = "rig: {cameras: {front: {preset: infra_swarm, position: '[0.06, 0, 0.2] m'}}}"
    scene = GOOD.replace("rig: infra_swarm", f"{rig}, {motion}") + box + clock
    started = time.process_time()
    assert "the camera is inside shapes.b at 999999 s" in _told(tmp_path, scene.replace("2.56", "2.559999"))
    path = tmp_path / "free.yaml"
    path.write_text(scene.replace("2.56", "2.61"))
    assert len(load_scene(path).document.frame_times_s()) == 1_000_000
    assert time.process_time() - started < 5.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seeds: x\n", "c.yaml:6: seeds: 'x' is no whole number; write it in digits, such as 3; or: 'x' is no list"),
        ("seeds: [1, x]\n", "c.yaml:6: seeds.1: 'x' is no whole number"),
        ("axs: {}\n", "c.yaml:6: unknown key 'axs'; did you mean 'axes'?"),
        ("seeds: &s [*s]\n", "c.yaml, line 6: the alias *s stands inside what it names"),
        ("estimators: paper\n", "c.yaml:6: estimators: 'paper' is no list; write it in brackets"),
        ("description: 1:30\n", "c.yaml, line 6: YAML takes '1:30' for the number 90, in base 60"),
        ("scene: " + "x" * 300 + ".yaml\n", "key 'scene' stands twice; take one of them out"),
    ],
)  # fmt: skip
def test_campaigns_are_told_likewise(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "scene.yaml").write_text(GOOD)
    assert said in _told(tmp_path, CAMPAIGN + text, "c.yaml")


def test_aliases_that_stand_for_little_are_taken() -> None:
    read = parse_yaml("a: &a {x: [1, 2]}\nb: *a\nc: {d: *a, y: 3}\n", "text")
    assert read == {"a": {"x": [1, 2]}, "b": {"x": [1, 2]}, "c": {"d": {"x": [1, 2]}, "y": 3}}


def test_a_truth_value_within_an_axis_is_told_as_the_end_of_a_range(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(GOOD)
    text = CAMPAIGN.replace('["[0, 0, 0] m", "[1, 0, 0] m"]', "{from: 1 m, to: on, count: 2}")
    assert "c.yaml:5: axes.robots.a.position: True is no number with a unit" in _told(
        tmp_path, text, "c.yaml"
    )
