"""Perception against its reference: the reference's frames and calibration to detections."""

import math
from collections.abc import Sequence
from dataclasses import fields

from nir_render.regress.findings import Finding
from perception.types import Detection

# The robust fit ends when its next step is below 0.01 of its own σ and its flux fits its size to 0.02 of it:
# rounding may take one step more or less, and so move the result by the sum.
_OF_SIGMA = 0.03
# What is not iterated is float64 arithmetic on whole counts.
_ROUNDING = 1e-6
_WHOLE = ("camera", "index", "area_px", "saturated", "merged", "ghost")


def compare_detections(
    name: str, before: Sequence[Detection], after: Sequence[Detection], *, exact: bool
) -> Finding:
    """Compare what an estimator finds in the reference's frames with what it found."""
    same_bits = repr(list(before)) == repr(list(after))  # NaN is not equal to itself, but reads the same
    seen, fails = "equal", exact and not same_bits
    if len(before) != len(after):
        seen, fails = f"{len(before)} → {len(after)} detections", True
    else:
        found = [_excess(one, other) for one, other in zip(before, after, strict=True)]
        worst, said = max(found, default=(0.0, ""))
        if worst > 0.0:
            seen, fails = said, fails or worst > 1.0
    return Finding(
        "perception",
        name,
        "fail" if fails else "pass",
        f"{len(after)} detections, equal" if seen == "equal" else seen,
        f"{_OF_SIGMA:g} of a claimed σ, else {_ROUNDING:.0e}",
        same_bits=same_bits,
    )


def _excess(before: Detection, after: Detection) -> tuple[float, str]:
    """Return the largest difference of two detections in units of what is allowed, and say it."""
    worst, said = 0.0, ""
    where = f"frame {before.camera} {before.index}, at u {before.u_px:.1f}, v {before.v_px:.1f}"
    for field in fields(Detection):
        one, other = getattr(before, field.name), getattr(after, field.name)
        if field.name in _WHOLE:
            excess = 0.0 if one == other else math.inf
        else:
            pairs = zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]
            allowed = _allowed(before, field.name)
            excess = max(_difference(*pair) / allowed for pair in pairs)
        if excess > worst:
            worst, said = excess, f"{where}: {field.name} {_short(one)} → {_short(other)}"
    return worst, said


def _allowed(found: Detection, field: str) -> float:
    """Return how much a number of a detection may differ."""
    value = getattr(found, field)
    size = max((abs(part) for part in (value if isinstance(value, tuple) else (value,))), default=0.0)
    plain = _ROUNDING * max(size if math.isfinite(size) else 0.0, 1.0)
    # σ_d / d is half of σ_F / F; directions turn with the place in the image, and σ with all of them.
    relative = found.range_sigma_m / found.range_m if found.range_m else math.nan
    claimed = {
        "u_px": found.u_sigma_px,
        "v_px": found.v_sigma_px,
        "range_m": found.range_sigma_m,
        "flux_dn": 2.0 * relative * found.flux_dn,
        "range_sigma_m": found.range_sigma_m,
        "u_sigma_px": found.u_sigma_px,
        "v_sigma_px": found.v_sigma_px,
        "background_dn": 1.0,
        # A pixel is at most a tenth of a radian, and for small angles that much.
        "bearing_body": 0.1 * math.hypot(found.u_sigma_px, found.v_sigma_px),
    }.get(field, math.nan)
    of_fit = math.isfinite(found.u_sigma_px) and math.isfinite(claimed)
    return max(plain, _OF_SIGMA * claimed) if of_fit else plain


def _difference(one: float, other: float) -> float:
    if math.isnan(one) or math.isnan(other):
        return 0.0 if math.isnan(one) and math.isnan(other) else math.inf
    return abs(other - one)


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
