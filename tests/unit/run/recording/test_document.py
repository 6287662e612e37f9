"""What a person writes into recording.yaml: values with their σ, and defaults that are what the template says."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from nir_render.run.recording import make
from nir_render.run.recording.document import (
    CameraGiven,
    Measured,
    RecordingDocument,
    SourceGiven,
    parse_measured,
    recording_schema,
)
from nir_render.scene.text.units import FRACTION, LENGTH, PIXELS


def _template() -> str:
    with TemporaryDirectory() as folder:
        make.new_recording(Path(folder))
        return (Path(folder) / make.FILE).read_text(encoding="utf-8")


TEMPLATE = _template()
CAMERA = {
    "frames": "*.png", "exposure": "1 ms", "frame_rate": "30 Hz", "focal_length": "4 mm", "pixel_pitch": "5 um",
    "bit_depth": "8 bit",
}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "value", "sigma"),
    [
        ("4 mm", 4e-3, 8e-5),
        ("4 mm ± 0.1 mm", 4e-3, 1e-4),
        ("4 ± 0.1 mm", 4e-3, 1e-4),
        ("4 mm ± 100 um", 4e-3, 1e-4),
        ("4 mm +- 5 %", 4e-3, 2e-4),
        ("4 mm +/- 5%", 4e-3, 2e-4),
        ("800 px ± 2 px", 800.0, 2.0),
        ("4 mm ± 0 mm", 4e-3, 0.0),
    ],
)
def test_a_value_with_its_sigma(text: str, value: float, sigma: float) -> None:
    read = parse_measured(text, (LENGTH, PIXELS), 0.02)
    assert (read.value, read.sigma) == pytest.approx((value, sigma), rel=1e-12)
    assert read.quantity is (PIXELS if "px" in text else LENGTH)


def test_a_fraction_needs_no_unit() -> None:
    assert parse_measured("0.8 ± 0.1", (FRACTION,), 0.1) == Measured(0.8, 0.1, FRACTION)
    assert parse_measured(2, (FRACTION,), 0.1) == Measured(2.0, 0.2, FRACTION)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (4, "is not a length such as '0.3 m' or a length in the image such as '0.7 px'"),
        ("4", "is not a length"),
        ("4 kg", "is not a length"),
        ("4 mm ± 1 px", "wanted a length"),
        ("4 mm ± 1 mm ± 1 mm", "has two ±"),
        ("4 mm ± -1 mm", "has a σ below 0"),
        ("4 mm ± much", "'much' is not a length"),
        ([4], "is not a length"),
    ],
)
def test_what_is_no_value_is_told(text: Any, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        parse_measured(text, (LENGTH, PIXELS), 0.02)


def _defaults_in_template() -> dict[str, Any]:
    """Return what stands behind a # as a default: `# key: value`, value up to the next #."""
    found = re.findall(r"^ +# (\w+): +(.+?)(?: +#.*)?$", TEMPLATE, re.MULTILINE)
    return {key: yaml.safe_load(value) for key, value in found}


def test_the_defaults_are_those_that_the_template_states() -> None:
    stated = _defaults_in_template()
    plain = CameraGiven.model_validate(CAMERA)
    keys = (
        "line_time", "binning", "roi_left", "roi_top", "lens_model", "distortion", "position", "orientation",
        "saturation_capacity", "fixed_pattern", "psf", "response_at_corner", "transmission", "quantum_efficiency",
    )  # fmt: skip
    for key in keys:
        said = CameraGiven.model_validate({**CAMERA, key: stated[key]})
        assert said == plain, key
    plain_source = SourceGiven.model_validate({"radius": "1 cm"})
    said_source = SourceGiven.model_validate({"radius": "1 cm", "wavelength": stated["wavelength"]})
    assert said_source.wavelength_m == pytest.approx(plain_source.wavelength_m, rel=1e-12)


def test_every_key_stands_in_the_template() -> None:
    schema = recording_schema()
    Draft202012Validator.check_schema(schema)
    for model in ("CameraGiven", "SourceGiven", "KnownRange"):
        for key in schema["$defs"][model]["properties"]:
            assert re.search(rf"\b{key}:", TEMPLATE), key


def test_the_template_is_yaml_that_lacks_only_what_is_to_be_filled_in() -> None:
    raw = yaml.safe_load(TEMPLATE)
    raw["source"]["radius"] = "10 mm"
    raw["cameras"]["r1.front"] |= {key: value for key, value in CAMERA.items() if key != "frames"}
    del raw["known_ranges"]
    assert RecordingDocument.model_validate(raw).cameras["r1.front"].focal_length.sigma == pytest.approx(8e-5)
