"""The table of materials in docs/scene_files.md says what the files say: `python -m tests.unit.test_material_table`."""

import sys

from nir_render import parse_scene
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.files import preset_names
from nir_render.scene.documents.materials import MaterialDocument, Pane, Retroreflector, RoughConductor
from nir_render.scene.documents.matter.texture import TextureDocument
from tests.paths import ROOT

BASE = {"format": 1, "observe": ["a"], "robots": {"a": {"rig": "infra_swarm"}}}
HEAD = "| name | what it is | at 940 nm | ± | range | basis |\n|---|---|---|---|---|---|"


def _share(value: float | CurveDocument | TextureDocument) -> str:
    assert not isinstance(value, TextureDocument)
    if isinstance(value, float):
        return f"{value:g}"
    curve = value.curve("reflectance")
    return f"{float(curve(940e-9)):.3g}, a curve"


def _figure(material: MaterialDocument) -> str:
    if isinstance(material, Retroreflector):
        return f"R_A {material.coefficients[0][0]:g} cd/(lx m²), over {_share(material.reflectance)}"
    if isinstance(material, RoughConductor):
        share = 1.0 if material.share is None else material.share
        return f"n {material.index:g}, k {material.extinction_index:g}, share {share:g}"
    if isinstance(material, Pane):
        return f"n {material.index:g}, passes {_share(material.transmission)}"
    reflectance = getattr(material, "reflectance", None)
    return f"n {material.index:g}" if reflectance is None else _share(reflectance)  # type: ignore[union-attr]


def table() -> str:
    """Return the table."""
    lines = [HEAD]
    for name in preset_names("materials"):
        material = parse_scene({**BASE, "materials": {"m": name}}).document.materials["m"]
        evidence = material.evidence
        if evidence is None:
            lines.append(f"| `{name}` | {material.type} | {_figure(material)} | | | an ideal |")
            continue
        spread = f"{100.0 * evidence.uncertainty:g} %"
        ends = "" if evidence.least is None else f"{evidence.least:g} to {evidence.most:g}"
        lines.append(
            f"| `{name}` | {material.type} | {_figure(material)} | {spread} | {ends} | {evidence.basis} |"
        )
    return "\n".join(lines)


def test_the_table_of_materials_is_that_of_the_files() -> None:
    text = (ROOT / "docs" / "scene_files.md").read_text(encoding="utf-8")
    assert table() in text, (
        "run: python -m tests.unit.test_material_table, and put it into docs/scene_files.md"
    )


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
