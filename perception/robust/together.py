"""Flares side by side: measured by one fit of all of them, where that explains what is seen."""

from collections.abc import Sequence

import numpy as np

from perception.model.flare import PixelBox
from perception.model.sensor import gain_dn_per_e
from perception.robust.blobs import Blob, divide
from perception.robust.deblend import Flares, Window, asks_for_more, deblend
from perception.robust.fit import core_goodness
from perception.robust.measure import (
    MAX_IMAGE_RADIUS_PX,
    MISFIT_PROBABILITY,
    MODEL_ERROR,
    Candidate,
    Measurement,
    dilated,
    mask_in,
    measure,
    measurement_of,
)
from perception.robust.prepare import PreparedFrame

_FEWEST_DARK_PIXELS = 16


def measure_together(
    candidates: Sequence[Candidate], prepared: PreparedFrame
) -> list[tuple[Blob, Measurement]]:
    """Measure blobs that lie side by side: by one fit of all flares that they hold, where that explains them.

    A blob alone whose own fit leaves nothing over is measured by that. Where flares are clipped, where what
    lies around them is not even (enough flares would explain any texture), or where their joint fit is bad,
    each blob is measured apart. So it is behind a rolling shutter: a drive that switches while rows are read
    leaves a part of one flare, which two flares would explain better.

    Returns
    -------
    A blob and its measurement for each flare.
    """
    apart = [(each.blob, measure(each, prepared)) for each in candidates]
    if any(m.saturated for _, m in apart) or any(c.image_radius_px > MAX_IMAGE_RADIUS_PX for c in candidates):
        return apart
    if prepared.frame.line_time_s > 0.0:
        return apart
    window = _joint_window(candidates, prepared)
    if len(candidates) == 1:
        (_, lone), box = apart[0], window.box
        if lone.expected_e is None or not asks_for_more(window, lone.expected_e, lone.background_e):
            return apart
        assert lone.expected_e.shape == (box.height, box.width)
    if not _stands_on_even_ground(window, prepared):
        return apart
    flares = deblend(
        window, [(m.u_px, m.v_px, max(m.flux_e, 1.0)) for _, m in apart], apart[0][1].background_e
    )
    if flares is None or flares.count == 1 or not _explains(flares, window):
        return apart
    blobs = divide([each.blob for each in candidates], flares.u_px, flares.v_px)
    return [(blob, _from_joint_fit(flares, index, prepared)) for index, blob in enumerate(blobs)]


def _joint_window(candidates: Sequence[Candidate], prepared: PreparedFrame) -> Window:
    """Return the window that holds those of all candidates; lit pixels of others do not count."""
    windows = [each.window for each in candidates]
    top, left = min(w.top for w in windows), min(w.left for w in windows)
    bottom, right = max(w.top + w.height for w in windows), max(w.left + w.width for w in windows)
    box = PixelBox(top, left, bottom - top, right - left)
    own = np.any([mask_in(box, each.blob) for each in candidates], axis=0)
    others = dilated(np.asarray(prepared.lit[box.slices] & ~own), 2)
    return Window(
        box=box,
        image_e=prepared.image_e[box.slices].astype(np.float64),
        usable=~others,
        frame=prepared.frame,
        calibration=prepared.calibration,
        max_image_radius_px=1.6 * MAX_IMAGE_RADIUS_PX,
    )


def _stands_on_even_ground(window: Window, prepared: PreparedFrame) -> bool:
    """Tell whether the unlit pixels of a window scatter about their mean as noise does: χ², to 10⁻⁶."""
    from scipy.special import chdtrc

    dark = window.usable & ~dilated(np.asarray(prepared.lit[window.box.slices]), 2)
    pixels = int(dark.sum())
    if pixels < _FEWEST_DARK_PIXELS:
        return False
    level_e = window.image_e[dark]
    variance = max(float(level_e.mean()), 0.0) + prepared.floor_e2
    chi2 = float(np.sum((level_e - level_e.mean()) ** 2)) / variance
    return float(chdtrc(pixels - 1, chi2)) >= MISFIT_PROBABILITY


def _explains(flares: Flares, window: Window) -> bool:
    """Tell whether a joint fit leaves no more than noise and an imperfect model do."""
    good = core_goodness(
        window.image_e, flares.expected_e, flares.background_e, window.usable, window.floor_e2, MODEL_ERROR
    )
    return good.probability >= MISFIT_PROBABILITY


def _from_joint_fit(flares: Flares, index: int, prepared: PreparedFrame) -> Measurement:
    u_sigma_px, v_sigma_px, log_flux_sigma = flares.sigmas(index)
    flux_e = float(flares.flux_e[index])
    sigma_e = log_flux_sigma * flux_e
    return measurement_of(
        (float(flares.u_px[index]), float(flares.v_px[index])),
        (u_sigma_px, v_sigma_px),
        (flux_e, sigma_e, flares.background_e),
        sigma_e * gain_dn_per_e(prepared.frame, prepared.calibration),
        prepared,
    )
