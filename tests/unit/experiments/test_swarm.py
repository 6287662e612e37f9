"""A massive swarm that stands: who can be seen, who is whom, what is heard."""

import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.evaluate.metrics import source_limits
from nir_render.experiments.swarm.followed import Followed
from nir_render.experiments.swarm.hall import HALL, OBSERVER, hall_scene, places_m, side_m
from nir_render.experiments.swarm.identity import number_of, words_of
from nir_render.experiments.swarm.judge import Word, judged_packets, sights, whys
from nir_render.experiments.swarm.loop import Swarm, SwarmLoop
from nir_render.experiments.swarm.outcome import Condition, Outcome
from nir_render.experiments.swarm.page import write_outcome
from nir_render.simulation.calibration import calibration
from nir_render.simulation.sent import sent_packets
from nir_render.truth.sent import SentTruth
from nir_render.truth.sources import SourceTruth
from perception import Detection, Message, Track
from perception.types import Ghost

CAMERA = f"{OBSERVER}.front"


@pytest.mark.parametrize("robots", [30, 128, 129, 1000, 3072])
def test_words_tell_robots_apart(robots: int) -> None:
    """Everybody's words are its own, and give its number back; beyond 128 their order can be told."""
    said = [words_of(number, robots) for number in range(robots)]
    assert len(set(said)) == robots
    assert [number_of(words, robots) for words in said] == list(range(robots))
    assert all(0 <= word < 128 for words in said for word in words)
    if robots > 128:
        assert all(number_of(words[::-1], robots) is None for words in said)
        assert number_of(said[-1][:1], robots) is None
    if robots == 1000:
        assert number_of((31, 127), robots) is None  # it would be number 3071
        with pytest.raises(ValueError, match="1000"):
            words_of(1000, robots)


def _row(u_px: float, direct_e: float = 1000.0, **changes: Any) -> SourceTruth:
    given: dict[str, Any] = {"camera": CAMERA, "index": 0, "time_s": 0.0, "source": "top", "robot": f"at{u_px:g}", "u_px": u_px,
             "v_px": 400.0, "range_m": 3.0, "bearing_body": (1.0, 0.0, 0.0), "direct_e": direct_e}  # fmt: skip
    return SourceTruth(**(given | changes))


def test_how_robots_can_be_seen() -> None:
    """Limits: 2 px to one of a tenth of the light, 4 px, half of it seen, SNR 5, 3 px from the edge."""
    known = calibration(load_scene(HALL), CAMERA)
    rows = [
        _row(100.0), _row(101.9),
        _row(200.0), _row(202.1),
        _row(300.0, 10_001.0), _row(301.0, 1000.0),
        _row(350.0, visible_fraction=0.98),
        _row(400.0, visible_fraction=0.49), _row(500.0, peak_snr=4.9), _row(600.0, 0.0, on_fraction=0.0),
        _row(2.9),
        _row(1276.1),
        _row(1275.9, v_px=500.0),
        _row(700.0, v_px=2.0),
    ]  # fmt: skip
    assert [why for why, _ in whys(rows, known)] == [
        "merged", "merged",
        "free", "free",
        "free", "merged",
        "eclipsed", "hidden", "faint", "dark",
        "cut", "cut", "free", "cut",
    ]  # fmt: skip
    assert [near for _, near in whys(rows, known)][:4] == [True] * 4


def test_a_track_off_on_the_bearing_of_who_is_partly_hidden_is_its() -> None:
    """As the camera sees it, 6 cm before the middle of the robot; within 3 px, and only of those given."""
    known = {CAMERA: calibration(load_scene(HALL), CAMERA)}
    lens_m, px_rad = known[CAMERA].position_body_m, 1.0 / known[CAMERA].fx_px
    place_m = lens_m + 2.0 * np.array([math.cos(0.4), math.sin(0.4), 0.0])
    for off_px, unlike, whom in (
        (2.9, {CAMERA: ["a"]}, ("a", True)), (3.1, {CAMERA: ["a"]}, (None, True)), (0.0, {CAMERA: []}, (None, True)),
    ):  # fmt: skip
        followed = Followed(["b", "a"], np.stack([-place_m, place_m]), unlike, known)
        turn_rad = 0.4 + off_px * px_rad
        track = replace(
            _track(0.0, 0.0),
            position_body_m=lens_m + 3.5 * np.array([math.cos(turn_rad), math.sin(turn_rad), 0.0]),
        )
        followed.update([track])
        assert followed.now() == [whom]


def _hit(u_px: float, v_px: float = 400.0, **changes: Any) -> Detection:
    given: dict[str, Any] = {
        "camera": CAMERA, "index": 0, "time_s": 0.0, "u_px": u_px, "v_px": v_px, "u_sigma_px": 0.1, "v_sigma_px": 0.1,
        "flux_dn": 100.0, "mean_dn": 64.0, "background_dn": 64.0, "area_px": 9, "saturated": False, "merged": False,
        "ghost": False, "range_m": 3.0, "range_sigma_m": 0.1, "bearing_body": (1.0, 0.0, 0.0),
    }  # fmt: skip
    return Detection(**(given | changes))


def test_detections_of_nobody_and_parts_of_who_is_partly_hidden() -> None:
    """Each robot has one detection; a second one on it is a part only where something hides some of it."""
    rows = [
        _row(100.0, robot="whole"), _row(200.0, visible_fraction=0.9, robot="part"),
        _row(300.0, direct_e=0.0, on_fraction=0.0, robot="dark"), _row(400.0, direct_e=0.0, visible_fraction=0.0, robot="gone"),
    ]  # fmt: skip
    hits = [
        _hit(100.1), _hit(101.5),  # the second one is of nobody
        _hit(200.2), _hit(201.0), _hit(198.0), _hit(203.1),  # one, two parts, and one beyond 3 px
        _hit(300.0), _hit(400.0),  # where no light comes from
        _hit(500.0, ghost=True), _hit(600.0, ghost=True), _hit(601.0), # a mirror image, and one of nobody beside it
    ]  # fmt: skip
    rows.append(_row(600.2, robot="whole", ghost_of="whole"))
    known = {CAMERA: calibration(load_scene(HALL), CAMERA)}
    in_set = sights(
        ["whole", "part", "dark", "gone", "away"], {CAMERA: rows}, {CAMERA: hits}, {CAMERA: []}, known
    )
    assert [(one.robot, one.why, one.found) for one in in_set.sights] == [
        ("whole", "free", True), ("part", "eclipsed", True), ("dark", "dark", False), ("gone", "hidden", False),
        ("away", "cut", False),
    ]  # fmt: skip
    # Whoever calls itself a ghost where there is no mirror image is a false alarm.
    assert (in_set.parts, in_set.false_alarms) == (2, 6)


def test_limits_are_those_beside_all_others() -> None:
    """Of two that overlap by a little, of a large near one, and of one alone: as if all rows were asked."""
    known = calibration(load_scene(HALL), CAMERA)
    rows = [
        _row(200.0, robot="a"), _row(203.5, robot="b"), _row(300.0, 1e5, range_m=0.4, robot="near"),
        _row(330.0, robot="beside"), _row(900.0, robot="alone"),
    ]  # fmt: skip
    hits = [_hit(row.u_px) for row in rows]
    in_set = sights(
        [row.robot for row in rows], {CAMERA: rows}, {CAMERA: hits}, {CAMERA: []}, {CAMERA: known}
    )
    for row, one in zip(rows, in_set.sights, strict=True):
        assert one.limit_m == source_limits(row, known, rows)[0]
    lone_m = source_limits(rows[0], known)[0]
    assert in_set.sights[0].limit_m > 1.05 * lone_m


def _message(start_s: float, end_s: float, word: int, track: int = 1) -> Message:
    return Message("o", track, start_s, end_s, word, "x", confidence=1.0, frames=5)


def test_words_are_held_against_packets() -> None:
    """A packet of which one frame of five was read is received; who says two robots' word is none of them."""
    sent = [SentTruth("a", "top", 3.0, 8.5, 7, "x"), SentTruth("b", "top", 3.2, 8.7, 7, "x"),
            SentTruth("c", "top", 9.0, 14.5, 8, "x"), SentTruth("d", "top", 9.1, 14.6, 8, "x")]  # fmt: skip
    told = [
        Word(("a",), _message(7.4, 8.5, 7)),  # its own, the last frame alone
        Word(("c",), _message(3.3, 8.8, 7)),  # of a or b, but its track is c's
        Word(("c",), _message(9.7, 15.2, 8)),  # ends too late
        Word((), _message(8.4, 13.9, 8)),  # begins too early, of nobody's track
        Word(("c", "d"), _message(9.0, 14.5, 8)),  # c's or d's: one of them
        Word(("d", "c"), _message(9.1, 14.6, 8)),  # and the other
    ]
    packets = judged_packets(sent, told)
    assert packets.received == (True, False, True, True)
    assert (packets.misattributed, packets.wrong) == (1, 2)


def _track(time_s: float, x_m: float, number: int = 1, ghost: Ghost = "no") -> Track:
    place, still = np.array([x_m, 0.0, 0.0]), np.zeros(3)
    return Track("o", time_s, number, place, still, 1e-4 * np.eye(6), ghost=ghost)


def test_a_word_is_of_whom_its_track_followed_for_most_of_it() -> None:
    """σ and floor are 1 and 2 cm, so 5 σ are 11.2 cm."""
    known = {CAMERA: calibration(load_scene(HALL), CAMERA)}
    followed = Followed(["a", "b"], np.array([[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), {}, known)
    for time_s, x_m in ((0.0, 2.11), (1.0, 2.0), (4.0, 2.12), (9.0, 2.98), (10.0, 3.0)):
        followed.update([_track(time_s, x_m), _track(time_s, 3.0, 2, "yes")])
    assert followed.now() == [("b", False)]
    assert followed.during(1, 0.0, 10.0) == "a"  # for four seconds; b for one, nobody for five
    assert followed.during(1, 3.5, 9.4) == "a"
    assert followed.during(1, 3.5, 9.6) == "b"
    assert followed.during(1, 5.0, 8.0) is None
    assert followed.during(2, 0.0, 10.0) is None


@pytest.mark.parametrize("density_per_m2", [0.5, 2.0])
def test_robots_stand_apart_within_their_hall(density_per_m2: float) -> None:
    places = places_m(300, density_per_m2, seed=3)
    half_m = 0.5 * side_m(300, density_per_m2)
    assert 300 / (2.0 * half_m) ** 2 == pytest.approx(density_per_m2)
    apart_m = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    assert apart_m[np.triu_indices(300, 1)].min() >= 0.3
    assert abs(places).max() <= half_m - 0.15
    assert places[0].tolist() == [0.0, 0.0]


def test_who_does_not_fit_is_told() -> None:
    """In 1.12 m squared ten robots never stand 0.3 m apart; that is said, and how many there is room for."""
    assert len(places_m(5, 4.0, seed=0)) == 5
    with pytest.raises(ValueError, match=r"10 robots at 8 per m².* room for [5-9] in 1.12 m squared"):
        places_m(10, 8.0, seed=0)
    with pytest.raises(ValueError, match="1 robots: wanted 2 to 3072"):
        Swarm(robots=1).loop(load_scene(HALL), 0)


def test_as_many_speak_at_a_time_as_in_a_whole_minute() -> None:
    """Of 129 robots a share of (30 − 1.5 − 12.15) / 60 ends two packets within 30 s; each says its number."""
    scene = hall_scene(load_scene(HALL), 400, 1.0, "masts", 30.0, seed=0)
    packets = sent_packets(scene)
    assert max(packet.end_s for packet in packets) <= 30.0
    robots = {packet.robot for packet in packets}
    expected = 399 * (30.0 - 1.5 - 12.15) / 60.0
    assert abs(len(robots) - expected) < 4.0 * math.sqrt(expected * (1.0 - expected / 399))
    for robot in robots:
        words = tuple(packet.word for packet in packets if packet.robot == robot)
        assert words == words_of(int(robot[1:]), 400)


@pytest.mark.mitsuba
def test_columns_hide_as_upright_cylinders_do() -> None:
    """By hand: a source is hidden if its line to the lens meets a column of 5 cm below 25.5 cm of height."""
    from nir_render.transport.render import direct_light

    scene = hall_scene(load_scene(HALL), 120, 2.0, "columns", 10.0, seed=1)
    world = scene.at(0.0)
    light = direct_light(world, CAMERA, 1)
    lens_m = world.camera(CAMERA).pose.position_m
    axes_m = {name: robot.pose.position_m[:2] for name, robot in world.robots.items()}
    expected, found = {}, {}
    for group, fraction in zip(light.direct.group, light.direct.visible_fraction, strict=True):
        robot = light.groups[group].partition(".")[0]
        source_m = world.sources[light.groups[group]].pose.position_m
        hidden = clear = True
        for aside_m in (-0.009, 0.0, 0.009):  # both rims of the disc, and its middle
            across = np.array([-(source_m - lens_m)[1], (source_m - lens_m)[0]])
            end_m = source_m[:2] + aside_m * across / np.linalg.norm(across)
            met = any(
                _meets(lens_m, np.array([*end_m, source_m[2]]), axis_m)
                for name, axis_m in axes_m.items()
                if name not in (robot, OBSERVER)
            )
            hidden, clear = hidden and met, clear and not met
        if hidden or clear:
            expected[robot], found[robot] = hidden, bool(fraction < 0.5)
    assert sum(expected.values()) >= 5
    off = {robot for robot in expected if expected[robot] != found[robot]}
    assert len(off) <= 0.02 * len(expected), off  # the upper or lower half may pass a column's top


def _meets(lens_m: np.ndarray, source_m: np.ndarray, axis_m: np.ndarray) -> bool:
    """Tell whether a line of sight enters an upright cylinder, by the quadratic of its place along the line."""
    along = source_m - lens_m
    off = lens_m[:2] - axis_m
    a, b, c = along[:2] @ along[:2], 2.0 * off @ along[:2], off @ off - 0.05**2
    if b * b - 4.0 * a * c <= 0.0:
        return False
    ends = (-b + np.array([-1.0, 1.0]) * math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    first, last = np.clip(ends, 0.0, 1.0)
    return bool(last > first and lens_m[2] + first * along[2] < 0.255)


@pytest.mark.mitsuba
def test_a_run_that_is_saved_goes_on_to_the_same_record() -> None:
    plan = Swarm(level="measurements", robots=12, density_per_m2=1.0, lasts_s=1.0, rate_hz=10.0)
    scene = load_scene(HALL)
    whole, part = plan.loop(scene, 2), plan.loop(scene, 2)
    while whole.done < whole.steps:
        whole.step()
    for _ in range(4):
        part.step()
    again: SwarmLoop = pickle.loads(pickle.dumps(part))
    while again.done < again.steps:
        again.step()
    assert again.record() == whole.record()
    assert {sight[1] for sight in whole.record()["standing"]} <= {"free", "eclipsed", "merged", "hidden"}


def _record(seed: int) -> dict[str, Any]:
    """Four others: one free and found 1 σ off, one free and missed, one merged and found, one dark."""
    sights = [
        ["r0001", "free", False, True, 2.0, 0.02, 2.02, 0.01, True], ["r0002", "free", True, False, 3.0, 0.05, None, None, True],
        ["r0003", "merged", True, True, 4.0, 0.1, 4.4, 0.1, True], ["r0004", "dark", False, False, 1.0, None, None, None, False],
    ]  # fmt: skip
    return {
        "format": 1, "seed": seed, "places_m": [[0.0, 0.0], [2.0, 0.0], [0.0, 3.0], [4.0, 0.0], [1.0, 0.0]],
        "standing": [[*sights[0]], [*sights[1]], [*sights[2]], ["r0004", "free", *sights[3][2:]]],
        "sights": [sights, sights], "false_alarms": 3, "parts": 5,
        "packets": [["r0001", 1, 5.0, True], ["r0003", 3, 7.0, False], ["r0004", 4, 7.0, True]],
        "misattributed": 1, "wrong_words": 0, "identities": {"right": ["r0001", "r0004"], "wrong": 1},
        "tracks": [["r0001", False], [None, True], ["r0001", True]], "shared": {"front": {"groups": [1, 2], "mean_share": 1e-5, "worst_share": 0.004}},
    }  # fmt: skip


def test_figures_and_page_of_a_record_by_hand(tmp_path: Path) -> None:
    seconds = [
        {"set": 0, "render_cpu_s": 9.0},
        {"set": 1, "expose_cpu_s": 0.1, "detect_cpu_s": 0.2, "follow_cpu_s": 0.1},
    ]
    condition = Condition(Swarm(robots=5), [_record(0), _record(1)], seconds)
    figures = condition.figures()
    assert (figures["lit"], figures["found"], figures["free"], figures["free_found"]) == (12, 8, 8, 4)
    assert figures["could_be_seen"]["free"] == pytest.approx(0.75)
    assert figures["within_4_px"] == pytest.approx(0.5)
    assert figures["range"]["of_limit"] == pytest.approx(1.0)
    assert figures["range"]["of_sigma"] == pytest.approx(2.0)
    assert figures["range"]["typical_of_limit"] == pytest.approx(1.0 / 0.6745)
    assert figures["range"]["rmse_m"] == pytest.approx(0.02)
    claims = figures["ranges_by_sight"]
    names = ("lit", "found", "ranged", "within_3_sigmas", "of_sigma")
    assert [claims["free"][name] for name in names] == [8, 4, 4, 4, pytest.approx(2.0)]
    assert [claims["merged"][name] for name in names] == [4, 4, 4, 0, pytest.approx(4.0)]
    assert claims["merged"]["off_typical"] == pytest.approx(0.1)
    assert claims["merged"]["sigma_typical"] == pytest.approx(0.025)
    assert claims["hidden"]["off_typical"] is None
    assert figures["range"]["unranged"] == 0.0
    assert figures["packets_by_sight"] == {"free": [4, 4], "merged": [2, 0]}
    assert (figures["told_in_full"], figures["identities_right"], figures["identities_wrong"]) == (6, 4, 2)
    counted = ("tracks", "tracks_off", "tracks_of_nobody", "tracks_twice")
    assert [figures[name] for name in counted] == [6, 2, 2, 2]
    assert (figures["false_alarms"], figures["parts"]) == (6, 10)
    assert figures["seconds"]["light_of_a_set"] == 9.0
    page = write_outcome(Outcome(5, "hall", [0, 1], [condition]), tmp_path)
    text = page.read_text()
    assert "8 of 12" not in text
    assert "66.67 %" in text
    assert "20000 µs" in text
