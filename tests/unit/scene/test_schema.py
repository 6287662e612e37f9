"""The JSON Schema in the repository is the one that the models make, and the scenes hold by it."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from nir_render.scene.schema import scene_schema
from tests.paths import SCENES


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = scene_schema()
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def test_the_schema_in_the_repository_is_current() -> None:
    kept = json.loads((SCENES / "scene.schema.json").read_text(encoding="utf-8"))
    assert kept == scene_schema(), "run: nir-render schema > scenes/scene.schema.json"


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda path: path.name)
def test_scenes_name_the_schema_and_hold_by_it(path: Path, validator: Draft202012Validator) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# yaml-language-server: $schema=scene.schema.json\n")
    validator.validate(yaml.safe_load(text))


def _scene(camera: Any) -> dict[str, Any]:
    return {"format": 1, "observe": ["a"], "robots": {"a": {"rig": {"cameras": {"c": camera}}}}}


@pytest.mark.parametrize(
    ("camera", "holds"),
    [
        ("infra_swarm", True),
        ({"preset": "infra_swarm", "exposure": "1 ms"}, True),
        ({"preset": "infra_swarm", "exposure": 1}, False),
        ({"preset": "infra_swarm", "exposur": "1 ms"}, False),
        (
            {"exposure": "1 ms"},
            True,
        ),  # a preset of the rig may hold the rest; the loader tells where none does
        ({"preset": "infra_swarm", "sensor": {"preset": "mt9m031", "quantum_efficiency": 0.2}}, True),
    ],
)
def test_the_schema_takes_what_editors_should_take(
    camera: Any, holds: bool, validator: Draft202012Validator
) -> None:
    assert validator.is_valid(_scene(camera)) is holds


FOG = {"extinction": "0.05 /m"}


@pytest.mark.parametrize(
    ("part", "holds"),
    [
        ({"fog": FOG}, True),
        ({"fog": {"visibility": "50 m", "top": "4 m"}}, True),
        ({"fog": {**FOG, "visibility": "50 m"}}, False),
        ({"fog": {"albedo": 0.9}}, False),
        ({"fog": {**FOG, "phase": {"type": "table", "file": "phase.csv"}}}, True),
        ({"fog": {**FOG, "phase": {"type": "table", "points": [["0 deg", 9], ["180 deg", 1]]}}}, True),
        ({"fog": {**FOG, "phase": {"type": "henyey_greenstein", "g": 1.5}}}, False),
        ({"sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"}}, True),
        ({"sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": 0.305}}, False),
        ({"materials": {"g": {"type": "pane"}}}, True),
        ({"materials": {"g": {"type": "pane", "reflectance": 0.1}}}, False),
    ],
)
def test_the_schema_takes_fog_sun_and_panes(part: Any, holds: bool, validator: Draft202012Validator) -> None:
    assert validator.is_valid({**_scene("infra_swarm"), **part}) is holds


@pytest.mark.parametrize(
    ("pattern", "holds"),
    [
        ({"points": [["0 deg", 1], ["180 deg", 0]]}, True),
        ({"file": "led.csv"}, True),
        ({"grid": {"polar": "[0, 180] deg", "azimuth": "[0] deg", "values": ["[1]", "[0]"]}}, True),
        ({"grid": {"polar": [0, 180], "azimuth": "[0] deg", "values": ["[1]", "[0]"]}}, False),
        ({"points": [[0, 1], [180, 0]]}, False),
    ],
)
def test_the_schema_takes_patterns(pattern: Any, holds: bool, validator: Draft202012Validator) -> None:
    rig = {"sources": {"top": {"preset": "infra_swarm", "pattern": pattern}}}
    assert validator.is_valid({"format": 1, "observe": ["a"], "robots": {"a": {"rig": rig}}}) is holds
