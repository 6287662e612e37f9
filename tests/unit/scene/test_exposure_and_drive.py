"""Drives, shutters and exposures as they are written, and what is refused with a reason."""

from pathlib import Path
from typing import Any

import pytest

from nir_render import InputError, Scene, load_scene
from nir_render.scene.documents.camera import GlobalShutter, RollingShutter
from nir_render.scene.documents.times.drives import FULL_DRIVE, Drive
from nir_render.simulation.sent import sent_packets
from nir_render.truth.sent import parse_sent
from tests.paths import SCENES

CAMERA = "robots.r1.rig.cameras.front"
DRIVE = "robots.r2.rig.sources.top.drive"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def test_presets_shine_evenly_and_expose_all_rows_at_once(scene: Scene) -> None:
    camera = scene.camera("r1.front")[1]
    assert scene.sources()["r2.top"][1].drive == FULL_DRIVE
    assert (camera.gain, camera.bracket, camera.shutter) == (1.0, None, GlobalShutter())


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (0.25, {"constant": 0.25}),
        ("25 %", {"constant": 0.25}),
        ({"constant": 1}, {"constant": 1.0}),
        (
            {"square": {"frequency": "1 kHz", "duty": 0.3, "phase": "0.1 ms"}},
            {"square": {"frequency_hz": 1000.0, "duty": 0.3, "phase_s": 1e-4}},
        ),
        (
            {"bits": {"pattern": "0101101111", "rate": "10 Hz"}},
            {"bits": {"pattern": "0101101111", "rate_hz": 10.0, "start_s": 0.0, "repeat": 1, "idle": 1.0}},
        ),
        (
            {"bits": {"pattern": "01", "rate": "10 Hz", "start": "2 s", "repeat": "forever", "idle": 0}},
            {"bits": {"pattern": "01", "rate_hz": 10.0, "start_s": 2.0, "repeat": "forever", "idle": 0.0}},
        ),
    ],
)
def test_drives_are_read_and_written_again(scene: Scene, written: Any, read: dict[str, Any]) -> None:
    changed = scene.with_({DRIVE: written})
    drive = changed.sources()["r2.top"][1].drive
    ((form, value),) = read.items()
    got = getattr(drive, form)
    assert (got if form == "constant" else {name: getattr(got, name) for name in value}) == value
    dumped = drive.model_dump(mode="json", by_alias=True, exclude_none=True)
    assert Drive.model_validate(dumped) == drive


def test_one_form_replaces_another(scene: Scene) -> None:
    blinking = scene.with_({DRIVE: {"square": {"frequency": "1 kHz"}}})
    bits = blinking.with_({f"{DRIVE}.bits": {"pattern": "01", "rate": "10 Hz"}})
    drive = bits.sources()["r2.top"][1].drive
    assert drive.bits is not None
    assert drive.square is None
    auto = scene.with_({f"{CAMERA}.auto_exposure": {"shortest": "20 us", "longest": "2 ms"}})
    camera = auto.with_({f"{CAMERA}.bracket": ["50 us", "0.8 ms"]}).camera("r1.front")[1]
    assert camera.auto_exposure is None
    assert camera.bracket == pytest.approx((5e-5, 8e-4))


@pytest.mark.parametrize(
    ("drive", "reason"),
    [
        (1.01, "less than or equal to 1"),
        (-0.1, "greater than or equal to 0"),
        (
            {"constant": 1, "square": {"frequency": "1 kHz"}},
            "wanted one of 'constant', 'square', 'flicker', 'bits' and 'packets'",
        ),
        ({}, "wanted one of .* 'packets', not none"),
        ([1, 0], "is no drive; wanted 0.5"),
        ({"square": {"frequency": "1 kHz", "duty": 1.2}}, "duty.*less than or equal to 1"),
        ({"square": {"frequency": "1 kHz", "duty": -0.1}}, "duty.*greater than or equal to 0"),
        ({"square": {"frequency": "0 Hz"}}, "frequency.*greater than 0"),
        ({"square": {"frequency": "1 ms"}}, "a frequency such as '30 Hz'"),
        ({"bits": {"pattern": "0121", "rate": "10 Hz"}}, "'0121' is no string of the bits 0 and 1"),
        ({"bits": {"pattern": "", "rate": "10 Hz"}}, "'' is no string of the bits 0 and 1"),
        ({"bits": {"pattern": 101, "rate": "10 Hz"}}, "101 is no text; write the bits in quotes"),
        ({"bits": {"pattern": "01", "rate": "0 Hz"}}, "rate.*greater than 0"),
        ({"bits": {"pattern": "01", "rate": "-1 Hz"}}, "rate.*greater than 0"),
        ({"bits": {"pattern": "01", "rate": "10 Hz", "repeat": 0}}, "repeat"),
        ({"bits": {"pattern": "01", "rate": "10 Hz", "idle": 2}}, "idle.*less than or equal to 1"),
        ({"bits": {"patern": "01", "rate": "10 Hz"}}, "did you mean 'pattern'"),
        ({"packets": {"sends": []}}, "sends"),
        ({"packets": {"sends": [{"at": "1 s"}]}}, "wanted one of 'command', 'text' and 'word', not none"),
        ({"packets": {"sends": [{"at": "1 s", "command": "foward"}]}}, "'foward' is no command"),
        ({"packets": {"sends": [{"at": "1 s", "text": "né"}]}}, "'é' is no printable ASCII"),
        ({"packets": {"sends": [{"at": "1 s", "word": 128}]}}, "word.*less than or equal to 127"),
        ({"packets": {"sends": [{"at": "1 s", "command": "stop", "word": 0}]}}, "wanted one of 'command'"),
        (
            {"packets": {"sends": [{"at": "6 s", "word": 1}, {"at": "0.6 s", "command": "stop"}]}},
            r"sent at 6 s begins before what is sent at 0\.6 s has ended, at 6\.1 s",
        ),
        (
            {"packets": {"sends": [{"at": "0 s", "text": "no"}, {"at": "10.9 s", "word": 1}]}},
            "has ended, at 11 s",
        ),
    ],
)
def test_bad_drives_are_refused(scene: Scene, drive: Any, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        scene.with_({DRIVE: drive})


def test_lamps_have_drives_too() -> None:
    lamps = load_scene(SCENES / "arena.yaml").document.lamps
    (name, *_) = lamps
    changed = load_scene(SCENES / "arena.yaml", {f"lamps.{name}.drive": 0.5})
    assert changed.document.lamps[name].drive == Drive(constant=0.5)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"shutter": {"type": "rolling"}}, "line_time"),
        ({"shutter": {"type": "rolling", "line_time": "0 s"}}, "greater than 0"),
        ({"shutter": {"type": "global", "parasitic_light_sensitivity": 1e-4}}, "write 'line_time' too"),
        ({"shutter": {"type": "global", "line_time": "-1 us"}}, "greater than or equal to 0"),
        (
            {"shutter": {"type": "global", "line_time": "1 us", "parasitic_light_sensitivity": 1}},
            "parasitic_light_sensitivity.*less than 1",
        ),
        ({"shutter": {"type": "iris"}}, "there is no type 'iris'"),
        ({"shutter": {"line_time": "1 us"}}, "the key 'type' is missing"),
        ({"gain": 0.5}, "gain.*greater than or equal to 1"),
        ({"gain": 65}, "gain.*less than or equal to 64"),
        ({"bracket": ["50 us"]}, "bracket"),
        ({"bracket": ["50 us", "0 s"]}, "bracket.*greater than 0"),
        ({"bracket": [1, 2]}, "1 is a bare number"),
        ({"auto_exposure": {"shortest": "3 ms", "longest": "2 ms"}}, "shortest.*is longer than longest"),
        ({"auto_exposure": {"shortest": "20 us", "longest": "2 ms", "latency": 0}}, "latency"),
        ({"auto_exposure": {"shortest": "20 us", "longest": "2 ms", "most_gain": 100}}, "most_gain"),
        (
            {"gain": 4, "auto_exposure": {"shortest": "20 us", "longest": "2 ms", "most_gain": 2}},
            "most_gain, 2, is below the camera's own gain, 4",
        ),
    ],
)
def test_bad_cameras_are_refused(scene: Scene, change: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        scene.with_({f"{CAMERA}.{key}": value for key, value in change.items()})


def test_a_bracket_and_an_automatic_exposure_exclude_each_other(scene: Scene) -> None:
    auto = {"shortest": "20 us", "longest": "2 ms"}
    both = {"preset": "infra_swarm", "bracket": ["50 us", "1 ms"], "auto_exposure": auto}
    with pytest.raises(
        InputError, match="'auto_exposure' chooses each exposure by the frames before, 'brack"
    ):
        scene.with_({"robots.r1.rig": {"cameras": {"front": both}}})


ROLLING = {"type": "rolling", "line_time": "25 us"}  # 960 rows are read in 24 ms


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"exposure": "33.4 ms"},
            r"front\.exposure: 33\.4 ms is longer than the 33\.33 ms.*shorten it, or lower",
        ),
        ({"bracket": ["1 ms", "40 ms"]}, r"front\.bracket: 40 ms is longer than the 33\.33 ms"),
        (
            {"auto_exposure": {"shortest": "20 us", "longest": "34 ms"}},
            r"longest: 34 ms is longer than the 33",
        ),
        (
            {"exposure": "34 ms", "auto_exposure": {"shortest": "20 us", "longest": "1 ms"}},
            r"front\.exposure: 34",
        ),
        (
            {"shutter": {"type": "rolling", "line_time": "35 us"}},
            r"line_time: the read-out of 960 rows, 33\.6 ms, lasts longer than the 33\.33 ms.*lower clock.frame_r",
        ),
        (
            {"shutter": ROLLING, "auto_exposure": {"shortest": "20 us", "longest": "9.4 ms"}},
            r"longest: 9\.4 ms and the read-out of 960 rows, 24 ms, are longer than 1 × 33\.33 ms.*raise auto_exp",
        ),
    ],
)
def test_exposures_end_before_the_next_frame_begins(
    scene: Scene, change: dict[str, Any], reason: str
) -> None:
    """At 30 Hz; a single frame may last as long as it likes, and so may those of a camera that takes none."""
    changes = {f"{CAMERA}.{key}": value for key, value in change.items()}
    assert scene.with_({**changes, "clock.frames": 1, "clock.frame_rate": "30 Hz"})
    with pytest.raises(InputError, match=reason):
        scene.with_({**changes, "clock.frame_rate": "30 Hz"})
    idle = {key.replace("robots.r1", "robots.r3"): value for key, value in changes.items()}
    assert scene.with_({"robots.r3": {"rig": "infra_swarm"}, **idle, "clock.frame_rate": "30 Hz"})


@pytest.mark.parametrize(
    "change",
    [
        {"exposure": "33.3 ms"},
        {"exposure": "0.03333333333333333 s"},
        {"exposure": "33 ms", "shutter": ROLLING},  # each row ends before its own next exposure
        {"exposure": "50 ms", "bracket": ["1 ms", "2 ms"]},  # which takes the place of the exposure
        {"shutter": ROLLING, "auto_exposure": {"shortest": "20 us", "longest": "9.3 ms"}},
        {"shutter": ROLLING, "auto_exposure": {"shortest": "20 us", "longest": "33 ms", "latency": 2}},
        {
            "exposure": "30 ms",
            "shutter": {"type": "global", "line_time": "30 us"},
        },  # the next is exposed then
    ],
)
def test_exposures_that_fit_the_clock_are_taken(scene: Scene, change: dict[str, Any]) -> None:
    assert scene.with_({"clock.frame_rate": "30 Hz", **{f"{CAMERA}.{key}": change[key] for key in change}})


def test_a_resolved_scene_keeps_drive_shutter_and_bracket(scene: Scene, tmp_path: Path) -> None:
    changed = scene.with_(
        {
            DRIVE: {"bits": {"pattern": "0110", "rate": "10 Hz", "repeat": "forever"}},
            f"{CAMERA}.shutter": {"type": "rolling", "line_time": "12.5 us"},
            f"{CAMERA}.bracket": ["50 us", "200 us", "0.8 ms"],
            f"{CAMERA}.gain": 2,
        }
    )
    (tmp_path / "scene.yaml").write_text(changed.resolved_yaml())
    again = load_scene(tmp_path / "scene.yaml")
    assert again.document == changed.document
    camera = again.camera("r1.front")[1]
    assert camera.shutter == RollingShutter.model_validate({"type": "rolling", "line_time": "12.5 us"})
    assert camera.bracket == pytest.approx((5e-5, 2e-4, 8e-4), rel=1e-15)


def test_packets_follow_their_senders_clock(scene: Scene) -> None:
    """Out of order, back to back, on a clock 1 % slow and 3 ms late: when each starts in the world."""
    sends = [{"at": "12 s", "text": "ab"}, {"at": "6.5 s", "command": "recover"}, {"at": "1 s", "word": 3}]
    drive = {"packets": {"sends": sends, "offset": "3 ms", "drift": "1 %"}}
    packets = scene.with_({DRIVE: drive}).sources()["r2.top"][1].drive.packets
    assert packets is not None
    starts_s, words = zip(*packets.starts_s, strict=True)
    assert words == (3, 11, 97, 98)
    assert starts_s == pytest.approx([1.013, 6.568, 12.123, 17.678], abs=1e-12)
    assert packets.bit_s == pytest.approx(0.101)


def test_sent_packets_are_told_with_their_times(scene: Scene) -> None:
    sends = [{"at": "1 s", "command": "disperse"}]
    sent = sent_packets(scene.with_({DRIVE: {"packets": {"sends": sends, "rate": "20 Hz", "drift": "-2 %"}}}))
    (packet,) = sent
    assert parse_sent(packet.record()) == packet
    assert (packet.robot, packet.source, packet.word, packet.command) == ("r2", "top", 9, "disperse")
    assert (packet.start_s, packet.end_s) == pytest.approx((0.98, 0.98 + 55 * 0.049))
    assert sent_packets(scene) == []
