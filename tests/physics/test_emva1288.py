"""The standard's own code measures our cameras, from frames made by the code that makes scene frames."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from nir_render.scene.documents.files import preset_names
from nir_render.scene.documents.sensor import Compression, Sensor
from tests.physics.emva import LEVELS, Frame, Sheet, bench_scene, measure

SEEDS = 5
# Of the sheet's figures: relative, or absolute where the unit is named.
TOLERANCES = {
    "system_gain_dn_per_e": 0.003,
    "quantum_efficiency": 0.005,
    "read_noise_e": 0.01,
    "dark_current_e_per_s": 0.02,
    "saturation_capacity_e": 0.01,
    "prnu_percent": 0.02,
    "dsnu_e": 0.03,
}
BLACK_LEVEL_DN = 0.2  # the mean of 640 columns of the pattern is off by up to 0.04 DN (1 σ)
LINEARITY_PERCENT = 0.2


def wrong(sheet: Sheet, sensor: Sensor) -> list[str]:
    """Return which figures of a sheet are not the sensor's."""
    true = {
        "system_gain_dn_per_e": sensor.system_gain_dn_per_e,
        "quantum_efficiency": sensor.quantum_efficiency.constant,
        "read_noise_e": sensor.read_noise_e,
        "dark_current_e_per_s": sensor.dark_current_e_per_s,
        "saturation_capacity_e": sensor.saturation_capacity_e,
        "prnu_percent": 100.0 * sensor.prnu.total,
        "dsnu_e": sensor.dsnu.total_e,
    }
    found = asdict(sheet)
    off = [name for name, share in TOLERANCES.items() if not abs(found[name] / true[name] - 1.0) <= share]
    if abs(sheet.black_level_dn - sensor.black_level_dn) > BLACK_LEVEL_DN:
        off.append("black_level_dn")
    if sheet.linearity_error_percent > LINEARITY_PERCENT:
        off.append("linearity_error_percent")
    return off


def mean_sheet(tmp_path: Path, preset: str, seeds: int) -> tuple[Sheet, Sensor]:
    """Measure as many cameras of a preset, each of its own serial number and seed; return the mean."""
    sheets = []
    for seed in range(seeds):
        scene = bench_scene(tmp_path, preset, serial=f"{preset} {seed}")
        sheets.append(list(asdict(measure(scene, seed)).values()))
    return Sheet(*np.mean(sheets, axis=0).tolist()), scene.camera("eye.c")[1].sensor


def test_a_camera_measures_as_its_preset_says(tmp_path: Path) -> None:
    """One camera of the preset of the paper's rig, measured once; `verify` has all presets, five cameras each."""
    sheet, sensor = mean_sheet(tmp_path, "mt9m031", seeds=1)
    assert wrong(sheet, sensor) == [], sheet


@pytest.mark.verify
@pytest.mark.parametrize("preset", preset_names("sensors"))
def test_every_preset_measures_as_it_says(tmp_path: Path, preset: str) -> None:
    """Five cameras of each preset: gain 0.3 %, quantum efficiency 0.5 %, read noise 1 %, PRNU 2 %, DSNU 3 %,
    dark current 2 %, linearity 0.2 %, saturation capacity 1 %, black level 0.2 DN.

    With 307 200 pixels, 110 pairs and stacks of 32 frames the standard errors of the means are a fifth of
    these or less. Every preset's read noise is above the 0.6 DN below which rounding hides it.
    """
    sheet, sensor = mean_sheet(tmp_path, preset, SEEDS)
    assert sensor.read_noise_e * sensor.system_gain_dn_per_e >= 0.6
    assert wrong(sheet, sensor) == [], sheet


@pytest.mark.verify
def test_faulty_cameras_are_found_out(tmp_path: Path) -> None:
    """Controls: gain off by 2 %, an ADC that truncates, noise of 1 DN added: each must fail, by its figure."""
    scene = bench_scene(tmp_path, "imx273")
    sensor = scene.camera("eye.c")[1].sensor
    gained = bench_scene(
        tmp_path, "imx273", **{"sensor.system_gain": f"{0.98 * sensor.system_gain_dn_per_e} DN/e"}
    )
    assert "system_gain_dn_per_e" in wrong(measure(gained, 0), sensor)

    # A converter that truncates is one that rounds, half a count lower.
    truncating = bench_scene(
        tmp_path, "imx273", **{"sensor.black_level": f"{sensor.black_level_dn - 0.5} DN"}
    )
    assert wrong(measure(truncating, 0), sensor) == ["black_level_dn"]

    def noisy(frame: Frame, number: int) -> Frame:
        noise_dn = np.rint(np.random.default_rng(number).normal(0.0, 1.0, frame.shape))
        return np.clip(frame + noise_dn, 0, sensor.full_scale_dn).astype(np.uint16)

    assert "read_noise_e" in wrong(measure(scene, 0, noisy), sensor)


@pytest.mark.verify
def test_a_soft_non_linearity_measures_as_its_own_curve(tmp_path: Path) -> None:
    """A loss of 1.5 % at the full well: the linearity error is that of the curve, by the standard's own fit, to
    0.1 points, and the saturation capacity stays the sheet's.

    The standard fits a line to the signal over 5 to 95 % of saturation, weighted 1/signal.
    """
    loss = Compression(0.015, 4.0)
    scene = bench_scene(
        tmp_path,
        "imx273",
        **{"sensor.nonlinearity": {"loss": 0.015, "exponent": 4}, "sensor.system_gain": "0.36 DN/e"},
    )
    sensor = scene.camera("eye.c")[1].sensor
    capacity_e = sensor.saturation_capacity_e
    assert capacity_e is not None
    signal_e = LEVELS * capacity_e
    read_e = loss(signal_e, sensor.well_e)
    used = (read_e >= 0.05 * loss(np.array(capacity_e), sensor.well_e)) & (
        read_e <= 0.95 * loss(np.array(capacity_e), sensor.well_e)
    )
    slope, offset = np.polyfit(signal_e[used], read_e[used], 1, w=1.0 / read_e[used])
    own_percent = 100.0 * np.abs(read_e[used] / (slope * signal_e[used] + offset) - 1.0).max()
    assert own_percent > 0.25
    sheet = measure(scene, 0)
    assert sheet.linearity_error_percent == pytest.approx(own_percent, abs=0.1)
    # A bent response shows the standard a gain that is too low and a quantum efficiency that is too high; the
    # photons at which the variance peaks are not touched by that.
    efficiency = sensor.quantum_efficiency.constant
    assert efficiency is not None
    photons = sheet.saturation_capacity_e / sheet.quantum_efficiency
    assert photons == pytest.approx(capacity_e / efficiency, rel=0.01)
