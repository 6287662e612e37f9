"""The table that `calibrate` shows in the terminal."""

import math

from rich.table import Table

from nir_render.calibrate_run import CameraCalibration
from perception.rail_result import IDEAL_MAE, HeldOut


def calibration_table(name: str, camera: CameraCalibration) -> Table:
    """Return a table of one camera's calibration: the flux, and the paper's mean grey beside it."""
    result, fit, paper = camera.result, camera.result.fit, camera.result.paper
    table = Table(
        title=f"{name}: {result.places_fitted} ranges fitted, {result.places_held_out} held out",
        title_justify="left",
    )
    for heading in ("", "robust: flux", "paper: mean grey"):
        table.add_column(heading, justify="right" if heading else "left")

    constant = _with_sigma(fit.range_constant_dn_m2_per_s, fit.range_constant_sigma_dn_m2_per_s)
    slope = _with_sigma(fit.slope_dn_m2_per_s, fit.slope_sigma_dn_m2_per_s)
    intercept = _with_sigma(fit.intercept_dn_per_s, fit.intercept_sigma_dn_per_s)
    paper_slope = paper_intercept = "–"
    if paper is not None:
        paper_slope = _with_sigma(paper.slope_dn_m2_per_s, paper.slope_sigma_dn_m2_per_s)
        paper_intercept = _with_sigma(paper.intercept_dn_per_s, paper.intercept_sigma_dn_per_s)
    table.add_row("K through the origin, DN m²/s", constant, "")
    if camera.fitted_to_true is not None:
        table.add_row("  over the true K − 1", f"{camera.fitted_to_true:+.3%}", "")
    table.add_row("slope with intercept, DN m²/s", slope, paper_slope)
    table.add_row("intercept, DN/s", intercept, paper_intercept)
    table.add_row("reduced χ² (probability)", f"{fit.reduced_chi2:.3f} ({fit.chi2_probability:.2g})", "")
    table.add_section()
    robust, by_paper = result.robust, result.paper_held_out
    frames = result.frames_held_out
    table.add_row("held out: found", f"{robust.found} of {frames}", f"{by_paper.found} of {frames}")
    for label, field, form in (
        ("  range MAE, m", "range_mae_m", "{:.4f}"),
        ("  range RMSE, m", "range_rmse_m", "{:.4f}"),
        ("  range bias, m", "range_bias_m", "{:+.4f}"),
        ("  reduced χ² of the errors", "reduced_chi2", "{:.3f}"),
    ):
        table.add_row(label, _cell(robust, field, form), _cell(by_paper, field, form))
    table.caption = (
        "The intercept is zero within 3 σ: K is that of the line through the origin.\n"
        if fit.intercept_is_zero
        else "The intercept is not zero: the flux does not follow 1/d² here.\n"
    ) + (
        f"Limit: mean Cramér–Rao σ {result.range_limit_m:.4f} m, "
        f"so an ideal MAE of {IDEAL_MAE * result.range_limit_m:.4f} m."
    )
    table.caption_justify = "left"
    return table


def _cell(held_out: HeldOut, field: str, form: str) -> str:
    value = getattr(held_out, field)
    return form.format(value) if math.isfinite(value) else "–"


def _with_sigma(value: float, sigma: float) -> str:
    """Write both to the sigma's second digit, in one power of ten: (1.2345 ± 0.0012)e+08."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.5g}"
    power = math.floor(math.log10(max(abs(value), sigma)))
    digits = max(0, power - math.floor(math.log10(sigma)) + 1)
    return f"({value / 10**power:.{digits}f} ± {sigma / 10**power:.{digits}f})e{power}"
