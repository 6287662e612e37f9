"""Sun and sky behind air: ASTM G173's table, SPECTRL2 as it comes, and where the sun stands."""

import math
from datetime import datetime
from typing import Any

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.scene.emission import emission_spectrum, emission_units
from nir_render.scene.load import load_scene
from nir_render.scene.scene import Scene
from nir_render.spectra import sunlight as module
from nir_render.spectra.curve import Curve
from nir_render.spectra.sunlight import Column, sun_position, sunlight
from tests.paths import SCENES

ZENITH_RAD, TILT_RAD, OFF_TILTED_RAD = math.radians(48.19), math.radians(37.0), math.radians(11.19)
G173 = Column(0.014164, 0.003438, 0.084, 0.0, 0.3)
AIR = {"azimuth": "30 deg", "elevation": "41.81 deg", "air": "g173"}
BANDS = [(935.0, 945.0), (845.0, 855.0)]


@pytest.fixture
def pvlib() -> Any:
    return pytest.importorskip("pvlib", reason="pvlib is not installed: pip install 'nir-render[sun]'")


def _band(curve: Curve, band_nm: tuple[float, float]) -> float:
    wavelength_m = np.linspace(*band_nm, 4001) * 1e-9
    return float(np.trapezoid(curve(wavelength_m), wavelength_m))


def _tabulated(pvlib: Any, column: str, band_nm: tuple[float, float]) -> float:
    """Return the integral of a column of G173's table; its steps are 1 nm there."""
    table = pvlib.spectrum.get_reference_spectra(standard="ASTM G173-03")
    rows = table.loc[band_nm[0] : band_nm[1], column].to_numpy()
    return float(np.trapezoid(rows, dx=1.0))


@pytest.mark.parametrize("band_nm", BANDS)
def test_g173_is_met_at_its_conditions(pvlib: Any, band_nm: tuple[float, float]) -> None:
    """Straight, and on the table's plane tilted by 37°, sky and ground in it: within 2 %.

    The tilted plane is Hay and Davies's: of the sky the share that straight light keeps of its own comes from
    the sun's place, the rest evenly; the ground reflects 0.3. A regression for the straight light about 940 nm,
    which is built on the table.
    """
    light = sunlight(G173, 0.5 * math.pi - ZENITH_RAD, None)
    direct, diffuse = _band(light.direct, band_nm), _band(light.diffuse, band_nm)
    assert direct == pytest.approx(_tabulated(pvlib, "direct", band_nm), rel=0.02)
    anisotropy = direct / _tabulated(pvlib, "extraterrestrial", band_nm)
    seen = anisotropy * math.cos(OFF_TILTED_RAD) / math.cos(ZENITH_RAD)
    seen += (1.0 - anisotropy) * 0.5 * (1.0 + math.cos(TILT_RAD))
    ground = 0.3 * (direct * math.cos(ZENITH_RAD) + diffuse) * 0.5 * (1.0 - math.cos(TILT_RAD))
    tilted = direct * math.cos(OFF_TILTED_RAD) + diffuse * seen + ground
    assert tilted == pytest.approx(_tabulated(pvlib, "global", band_nm), rel=0.02)


@pytest.mark.parametrize(
    ("water_cm", "share_940", "share_850"),
    [(0.5, 0.925, 1.0), (1.0, 0.889, 1.0), (2.0, 0.850, 1.0), (3.0, 0.829, 1.0), (5.0, 0.811, 1.0)],
)
def test_against_spectrl2_as_it_comes(
    pvlib: Any, water_cm: float, share_940: float, share_850: float
) -> None:
    """Straight light over SPECTRL2's: the same from 845 to 855 nm; from 935 to 945 nm 7 to 19 % less, with water.

    The stated difference: SPECTRL2's nodes at 930, 937 and 948 nm are too bright at any water.
    """
    column = Column(water_cm / 100.0, 0.003438, 0.084, 0.0, 0.3)
    light = sunlight(column, 0.5 * math.pi - ZENITH_RAD, None)
    air_mass = float(pvlib.atmosphere.get_relative_airmass(48.19))
    bird = pvlib.spectrum.spectrl2(
        apparent_zenith=48.19, aoi=0.0, surface_tilt=48.19, ground_albedo=0.3, surface_pressure=101325.0,
        relative_airmass=air_mass, precipitable_water=water_cm, ozone=0.3438, aerosol_turbidity_500nm=0.084, dayofyear=94,
    )  # fmt: skip
    distance = float(pvlib.irradiance.get_extra_radiation(94, method="spencer", solar_constant=1.0))
    theirs = Curve(bird["wavelength"] * 1e-9, bird["dni"].ravel() * 1e9 / distance, "SPECTRL2")
    assert _band(light.direct, BANDS[0]) / _band(theirs, BANDS[0]) == pytest.approx(share_940, abs=0.006)
    assert _band(light.direct, BANDS[1]) / _band(theirs, BANDS[1]) == pytest.approx(share_850, abs=0.001)


def test_a_scene_s_sun_and_sky_carry_these_irradiances(pvlib: Any) -> None:
    """Units × spectrum give G173's W/m², clouds take their share; the day sets the distance, ±3.3 %."""
    scene = _scene(sun=AIR, sky={"cie": 12})
    light = sunlight(G173, math.radians(41.81), None)
    sun, sky = (scene.emitters()[name] for name in ("sun", "sky"))
    for emitter, curve in ((sun, light.direct), (sky, light.diffuse)):
        spectrum = emission_spectrum(emitter)
        assert spectrum.integral() == pytest.approx(1.0, rel=1e-12)
        assert emission_units(emitter) * _band(spectrum, BANDS[0]) == pytest.approx(
            _band(curve, BANDS[0]), rel=1e-9
        )
    veiled = _scene(sun={**AIR, "clouds": 0.25}, sky={"cie": 8, "clouds": 1.5}).emitters()
    assert emission_units(veiled["sun"]) == pytest.approx(0.25 * emission_units(sun), rel=1e-12)
    assert emission_units(veiled["sky"]) == pytest.approx(1.5 * emission_units(sky), rel=1e-12)
    january, july = (_scene(sun={**AIR, "day_of_year": day}).emitters()["sun"] for day in (3, 185))
    # The orbit's eccentricity, 0.0167: ((1 + e) / (1 − e))².
    assert emission_units(january) / emission_units(july) == pytest.approx((1.0167 / 0.9833) ** 2, rel=0.002)


def test_the_sun_stands_where_an_almanac_has_it(pvlib: Any) -> None:
    """At noon of the June solstice 23.44° north of the equator's zenith; at an equinox in the east at six."""
    noon = sun_position(math.radians(51.0), 0.0, datetime.fromisoformat("2026-06-21T12:02:00+00:00"))
    assert math.degrees(noon.elevation_rad) == pytest.approx(90.0 - 51.0 + 23.44, abs=0.05)
    assert math.degrees(noon.from_north_rad) == pytest.approx(180.0, abs=0.5)
    dawn = {
        "place": {"latitude": "0 deg", "longitude": "0 deg"},
        "time": "2026-03-20T08:07:00+00:00",
        "air": "g173",
    }
    sun = _scene(sun=dawn).document.sun
    assert sun is not None
    east, north, up = sun.direction
    assert east > 0.8
    assert abs(north) < 0.01
    assert up == pytest.approx(0.5, abs=0.02)
    turned = _scene(sun={**dawn, "place": {**dawn["place"], "north": "0 deg"}}).document.sun  # type: ignore[dict-item]
    assert turned is not None
    assert turned.direction == pytest.approx((north, -east, up), abs=1e-9)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"sun": {"azimuth": "0 deg", "elevation": "9 deg"}}, "wanted one of 'irradiance'"),
    ({"sun": {**AIR, "irradiance": "0.3 W/m^2/nm"}}, "wanted one of 'irradiance'"),
    ({"sun": {"place": {"latitude": "9 deg", "longitude": "0 deg"}, "air": "g173"}}, "'place' and 'time' go together"),
    ({"sun": {**AIR, "place": {"latitude": "9 deg", "longitude": "0 deg"}, "time": "2026-01-01T00:00Z"}}, "follows from"),
    ({"sky": {"cie": 12}}, "sky: its light follows from the sun's place"),
    ({"sun": {"azimuth": "0 deg", "elevation": "9 deg", "irradiance": "0.3 W/m^2/nm"}, "sky": {}}, "sky: its light follows"),
    ({"sun": AIR, "sky": {"cie": 16}}, "less than or equal to 15"),
    ({"sun": AIR, "sky": {}, "fog": {"extinction": "0.1 /m"}}, "the sun is black; give it a 'top'"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "told"), REFUSED)
def test_what_has_no_light_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        _scene(**changes)


def test_night_and_times_without_a_zone_are_refused(pvlib: Any) -> None:
    place = {"latitude": "51 deg", "longitude": "4 deg"}
    with pytest.raises(InputError, match="below the horizon there"):
        _scene(sun={"place": place, "time": "2026-01-01T00:00:00+00:00", "air": "g173"})
    with pytest.raises(InputError, match="names no time zone"):
        _scene(sun={"place": place, "time": "2026-01-01T12:00:00", "air": "g173"})


def test_without_pvlib_a_scene_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene with air loads and can be looked through; only its light needs pvlib."""
    monkeypatch.setitem(__import__("sys").modules, "pvlib", None)
    module.sunlight.cache_clear()
    scene = load_scene(SCENES / "sunlit_yard.yaml")
    with pytest.raises(InputError, match=r"pip install 'nir-render\[sun\]'"):
        emission_units(scene.emitters()["sun"])


def _scene(**changes: Any) -> Scene:
    return load_scene(SCENES / "one_source.yaml").with_(changes)
