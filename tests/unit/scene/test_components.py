"""Dotted paths that end in a component of a vector: robots.r2.position.x."""

import pytest

from nir_render import InputError, load_scene

SCENE = "scenes/arena.yaml"  # r2 stands at "[2.1, 0.6, 0] m"


@pytest.mark.parametrize(
    ("path", "value", "position_m"),
    [
        ("robots.r2.position.x", "3.25 m", (3.25, 0.6, 0.0)),
        ("robots.r2.position.y", "-40 cm", (2.1, -0.4, 0.0)),
        ("robots.r2.position.2", "0.3 m", (2.1, 0.6, 0.3)),
    ],
)
def test_one_component_changes_and_the_others_keep_their_bits(
    path: str, value: str, position_m: tuple[float, ...]
) -> None:
    assert load_scene(SCENE, {path: value}).document.robots["r2"].position_m == position_m


def test_components_follow_one_another() -> None:
    changed = load_scene(SCENE, {"robots.r2.position": "[100, 0, 0] cm"}).with_(
        {"robots.r2.position.x": "1.5 m", "robots.r2.position.z": "20 mm"}
    )
    assert changed.document.robots["r2"].position_m == pytest.approx((1.5, 0.0, 0.02), rel=1e-15)


def test_a_vector_without_a_unit_has_components_too() -> None:
    changed = load_scene(SCENE, {"shapes.white_wall.normal.y": 0.5})
    assert changed.document.shapes["white_wall"].normal == (-1.0, 0.5, 0.0)  # type: ignore[union-attr]


def test_lists_longer_than_vectors_keep_their_indices() -> None:
    scene = load_scene("scenes/blinking.yaml")
    assert scene.raw["robots"]["r1"]["rig"]["cameras"]["front"]["lens"]["distortion"] == [
        -0.15,
        0.02,
        0.0,
        0.0,
    ]
    changed = scene.with_({"robots.r1.rig.cameras.front.lens.distortion.3": 1e-4})
    assert changed.camera("r1.front")[1].lens.distortion == (-0.15, 0.02, 0.0, 1e-4)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("robots.r2.position.w", "1 m", "take x, y or z"),
        ("robots.r2.position.x.y", "1 m", "take x, y or z"),
        ("robots.r2.position.x", 3.0, "bare number"),
        ("robots.r2.position.x", "3 s", "a length"),
        ("shapes.white_wall.size.z", "1 m", "has 2 components"),
    ],
)
def test_what_is_no_component_says_so(path: str, value: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scene(SCENE, {path: value})
