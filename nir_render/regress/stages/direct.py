"""The direct table against its reference: closed form, so it agrees to rounding, and to rays at edges."""

from typing import Any

import numpy as np

from nir_render.light.light import DirectTable, Light
from nir_render.regress.findings import Finding, percent

# Angles and distances are float64 arithmetic; libraries differ in the last digits.
_ROUNDING = 1e-9
# Visibility is traced in float32. A hit at d metres is off by about 8 roundings of its coordinates, so an
# edge moves by 8 · 2⁻²⁴ (d + |camera|) / d, seen from the lens; taken as 2e-6 rad.
_EDGE_RAD = 2e-6

Key = tuple[str, str]


def compare_tables(before: Light, after: Light, label: str, *, exact: bool) -> Finding:
    """Compare the direct tables of two lights of the same camera and geometry."""
    what = f"{label}direct table"
    old, new = _rows(before), _rows(after)
    worst, seen = 0.0, "equal"
    for key in sorted(old.keys() | new.keys()):
        name = " in ".join(filter(None, key))
        if key not in old or key not in new:
            table, row = (before.direct, old[key]) if key in old else (after.direct, new[key])
            excess = int(np.count_nonzero(table.seen[row])) / _allowed_rays(table, row)
            said = f"{name} is {'gone' if key in old else 'new'}"
        else:
            excess, said = _largest_excess(before.direct, old[key], after.direct, new[key], name)
        if excess > worst:
            worst, seen = excess, said
    same_bits = _same_bits(before.direct, after.direct)
    return Finding(
        "transport",
        what,
        "fail" if worst > 1.0 or (exact and not same_bits) else "pass",
        seen,
        _detectable(before.direct),
        same_bits=same_bits,
    )


def allowed_flips(angular_radius_rad: float, rays: int) -> int:
    """Return how many of the rays over a disc may end on the other side of an edge.

    An edge across the middle has 4 ε / (π α) of the disc within ε of it. To that mean, Poisson's scatter and
    two rays, for a mean far below one still gives one now and then.
    """
    mean = rays * 4.0 / np.pi * min(_EDGE_RAD / max(angular_radius_rad, 1e-9), 1.0)
    return 2 + int(np.ceil(mean + 5.0 * np.sqrt(mean)))


def _allowed_rays(table: DirectTable, row: int) -> int:
    return allowed_flips(float(table.angular_radius_rad[row]), table.visibility_rays)


def _irradiance_of_a_ray(table: DirectTable, row: int) -> float:
    """Return the share of a row's irradiance that a ray over its disc may bring.

    It depends on where the ray leaves; for smooth patterns it is below twice the mean.
    """
    return 2.0 / (
        table.visibility_rays * max(float(table.visible_fraction[row]), 1.0 / table.visibility_rays)
    )


def _detectable(table: DirectTable) -> str:
    rows = range(len(table.group))
    if not rows:
        return f"{_ROUNDING:.0e}"
    rays = max(_allowed_rays(table, row) for row in rows)
    share = max(_irradiance_of_a_ray(table, row) for row in rows)
    return (
        f"{_ROUNDING:.0e}, or {rays + 1} rays of a disc; its irradiance: {percent(share)} a ray that differs"
    )


def _rows(light: Light) -> dict[Key, int]:
    table = light.direct
    return {
        (light.groups[group], light.mirrors[facet] if facet >= 0 else ""): row
        for row, (group, facet) in enumerate(zip(table.group, table.facet, strict=True))
    }


def _largest_excess(old: DirectTable, i: int, new: DirectTable, j: int, name: str) -> tuple[float, str]:
    """Return the largest difference of two rows in units of what is allowed, and say it."""
    # Both look along the same rays: those that end elsewhere now are known one by one.
    alike = old.visibility_rays == new.visibility_rays
    rays = np.count_nonzero(old.seen[i] != new.seen[j]) if alike else np.inf
    fractions = float(old.visible_fraction[i]), float(new.visible_fraction[j])
    before, after = old.irradiance_per_w[i], new.irradiance_per_w[j]
    allowed = _ROUNDING + rays * _irradiance_of_a_ray(old, i)
    # Of the larger one: a ray or two may be the first that arrive.
    changed = float(
        np.max(np.abs(after - before) / np.maximum(np.maximum(before, after), 1e-300), initial=0.0)
    )
    moved_rad = float(np.linalg.norm(old.direction[i] - new.direction[j]))
    dimmed = float(after.sum() / before.sum() - 1.0) if before.sum() else np.inf
    sizes_rad = old.angular_radius_rad[i], new.angular_radius_rad[j]
    distances_m = old.distance_m[i], new.distance_m[j]
    found = [
        (moved_rad / _ROUNDING, f"moved by {moved_rad:.2g} rad"),
        (_relative(*distances_m) / _ROUNDING, "from {:.6g} to {:.6g} m".format(*distances_m)),
        (_relative(*sizes_rad) / _ROUNDING, "from {:.6g} to {:.6g} rad in radius".format(*sizes_rad)),
        (
            rays / _allowed_rays(old, i),
            f"{rays:.0f} rays differ, seen of it {fractions[0]:.4f}, now {fractions[1]:.4f}",
        ),
        (changed / allowed, f"irradiance {percent(dimmed, signed=True)}"),
    ]
    worst, said = max(found)
    return worst, f"{name}: {said}"


def _relative(before: Any, after: Any) -> float:
    """Return the largest relative difference; infinite values that are equal differ by nothing."""
    one, other = np.atleast_1d(before), np.atleast_1d(after)
    unlike = one != other
    one, other = one[unlike], other[unlike]
    return float(np.max(np.abs(other - one) / np.maximum(np.abs(one), 1e-300), initial=0.0))


def _same_bits(one: DirectTable, other: DirectTable) -> bool:
    fields = ("group", "facet", "direction", "distance_m", "seen", "irradiance_per_w")
    return all(np.array_equal(getattr(one, field), getattr(other, field)) for field in fields)
