"""Mirror images told from robots: rooms with and without mirrors, by numpy; every image at its path, dimmed.

Detections have the errors that they claim, of the size that the robust estimator's have: 0.02 px, and 0.15 %
of range at 1 m, 0.6 % at 10 m.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from perception.rig.measure_set import measure_set
from perception.types import Measurement, MirrorPlane, SetMeasurements
from tests.unit.perception.rig.world import Array, detection, frame_without_pixels, rig
from tests.unit.perception.simulation import random

OWN_M = np.array([0.0, 0.0, 0.28])
RIG, WITH_OWN = rig(), rig(own_source=True)
Shown = tuple[Array, float, bool]
"""Where it is, by how much its range seems longer, whether it is an image."""


def _room(rng: np.random.Generator, count: int, before: tuple[Array, float] | None = None) -> list[Array]:
    """Robots on a floor of 8 × 8 m, 30 cm apart or more; all before a wall."""
    places: list[Array] = []
    while len(places) < count:
        place = np.array([*rng.uniform(-4.0, 4.0, 2), OWN_M[2]])
        apart = all(np.linalg.norm(place - other) > 0.3 for other in places)
        inside = before is None or before[0] @ place < before[1] - 0.15
        if np.linalg.norm(place[:2]) > 0.5 and apart and inside:
            places.append(place)
    return places


def _wall(rng: np.random.Generator) -> tuple[Array, float]:
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), float(rng.uniform(0.8, 3.0))


def _metal(_: float) -> float:
    return 0.9


def _pane(cosine: float) -> float:
    """A sheet of glass, index 1.52, both sides: by the sines and tangents of Fresnel's own formulas."""
    outside = np.arccos(min(cosine, 1.0 - 1e-12))
    inside = np.arcsin(np.sin(outside) / 1.52)
    across = (np.sin(outside - inside) / np.sin(outside + inside)) ** 2
    within = (np.tan(outside - inside) / np.tan(outside + inside)) ** 2
    one_side = 0.5 * (across + within)
    return float(2.0 * one_side / (1.0 + one_side))


def _images(
    places: list[Array], wall: tuple[Array, float], reflectance: Callable[[float], float]
) -> list[Shown]:
    normal, distance_m = wall
    shown = []
    for place in places:
        image = place + 2.0 * (distance_m - normal @ place) * normal
        path = image - [0.0, 0.0, 0.2]
        cosine = abs(float(path @ normal)) / float(np.linalg.norm(path))
        shown.append((image, float(1.0 / np.sqrt(reflectance(cosine))), True))
    return shown


def _measure(
    shown: list[Shown],
    rng: np.random.Generator,
    own_source: bool,
    common: float = 0.0,
    planes: tuple[MirrorPlane, ...] = (),
    errors: Array | None = None,
) -> SetMeasurements:
    cameras = WITH_OWN if own_source else RIG
    errors = np.ones(len(shown)) if errors is None else errors
    found = []
    for camera in cameras.values():
        hits = [
            detection(
                camera, place, rng, px=0.02, factor=factor, common=common, common_error=errors[number],
                relative=1e-3 * (1.0 + 0.5 * factor * float(np.linalg.norm(place))),
            )
            for number, (place, factor, _) in enumerate(shown)
        ]  # fmt: skip
        found.append([hit for hit in hits if hit is not None])
    frames = [frame_without_pixels(camera) for camera in cameras.values()]
    return measure_set(frames, found, cameras, planes)


def _told(shown: list[Shown], measurements: tuple[Measurement, ...]) -> Iterator[tuple[bool, Measurement]]:
    """Each measurement with whether it is an image, by its direction."""
    for one in measurements:
        towards = np.array([place for place, _, _ in shown]) - one.origin_body_m
        cosine = towards @ np.array(one.bearing_body) / np.linalg.norm(towards, axis=1)
        yield shown[int(np.argmax(cosine))][2], one


def _calls(
    scenes: Iterator[list[Shown]], rng: np.random.Generator, own_source: bool, common: float = 0.0
) -> tuple[list[str], list[str]]:
    """What images and robots are called."""
    images: list[str] = []
    robots: list[str] = []
    for shown in scenes:
        for is_image, one in _told(shown, _measure(shown, rng, own_source, common).measurements):
            (images if is_image else robots).append(one.ghost)
    return images, robots


def _with_mirror(
    rng: np.random.Generator, sets: int, count: int, reflectance: Callable[[float], float], own_source: bool
) -> Iterator[list[Shown]]:
    for _ in range(sets):
        wall = _wall(rng)
        robots = _room(rng, count, wall)
        mirrored = [*robots, OWN_M] if own_source else robots
        yield [(place, 1.0, False) for place in robots] + _images(mirrored, wall, reflectance)


@pytest.mark.parametrize("own_source", [True, False])
@pytest.mark.parametrize("reflectance", [_metal, _pane])
def test_images_of_three_robots_in_a_mirror_are_told(
    reflectance: Callable[[float], float], own_source: bool
) -> None:
    """At least 99 % of images, no robot, whether the observer sees itself or not."""
    rng = random(1510, int(own_source))
    images, robots = _calls(_with_mirror(rng, 120, 3, reflectance, own_source), rng, own_source)
    assert images.count("yes") >= 0.99 * len(images)
    assert len(images) >= 350
    assert robots.count("yes") == 0


def test_images_are_told_where_all_ranges_are_wrong_alike() -> None:
    """K off by its σ of 10 %: ranges 5 % too long; the geometry of a mirror is the same at another scale."""
    rng = random(1511)
    images, robots = _calls(_with_mirror(rng, 60, 5, _metal, True), rng, True, common=0.05)
    assert images.count("yes") >= 0.98 * len(images)
    assert robots.count("yes") == 0


def test_two_mirrors_are_two_planes() -> None:
    """A corner: metal ahead, glass on the left; each plane to a centimetre and a few mrad, and what it is."""
    rng = random(1512)
    ahead, left = (np.array([1.0, 0.0, 0.0]), 3.0), (np.array([0.0, 1.0, 0.0]), 2.0)
    robots = [np.array([x, y, 0.28]) for x, y in ((1.5, -1.0), (0.8, 1.1), (-1.7, 0.6), (2.2, 0.4))]
    shown: list[Shown] = [(place, 1.0, False) for place in robots]
    shown += _images([*robots, OWN_M], ahead, _metal) + _images([*robots, OWN_M], left, _pane)
    seen = _measure(shown, rng, own_source=True)
    assert [one.ghost == "yes" for _, one in _told(shown, seen.measurements)] == [
        is_image for is_image, _ in _told(shown, seen.measurements)
    ]
    metal, glass = sorted(seen.planes, key=lambda plane: -plane.distance_m)
    for plane, (normal, distance_m) in ((metal, ahead), (glass, left)):
        np.testing.assert_allclose(plane.normal_body, normal, atol=4e-3)
        assert plane.distance_m == pytest.approx(distance_m, abs=0.02)
        assert plane.images == 5
        assert abs(plane.distance_m - distance_m) < 4.0 * np.sqrt(plane.covariance[2, 2])
    assert (metal.kind, glass.kind) == ("constant", "pane")
    assert metal.parameter == pytest.approx(0.9, abs=0.02)
    assert glass.parameter == pytest.approx(1.52, abs=0.03)


def test_the_uncertainty_of_a_plane_is_true() -> None:
    """Distance over its σ, 80 mirrors: a root mean square of 1 ± 0.3."""
    rng = random(1513)
    pulls = []
    for _ in range(80):
        wall = _wall(rng)
        robots = _room(rng, 4, wall)
        shown = [(place, 1.0, False) for place in robots] + _images([*robots, OWN_M], wall, _metal)
        (plane,) = _measure(shown, rng, own_source=True).planes
        pulls.append((plane.distance_m - wall[1]) / np.sqrt(plane.covariance[2, 2]))
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("count", [3, 8, 16])
def test_without_a_mirror_no_robot_is_an_image(count: int) -> None:
    rng = random(1514, count)
    scenes = ([(place, 1.0, False) for place in _room(rng, count)] for _ in range(1200 // count))
    _, robots = _calls(scenes, rng, own_source=True)
    assert len(robots) >= 1190
    assert robots.count("yes") == 0


@pytest.mark.verify
@pytest.mark.parametrize("count", [3, 4, 6, 10, 20])
def test_robots_are_called_images_less_than_once_in_a_thousand(count: int) -> None:
    """No case in more than 3 000 robots: the 95 % upper bound is 0.1 %."""
    rng = random(1515, count)
    scenes = ([(place, 1.0, False) for place in _room(rng, count)] for _ in range(3200 // count))
    _, robots = _calls(scenes, rng, own_source=True)
    assert len(robots) >= 3000
    assert robots.count("yes") == 0


@pytest.mark.parametrize("spread_m", [0.0, 0.01, 0.03])
def test_a_formation_is_no_mirror(spread_m: float) -> None:
    """Two rows of five, in step to 0, 1 or 3 cm: mirror images of each other, but with all of their light."""
    rng = random(1516, int(1e3 * spread_m))

    def formation() -> list[Shown]:
        turn, off = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0, 2)
        ahead, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        places = [0.8 * i * ahead + 0.8 * j * left + off for i in range(5) for j in range(2)]
        places = [place + spread_m * rng.normal(size=2) for place in places if np.linalg.norm(place) > 0.4]
        return [(np.array([*place, OWN_M[2]]), 1.0, False) for place in places]

    _, robots = _calls((formation() for _ in range(40)), rng, own_source=True)
    assert robots.count("yes") <= 0.01 * len(robots)


def _in_column(rng: np.random.Generator) -> list[Shown]:
    """Five robots behind each other, 80 cm apart to 1 cm, each with two LEDs 12 cm apart across the column."""
    turn, off = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0, 2)
    ahead, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    robots = [off + 0.8 * i * ahead for i in range(5)]
    robots = [place + 0.01 * rng.normal(size=2) for place in robots if np.linalg.norm(place) > 0.45]
    lights = [place + side * 0.06 * left for place in robots for side in (1.0, -1.0)]
    return [(np.array([*place, OWN_M[2]]), 1.0, False) for place in lights]


@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_several_leds_in_column_are_no_mirror(spread: float) -> None:
    """LEDs of one body stand in step: two robots that mirror another two are two coincidences, not four."""
    rng = random(1517, int(100 * spread))
    robots: list[str] = []
    for _ in range(60):
        shown = _in_column(rng)
        told = _measure(shown, rng, own_source=True, common=spread, errors=rng.normal(size=len(shown)))
        robots += [one.ghost for one in told.measurements]
    assert len(robots) > 500
    assert robots.count("yes") == 0


@pytest.mark.verify
def test_several_leds_in_column_are_called_images_less_than_once_in_a_thousand() -> None:
    """No case in more than 3 000: the 95 % upper bound is 0.1 %."""
    rng = random(1518)
    _, robots = _calls((_in_column(rng) for _ in range(340)), rng, own_source=True)
    assert len(robots) >= 3000
    assert robots.count("yes") == 0


def test_images_of_robots_with_several_leds_are_told() -> None:
    rng = random(1519)

    def scenes() -> Iterator[list[Shown]]:
        for _ in range(30):
            wall = _wall(rng)
            lights = []
            for place in _room(rng, 3, wall):
                turn = rng.uniform(0.0, 2.0 * np.pi)
                across = 0.06 * np.array([np.cos(turn), np.sin(turn), 0.0])
                lights += [place + across, place - across]
            yield [(p, 1.0, False) for p in lights] + _images([*lights, OWN_M], wall, _metal)

    images, robots = _calls(scenes(), rng, own_source=True)
    assert images.count("yes") >= 0.99 * len(images)
    assert robots.count("yes") == 0


def test_a_lone_pair_may_be_a_robot_and_its_image() -> None:
    """Two flares have a mirror plane, whoever they are."""
    rng = random(1517)
    pair = [(np.array([1.5, 0.3, 0.28]), 1.0, False), (np.array([3.0, 2.0, 0.28]), 1.0, False)]
    near, far = sorted(_measure(pair, rng, False).measurements, key=lambda one: one.range_m)
    assert (near.ghost, far.ghost) == ("no", "possible")


def test_a_known_plane_tells_the_image_of_a_single_robot() -> None:
    """The plane that five robots showed before; then four are gone. Told too where the plane is 3 cm off."""
    rng = random(1518)
    wall = (np.array([0.0, 1.0, 0.0]), 1.5)
    robots = [np.array([x, y, 0.28]) for x, y in ((2.2, 0.5), (1.1, -0.8), (-1.9, 0.4), (3.6, -0.6))]
    (plane,) = _measure(
        [(place, 1.0, False) for place in robots] + _images(robots, wall, _metal), rng, False
    ).planes
    alone: list[Shown] = [(robots[0], 1.0, False), *_images(robots[:1], wall, _metal)]
    before = _measure(alone, rng, False)
    assert "yes" not in [one.ghost for one in before.measurements]
    moved = replace(plane, distance_m=plane.distance_m + 0.03, covariance=plane.covariance + 1e-3 * np.eye(4))
    for known in (plane, moved):
        seen = _measure(alone, rng, False, planes=(known,))
        assert [one.ghost for is_image, one in _told(alone, seen.measurements) if is_image] == ["yes"]
        assert [one.ghost for is_image, one in _told(alone, seen.measurements) if not is_image] == ["no"]
        assert len(seen.planes) == 1


def test_a_robot_behind_a_pane_is_no_image() -> None:
    """Somebody stands beyond the glass, where no image can be."""
    rng = random(1519)
    wall = (np.array([0.0, 1.0, 0.0]), 2.0)
    robots = [np.array([x, y, 0.28]) for x, y in ((1.5, -1.0), (0.8, 1.1), (-1.7, 0.6))]
    beyond = np.array([0.4, 3.1, 0.28])
    shown = [(place, 1.0, False) for place in [*robots, beyond]] + _images(robots, wall, _pane)
    calls = list(_told(shown, _measure(shown, rng, False).measurements))
    assert [one.ghost for is_image, one in calls if not is_image] == ["no"] * 4
    assert [one.ghost for is_image, one in calls if is_image] == ["yes"] * 3


@pytest.mark.parametrize("reflectance", [_metal, _pane])
def test_images_are_told_where_leds_differ(reflectance: Callable[[float], float]) -> None:
    """LEDs of ±10 %: each robot's ranges off by its own 5 %, its image's alike, some of them at seams.

    That leaves less to tell a mirror that takes 10 % of the light from a formation: 92 % of images here.
    """
    rng = random(1520)
    images: list[str] = []
    robots: list[str] = []
    for _ in range(60):
        wall = _wall(rng)
        places = _room(rng, 4, wall)
        shown = [(place, 1.0, False) for place in places] + _images(places, wall, reflectance)
        errors = np.tile(rng.normal(size=4), 2)
        seen = _measure(shown, rng, False, common=0.05, errors=errors)
        for is_image, one in _told(shown, seen.measurements):
            (images if is_image else robots).append(one.ghost)
    assert images.count("yes") >= (0.88 if reflectance is _metal else 0.97) * len(images)
    assert robots.count("yes") == 0


def test_a_plane_that_is_there_no_more_hinders_nothing() -> None:
    """A mirror of yesterday, 1 m off, is handed in: what is there today is found, and nothing else."""
    rng = random(1521)
    images: list[str] = []
    for shown in _with_mirror(rng, 30, 4, _metal, True):
        stale = MirrorPlane((0.6, 0.8, 0.0), 1.3, "constant", 0.8, np.diag([1e-4, 1e-4, 1e-2, 1e-2]), 3)
        seen = _measure(shown, rng, True, planes=(stale,))
        for is_image, one in _told(shown, seen.measurements):
            assert is_image or one.ghost != "yes"
            images += [one.ghost] * is_image
    assert images.count("yes") >= 0.98 * len(images)


def test_a_plane_handed_on_is_as_good_as_its_covariance() -> None:
    """A faint mirror, R 0.06 ± 0.015: the prior is of R, not of its logarithm."""
    rng = random(1522)
    wall = (np.array([0.0, 1.0, 0.0]), 1.5)
    told = 0
    for _ in range(20):
        place = np.array([rng.uniform(-1.3, 2.7), rng.uniform(-1.0, 0.5), 0.28])
        shown = [(place, 1.0, False), *_images([place], wall, lambda _: 0.06)]
        off_m, off = 0.01 * rng.normal(), 0.015 * rng.normal()
        known = MirrorPlane(
            (0.0, 1.0, 0.0), 1.5 + off_m, "constant", 0.06 + max(off, -0.04), np.diag([1e-6, 1e-6, 1e-4, 2.25e-4]), 3
        )  # fmt: skip
        seen = _measure(shown, rng, False, planes=(known,))
        told += any(one.ghost == "yes" for is_image, one in _told(shown, seen.measurements) if is_image)
    assert told >= 19


def test_a_floor_that_shines_is_a_mirror_at_the_bodys_own_origin() -> None:
    """The body's origin is on the floor: n·x = 0, 20 cm below the cameras."""
    rng = random(1523)
    robots = [
        np.array([x, y, z])
        for x, y, z in ((2.0, 0.5, 0.3), (1.4, -1.0, 0.25), (-1.8, 0.6, 0.4), (0.2, 2.4, 0.3))
    ]
    shown = [(place, 1.0, False) for place in robots]
    shown += _images(robots, (np.array([0.0, 0.0, -1.0]), 0.0), _metal)
    calls = list(_told(shown, _measure(shown, rng, False).measurements))
    assert [one.ghost for is_image, one in calls if is_image] == ["yes"] * 4


def test_images_are_told_in_a_crowd() -> None:
    """25 robots and their images: more flares than are searched for mirrors."""
    rng = random(1524)
    images, robots = _calls(_with_mirror(rng, 4, 25, _metal, True), rng, True)
    assert images.count("yes") >= 0.97 * len(images)
    assert robots.count("yes") == 0


def test_a_mirror_that_shows_few_of_many_is_found() -> None:
    """20 robots, four of them with an image: nine of ten such images."""
    rng = random(1525)
    images: list[str] = []
    for _ in range(12):
        wall = _wall(rng)
        places = _room(rng, 20, wall)
        shown = [(place, 1.0, False) for place in places] + _images(places[:4], wall, _metal)
        calls = list(_told(shown, _measure(shown, rng, False).measurements))
        images += [one.ghost for is_image, one in calls if is_image]
        assert "yes" not in [one.ghost for is_image, one in calls if not is_image]
    assert images.count("yes") >= 0.8 * len(images)


def test_planes_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="wanted a unit normal"):
        _measure(
            [], random(1526), False, planes=(MirrorPlane((0, 1, 0), 1.0, "constant", 0.0, np.eye(4), 1),)
        )
