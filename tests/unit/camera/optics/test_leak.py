"""Light out of band against integrals by hand, and what is known of it where data end."""

from typing import Any

import numpy as np
import pytest
from scipy import constants

import nir_render as nr
from nir_render.camera.optics.leak import Leak, leak
from nir_render.camera.optics.response import response
from nir_render.scene.documents.files import preset_names
from nir_render.spectra.illuminants import sunlight_ceiling
from tests.paths import SCENES

FRONT = "robots.r1.rig.cameras.front"
FILTER = {
    "placement": "in_front_of_lens", "centre": "940 nm", "fwhm": "10 nm", "peak_transmission": 0.9,
    "effective_index": 2.0, "blocking_od": 4.0, "cavities": 6,
}  # fmt: skip
MEASURED: list[tuple[str, float]] = [
    ("300 nm", 0.3),
    ("525 nm", 0.76),
    ("850 nm", 0.2),
    ("940 nm", 0.077),
    ("1100 nm", 0.0),
]

ENVELOPE = {
    "low": {"points": [["300 nm", 0.1], ["1100 nm", 0.1]]},
    "high": {"points": [["300 nm", 0.3], ["1100 nm", 0.3]]},
}


def scene(**changes: Any) -> nr.Scene:
    known = {
        f"{FRONT}.filter": FILTER,
        "lamps": {"lamp": {"preset": "halogen", "center": "[3, 0, 2] m"}},
        "sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"},
    }
    sensor = {f"{FRONT}.sensor.{key}": value for key, value in changes.items()}
    return nr.load_scene(SCENES / "one_source.yaml", known | sensor)


def seen(of: nr.Scene, emitter: str) -> Leak:
    return leak(of.camera("r1.front")[1], of.emitters()[emitter])


def by_hand_e_per_j(density: Any, efficiency: Any, floor: float = 1e-4) -> float:
    """Beyond 1 % of the peak of six cavities, or the floor: ∫ S T η λ/hc over 300 to 1100 nm."""
    nm = np.linspace(300.0, 1100.0, 800_001)
    shape = density(nm)
    shape = shape / np.trapezoid(shape, nm)
    detuning = np.abs(nm - 940.0) / 5.0
    passed = np.maximum(0.9 / (1.0 + detuning**12), floor) * (detuning > 99.0 ** (1.0 / 12.0))
    return (
        0.9
        * float(np.trapezoid(shape * efficiency(nm) * passed * nm * 1e-9, nm))
        / (constants.h * constants.c)
    )


def planck(nm: Any) -> Any:
    return nm**-5.0 / np.expm1(constants.h * constants.c / (constants.k * 2856.0 * nm * 1e-9))


@pytest.mark.parametrize(("emitter", "density"), [("lamps.lamp", planck), ("sun", np.ones_like)])
def test_the_leak_of_lamp_and_sun_is_the_integral_over_all_that_silicon_sees(
    emitter: str, density: Any
) -> None:
    places, values = [float(point[0][:-3]) for point in MEASURED], [point[1] for point in MEASURED]

    def efficiency(nm: Any) -> Any:
        return np.interp(nm, places, values)

    found = seen(scene(quantum_efficiency={"points": MEASURED}, efficiency_envelope=None), emitter)
    assert found.out_of_band_e_per_j == pytest.approx(by_hand_e_per_j(density, efficiency), rel=2e-4)
    if emitter != "sun":  # of this one the spectrum too lies between bounds
        assert found.high_e_per_j == pytest.approx(found.out_of_band_e_per_j, rel=1e-9)
        assert found.low_e_per_j == pytest.approx(by_hand_e_per_j(density, efficiency, floor=0.0), rel=2e-3)
    whole = found.in_band_e_per_j + found.out_of_band_e_per_j
    camera = scene(quantum_efficiency={"points": MEASURED}, efficiency_envelope=None).camera("r1.front")[1]
    assert whole == pytest.approx(float(response(camera, scene().emitters()[emitter])(0.0)), rel=1e-4)


def test_a_sun_known_at_940_nm_leaks_between_nothing_and_all_that_the_sun_sends() -> None:
    """1.25 times a black body of 5772 K of the sun's size, which ASTM G173's sun, above and below the air, keeps to."""
    pvlib = pytest.importorskip("pvlib", reason="pvlib is not installed: pip install 'nir-render[sun]'")
    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03").loc[300.0:1100.0]
    ceiling = sunlight_ceiling(table.index.to_numpy() * 1e-9) * 1e-9
    assert (table["extraterrestrial"].to_numpy() < ceiling).all()
    assert ceiling.max() < 1.25 * table["extraterrestrial"].max()
    even = {"points": [["300 nm", 0.15], ["1100 nm", 0.15]]}
    flat = scene(quantum_efficiency=even, efficiency_envelope=None)
    found = seen(flat, "sun")
    real = seen(flat.with_({"sun.irradiance": None, "sun.air": "g173"}), "sun")
    share = real.out_of_band_e_per_j / real.in_band_e_per_j
    assert found.low_e_per_j == 0.0
    assert 1.5 * found.out_of_band_e_per_j < share * found.in_band_e_per_j < 0.7 * found.high_e_per_j

    def most(nm: Any) -> Any:
        """W/m²/nm: π B(5772 K) sin² of the sun's radius."""
        hot = np.expm1(constants.h * constants.c / (constants.k * 5772.0 * nm * 1e-9))
        exitance = 2.0 * np.pi * constants.h * constants.c**2 / ((nm * 1e-9) ** 5 * hot)
        return 1.25 * 1e-9 * exitance * np.sin(np.radians(0.2666)) ** 2

    nm = np.linspace(300.0, 1100.0, 80_001)
    sent = float(np.trapezoid(most(nm), nm)) / (0.305 * 800.0)
    by_hand = sent * by_hand_e_per_j(most, lambda nm: np.full_like(nm, 0.15))
    assert found.high_e_per_j == pytest.approx(by_hand, rel=2e-3)


def test_one_flat_number_understates_the_leak_that_its_envelope_allows() -> None:
    """IMX428: 7.7 % at 940 nm and 76 % at 525 nm. Flat, the leak of a lamp is several times too small."""
    of = scene(preset="imx420")
    for emitter, least in (("lamps.lamp", 2.5), ("sun", 3.0)):
        found = seen(of, emitter)
        assert found.low_e_per_j < found.out_of_band_e_per_j < found.high_e_per_j
        assert found.high_e_per_j > least * found.out_of_band_e_per_j


@pytest.mark.parametrize("sensor", preset_names("sensors"))
def test_frames_of_either_end_of_the_envelope_leak_what_the_interval_says(sensor: str) -> None:
    """The interval's ends, less the floor at its low end, are what frames made with these ends hold."""
    known = seen(scene(preset=sensor), "lamps.lamp")
    high = seen(scene(preset=sensor, efficiency_taken="high"), "lamps.lamp")
    low = seen(scene(preset=sensor, efficiency_taken="low"), "lamps.lamp")
    assert high.out_of_band_e_per_j == pytest.approx(known.high_e_per_j, rel=1e-9)
    assert known.low_e_per_j < low.out_of_band_e_per_j < high.out_of_band_e_per_j


def test_where_a_table_ends_the_leak_is_an_interval() -> None:
    """A curve from 800 to 1000 nm: beyond it between nothing and every photon that the filter's floor lets through."""
    short = {"points": [["800 nm", 0.3], ["1000 nm", 0.1]]}
    found = seen(scene(quantum_efficiency=short, efficiency_envelope=None), "lamps.lamp")

    def most(nm: Any) -> Any:
        return np.where((nm >= 800) & (nm <= 1000), np.interp(nm, [800, 1000], [0.3, 0.1]), 1.0)

    def least(nm: Any) -> Any:
        return np.where((nm >= 800) & (nm <= 1000), np.interp(nm, [800, 1000], [0.3, 0.1]), 0.0)

    # The table's ends are jumps, each known to half a step of 0.1 nm: 0.3 · 0.05 nm of 200 nm at 0.2.
    assert found.high_e_per_j == pytest.approx(by_hand_e_per_j(planck, most), rel=1e-3)
    assert found.out_of_band_e_per_j == pytest.approx(by_hand_e_per_j(planck, least), rel=1e-3)
    assert found.low_e_per_j == pytest.approx(by_hand_e_per_j(planck, least, floor=0.0), rel=2e-3)


def test_without_a_filter_all_must_be_known() -> None:
    short = {"points": [["800 nm", 0.3], ["1000 nm", 0.1]]}
    with pytest.raises(nr.InputError, match=r"covers 800 to 1000 nm, but .* shines from"):
        scene(quantum_efficiency=short, efficiency_envelope=None).with_({f"{FRONT}.filter": None})
    with pytest.raises(nr.InputError, match="or for all that the filter passes"):
        scene(quantum_efficiency={"points": [["900 nm", 0.3], ["945 nm", 0.1]]}, efficiency_envelope=None)
    table = {"points": [["900 nm", 0.0], ["940 nm", 0.9], ["980 nm", 0.0]]}
    unknown = {"placement": "in_front_of_lens", "effective_index": 2.0, "table": table}
    with pytest.raises(nr.InputError, match=r"filter\.table: covers 900 to 980 nm, but .* 'blocking_od'"):
        scene().with_({f"{FRONT}.filter": {**unknown, "preset": "bp940_10nm_behind", "blocking_od": None}})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"quantum_efficiency": 0.5, "efficiency_envelope": ENVELOPE},
            "0.5 at 940 nm lies outside of efficiency_envelope, 0.1 to 0.3",
        ),
        ({"efficiency_envelope": None, "efficiency_taken": "low"}, "there is no 'efficiency_envelope'"),
        ({"efficiency_envelope": {"low": 0.1, "high": 0.2}}, "wanted 'points' or 'file' for both"),
        (
            {
                "efficiency_envelope": {
                    "low": {"points": [["300 nm", 0.5], ["1100 nm", 0.3]]},
                    "high": {"points": [["300 nm", 0.2], ["1100 nm", 0.4]]},
                }
            },
            "'low' is above 'high' at 300 nm",
        ),
    ],
)
def test_envelopes_without_sense_are_refused(changes: Any, said: str) -> None:
    with pytest.raises(nr.InputError, match=said):
        scene(**changes)


def test_every_sensor_preset_says_what_is_known_over_all_of_silicon() -> None:
    for name in preset_names("sensors"):
        sensor = scene(preset=name).camera("r1.front")[1].sensor
        assert sensor.efficiency_envelope is not None
        low, high = sensor.efficiency_bounds(np.linspace(300e-9, 1100e-9, 801))
        assert (low <= high).all()
        assert high.max() < 1.0
