"""Spectral EXR: what is written is what a reader of the layout finds."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR

from nir_render.light.enlarge import Enlargement
from nir_render.light.exr import direct_document, write_light
from nir_render.light.light import DirectTable, Edges, Indirect, Light

# The channel names of the layout (Fichet et al. 2021): Stokes component, wavelength with a comma, unit.
_CHANNEL = re.compile(r"^S0\.(\d+,\d+)nm$")


def _light() -> Light:
    table = DirectTable(
        group=np.array([0]), facet=np.array([-1]), seen=np.arange(1024)[None] < 512, direction=np.array([[0.0, 0.0, 1.0]]), distance_m=np.array([2.0]),
        angular_radius_rad=np.array([0.005]), visible_fraction=np.array([0.5]),
        irradiance_per_w=np.array([[0.00995]]), visibility_rays=1024,
    )  # fmt: skip
    radiance = np.arange(2 * 6 * 8, dtype=np.float32).reshape(2, 1, 6, 8) / 7.0
    return Light(
        "r1.front", 0.0, 1, ("r2.top", "lamps.one"), (940e-9,), table, Indirect(radiance, radiance**2, 2, 16)
    )


def test_every_group_is_a_part_and_reads_back_to_the_bit(tmp_path: Path) -> None:
    light = _light()
    write_light(tmp_path / "light.exr", light)
    parts = {part.name(): part for part in OpenEXR.File(str(tmp_path / "light.exr")).parts}
    assert set(parts) == {"r2.top", "r2.top.variance", "lamps.one", "lamps.one.variance"}
    assert light.indirect is not None
    for group, name in enumerate(light.groups):
        ((channel, values),) = parts[name].channels.items()
        found = _CHANNEL.match(channel)
        assert found is not None
        assert float(found[1].replace(",", ".")) == 940.0
        assert values.pixels.dtype == np.float32
        np.testing.assert_array_equal(values.pixels, light.indirect.radiance_per_w[group, 0])
        ((_, variance),) = parts[f"{name}.variance"].channels.items()
        np.testing.assert_array_equal(variance.pixels, light.indirect.variance[group, 0])
    assert parts["r2.top"].header["emissiveUnits"] == "W.m^-2.sr^-1"


def test_the_samples_are_a_part_and_what_is_left_out_is_said(tmp_path: Path) -> None:
    """Frames cannot be made again from the file alone: the enlargement of edges is not in it."""
    light = _light()
    assert light.indirect is not None
    counts = np.arange(48, dtype=np.int32).reshape(6, 8)
    how = Enlargement(
        rows=12, columns=16, pixels=np.array([3]), first=np.array([0, 1]), block=np.array([2]),
        weight=np.array([0.5]), patch=np.array([7]),
    )  # fmt: skip
    patch = light.indirect.radiance_per_w[:, :, 0, :1]
    whole = replace(light.indirect, counts=counts, edges=Edges(how, patch, patch))
    write_light(tmp_path / "plain.exr", light)
    write_light(tmp_path / "whole.exr", replace(light, indirect=whole))
    parts = {part.name(): part for part in OpenEXR.File(str(tmp_path / "whole.exr")).parts}
    samples = parts["samples"].channels["samples"].pixels
    assert samples.dtype == np.uint32
    np.testing.assert_array_equal(samples, counts)
    for part in parts.values():
        assert (part.header["scale"], part.header["samples"]) == (2, 16)
        assert part.header["edges"].startswith("left out")
    (plain, *_) = OpenEXR.File(str(tmp_path / "plain.exr")).parts
    assert plain.header["edges"] == "none"


def test_the_direct_table_as_json() -> None:
    light = _light()
    (row,) = direct_document(light)["rows"]
    assert (row["group"], row["distance_m"], row["visible_fraction"]) == ("r2.top", 2.0, 0.5)
    assert row["irradiance_per_w"] == [0.00995]
    assert row["mirror"] is None
    bits = np.unpackbits(np.frombuffer(bytes.fromhex(row["seen"]), dtype=np.uint8)).astype(bool)
    np.testing.assert_array_equal(bits, light.direct.seen[0])


def test_a_ghost_and_the_sun_as_json() -> None:
    """A ghost names its mirror; the sun's infinite distance is null, as is what all rays of a disc see."""
    light = _light()
    table = replace(
        light.direct, facet=np.array([1]), distance_m=np.array([np.inf]), visible_fraction=np.array([1.0])
    )
    light = replace(light, direct=table, mirrors=("shapes.one", "shapes.other"))
    document = direct_document(light)
    (row,) = document["rows"]
    assert (row["mirror"], row["distance_m"], row["seen"]) == ("shapes.other", None, None)
    json.dumps(document, allow_nan=False)
    assert "shapes.other" in light._repr_html_()
