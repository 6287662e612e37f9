"""Make `docs/witness.md`: what others measured beside what comes out here (`python tools/witness.py`).

Each figure of others stands here with where it is published; each of ours is reckoned by the code that makes
scenes. Where they differ by more than `AGREE` the page says why.
"""

import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.files import expand_preset
from nir_render.scene.emission import emission_spectrum
from nir_render.spectra.bandpass import blue_shift
from nir_render.spectra.illuminants import incandescent_spectrum, radiant_flux_w, table_of
from nir_render.spectra.sunlight import Column, sunlight
from tests.physics.emva import Sheet, bench_scene, measure

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "witness.md"
AGREE = 0.03
"""Relative difference up to which two figures are called equal; for decibels half a decibel."""

MATRIX = "Balluff (Matrix Vision), technical documentation of {}: measured after EMVA 1288, grey scale"
OSRAM = "OSRAM, data sheet SFH 4545, version 1.4 (2016-09-26), typical, 100 mA, 25 °C"
VISHAY = "Vishay, data sheet VSMY2940, document 84221, revision 1.1 (2017-12-08), typical, 100 mA"
KNIGHT = "Knight Optical, technical notes on interference filters: centre · (1 − 0.11 sin² θ)"
BPW34 = (
    "Vishay, data sheet BPW34, document 81521: 70 µA at 1000 lx of illuminant A, 47 µA at 1 mW/cm² of 950 nm"
)
PAPER = "the Infra-Swarm paper"
ASTM = "ASTM G173-03, integrals of the table (pvlib)"

SENSORS = {
    "imx273": (40.2, 71.4, MATRIX.format("mvBlueFOX3-2016")),
    "imx249": (45.1, 73.0, MATRIX.format("mvBlueFOX3-2024a")),
    "mt9m031": (37.4, 54.3, MATRIX.format("mvBlueFOX3-1012b")),
}
"""Greatest signal-to-noise ratio and dynamic range in dB."""


@dataclass(frozen=True)
class Witness:
    """One figure of others beside ours; `source` is where theirs is published, `why` a difference.

    Theirs is a value, or a `bound`: ours is "more than" it, or "at most".
    """

    what: str
    unit: str
    theirs: float
    ours: float
    source: str
    why: str = ""
    bound: str = ""

    @property
    def agrees(self) -> bool:
        """Whether the two are equal as far as this page asks, or ours keeps to their bound."""
        if self.bound:
            return self.ours > self.theirs if self.bound == "more than" else self.ours <= self.theirs
        off = abs(self.ours - self.theirs)
        return off <= 0.5 if self.unit == "dB" else off <= AGREE * abs(self.theirs)

    @property
    def verdict(self) -> str:
        """What the page says of the two."""
        said = ("holds" if self.bound else "equal") if self.agrees else "differs"
        return f"{said}: {self.why}" if self.why else said


def sensors(folder: Path) -> Iterator[Witness]:
    """Measure cameras of presets with the standard's own code, as `tests/physics/test_emva1288.py` does."""
    for name, (snr_db, range_db, source) in SENSORS.items():
        sheet = measure(bench_scene(folder, name), seed=1)
        yield Witness(f"{name}: greatest signal-to-noise ratio", "dB", snr_db, _snr_db(sheet), source)
        why = "the preset's read noise, 6.7 e, is of another camera with it" if name == "imx249" else ""
        yield Witness(f"{name}: dynamic range", "dB", range_db, _range_db(sheet), source, why)


def _snr_db(sheet: Sheet) -> float:
    return 10.0 * math.log10(sheet.saturation_capacity_e)


def _range_db(sheet: Sheet) -> float:
    """Return saturation over the light that equals its noise (EMVA 1288, release 4.0, equations 26 to 28)."""
    rounding_e = math.sqrt(1.0 / 12.0) / sheet.system_gain_dn_per_e
    least_e = math.hypot(sheet.read_noise_e, rounding_e) + 0.5
    return 20.0 * math.log10(sheet.saturation_capacity_e / least_e)


def leds(folder: Path) -> Iterator[Witness]:
    """Compare LEDs of presets with their data sheets."""
    osram, vishay = (_source(name, folder) for name in ("sfh_4545", "vsmy2940"))
    spectrum = emission_spectrum(osram)
    nm, relative = spectrum.wavelength_m * 1e9, np.asarray(spectrum.value)
    peak = int(np.argmax(relative))
    first_nm = float(np.interp(0.5 * relative[peak], relative[:peak], nm[:peak]))
    last_nm = float(np.interp(0.5 * relative[peak], relative[:peak:-1], nm[:peak:-1]))
    yield Witness("SFH 4545: radiant intensity on its axis", "mW/sr", 550.0, _axis_mw_per_sr(osram), OSRAM)
    yield Witness("SFH 4545: angle of half intensity", "°", 5.0, _half_angle_deg(osram), OSRAM)
    yield Witness("SFH 4545: peak", "nm", 950.0, float(nm[peak]), OSRAM)
    centroid_nm = float(np.trapezoid(nm * relative, nm) / np.trapezoid(relative, nm))
    yield Witness("SFH 4545: centroid", "nm", 940.0, centroid_nm, OSRAM)
    yield Witness("SFH 4545: width at half maximum", "nm", 42.0, last_nm - first_nm, OSRAM)
    yield Witness("VSMY2940: radiant intensity on its axis", "mW/sr", 145.0, _axis_mw_per_sr(vishay), VISHAY)
    yield Witness("VSMY2940: angle of half intensity", "°", 10.0, _half_angle_deg(vishay), VISHAY)


def _source(name: str, folder: Path) -> Source:
    written = expand_preset({"preset": name}, "sources", folder)
    return Source.model_validate(written, context={"folder": folder})


def _pattern(source: Source) -> tuple[np.ndarray, np.ndarray]:
    assert source.pattern is not None
    assert source.pattern.points is not None
    points = np.array(source.pattern.points)
    polar_rad = np.linspace(0.0, math.pi, 100_001)
    return polar_rad, np.interp(polar_rad, points[:, 0], points[:, 1])


def _axis_mw_per_sr(source: Source) -> float:
    """Return Φ I(0) / ∫ I dΩ."""
    polar_rad, value = _pattern(source)
    integral_sr = 2.0 * math.pi * np.trapezoid(value * np.sin(polar_rad), polar_rad)
    return float(1e3 * source.flux_w * value[0] / integral_sr)


def _half_angle_deg(source: Source) -> float:
    polar_rad, value = _pattern(source)
    return math.degrees(float(polar_rad[np.flatnonzero(value < 0.5 * value[0])[0]]))


def filters() -> Iterator[Witness]:
    """Compare the shift of a tilted filter, effective index 2.13, with a maker's rule."""
    for angle_deg in (10.0, 20.0, 30.0):
        angle_rad = math.radians(angle_deg)
        theirs = 940.0 * 0.11 * math.sin(angle_rad) ** 2
        ours = 940.0 * (1.0 - float(blue_shift(math.cos(angle_rad), 2.13)))
        yield Witness(f"940 nm filter at {angle_deg:g}°: shift to the blue", "nm", theirs, ours, KNIGHT)


def sun() -> Iterator[Witness]:
    """Compare the sun at ASTM G173's conditions with its table; 940 nm is built on it, 850 nm is not."""
    import pvlib

    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")
    light = sunlight(Column(0.014164, 0.003438, 0.084, 0.0, 0.3), math.radians(90.0 - 48.2358), None)
    for first_nm, last_nm in ((935.0, 945.0), (845.0, 855.0)):
        within = table.loc[first_nm:last_nm, "direct"]
        theirs = float(np.trapezoid(within, within.index))
        finely_m = np.linspace(first_nm, last_nm, 4001) * 1e-9
        ours = float(np.trapezoid(light.direct(finely_m), finely_m))
        what = f"direct sun through air mass 1.5, {first_nm:g} to {last_nm:g} nm"
        yield Witness(what, "W/m²", theirs, ours, ASTM)


def lamps() -> Iterator[Witness]:
    """Compare what lamps send per lux: in the infrared by a photodiode, in the visible by a spectrometer."""
    spectrum = incandescent_spectrum(2856.0, "illuminant A")
    nm = np.arange(430.0, 1100.5, 0.5)
    sent = radiant_flux_w(1000.0, spectrum) * spectrum(nm * 1e-9) * 1e-9
    # Even between the sheet's 10 % points, 430 and 1100 nm, but for a straight fall over the last 100 nm.
    efficiency = np.interp(nm, [430.0, 1000.0, 1100.0], [1.0, 1.0, 0.1 * 950.0 / 1100.0])
    yield Witness(
        "1000 lx of 2856 K in a bare silicon photodiode: as much as light of 950 nm of", "W/m²",
        10.0 * 70.0 / 47.0, float(np.trapezoid(sent * efficiency * nm / 950.0, nm)), BPW34,
        "the diode's efficiency between its edges is assumed even",
    )  # fmt: skip
    tube = 1.0 / radiant_flux_w(1.0, table_of("FL11").normalised())
    yield Witness(
        "fluorescent room light: lumens per watt within 380 to 780 nm", "lm/W",
        214.77 / 0.6471, tube, "doi:10.1016/j.physbeh.2017.05.002, table 1, FL (ambient)",
    )  # fmt: skip


def paper() -> Iterator[Witness]:
    """Compare what the paper says of its light."""
    bare, diffused = (_varies_percent(name) for name in ("bare", "diffused"))
    yield Witness(
        "intensity of the bare source over ±85° varies by", "%", 40.0, bare,
        PAPER + ", Exp. 2",
        "a plain Lambertian die falls to 9 % at 85°; the paper says not by how much more",
        "more than",
    )  # fmt: skip
    yield Witness(
        "under the diffuser, ± about its middle", "%", 10.0, diffused, PAPER + ", Exp. 2",
        "an opal globe does better than a shade must", "at most",
    )  # fmt: skip


def _varies_percent(name: str) -> float:
    """Return (max − min) / max over ±85° of a preset, in %; ± about the middle for the diffused one."""
    source = Source.model_validate(expand_preset({"preset": name}, "sources", ROOT), context={"folder": ROOT})
    polar_rad, value = _pattern(source)
    seen = value[polar_rad <= math.radians(85.0)]
    span = seen.max() - seen.min()
    return float(100.0 * span / (seen.max() if name == "bare" else seen.max() + seen.min()))


HEAD = """# The world as witness

What others measured or state, beside what comes out here for the same thing. Theirs is cited; ours is
reckoned anew by `tools/witness.py`, which makes this page (a test holds that it is its output), from the
presets and the code that make scenes: the cameras are measured by the standard's own program on frames of a
uniform field, as a laboratory would. Two figures that differ by less than 3 %, or half a decibel, are
called equal; where theirs is a bound, it holds or not. Where a preset was made from the very figure beside it
the row only shows that nothing was lost on the way: the dynamic ranges, the 850 nm sun, the maker's tilted
filter, the photodiode under a lamp, the tube's lumens and the paper's own figures are independent.

| what | theirs | ours | | theirs is from |
|---|---|---|---|---|
"""

TAIL = """
What nobody here has measured, and no public figure was found for, stands in no row: the quantum efficiency
of the MT9M031 at 940 nm (an assumption of the preset, with its envelope in the manifest), what fluorescent
and LED lamps send at 940 nm per lux (the tables of CIE 15 end at 780 nm), how white paint or brick reflect
there, and any recording of a robot with its true ranges. Who has such a recording can have it read (*From a
camera of one's own*, recordings), and is asked to tell how far off the ranges were.
"""


def page(witnesses: list[Witness]) -> str:
    """Return the page."""
    rows = [
        f"| {one.what} | {f'{one.bound} ' if one.bound else ''}{one.theirs:.4g} {one.unit} | "
        f"{one.ours:.4g} {one.unit} | {one.verdict} | {one.source} |"
        for one in witnesses
    ]
    return HEAD + "\n".join(rows) + "\n" + TAIL


def witnesses(folder: Path) -> list[Witness]:
    """Return all rows; scenes that they need are written to a folder."""
    return [*sensors(folder), *leds(folder), *filters(), *sun(), *lamps(), *paper()]


def main() -> None:
    """Write the page."""
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(page(witnesses(Path(folder))), encoding="utf-8")


if __name__ == "__main__":
    main()
