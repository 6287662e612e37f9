"""The tables of a budget, as text: the terminal and the page show the same."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from nir_render.budget.budget import Budget, CameraBudget, SourceBudget
from nir_render.budget.curves import Curve
from nir_render.budget.eye_safety import EyeSafety
from nir_render.budget.flares import Saturation
from nir_render.report.parts import Table
from nir_render.report.wording import degrees, metres, share, significant, times

GROUPS: Mapping[str, tuple[str, ...]] = {
    "shot noise of its own light": ("own_light_m",),
    "shot noise of the background": ("background_m",),
    "shot noise of dark current": ("dark_current_m",),
    "unequal pixels": ("prnu_m",),
    "read-out": ("read_noise_m", "dsnu_m", "rounding_m"),
    "calibration": ("range_constant_m", "source_radius_m", "point_spread_m"),
    "LED temperature": ("led_temperature_m",),
    "LED to LED": ("unit_spread_m",),
    "field angle": ("field_angle_m",),
    "fog": ("fog_m",),
}
"""Causes of a range's σ as tables and plots name them; the first six are the limit."""

LOBE = 1.05  # of the largest intensity over the mean: what has more is told apart

SHOWN_M = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
BUDGET_SHOWN_M = (1.0, 3.0, 10.0)


def alike(names: Sequence[str]) -> str:
    """Write the names of what is alike: the first, and how many more."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} alike"


def grouped(curve: Curve, index: int) -> dict[str, float]:
    """Return the causes of one range's σ by `GROUPS`, in metres, those that are there."""
    found = {}
    for name, causes in GROUPS.items():
        values = [curve.causes_m[cause][index] for cause in causes if cause in curve.causes_m]
        known = [value for value in values if value is not None]
        if known:
            found[name] = math.hypot(*known)
    return found


def range_table(curve: Curve) -> Table:
    """Return electrons, limit and σ against range."""
    rows = []
    for index, range_m in enumerate(curve.range_m):
        if range_m not in SHOWN_M:
            continue
        causes = grouped(curve, index)
        worst = max(causes, key=lambda name: causes[name]) if causes else "no range"
        rows.append(
            (
                f"{range_m:g} m",
                f"{1e3 * curve.exposure_s[index]:.3g} ms",
                electrons(curve.electrons_e[index]),
                electrons(curve.brightest_pixel_e[index]) + (" clips" if curve.saturated[index] else ""),
                small(curve.range_limit_m[index]),
                small(curve.range_sigma_m[index]),
                worst,
            )
        )
    return Table(("range", "exposure", "electrons", "peak px", "limit σ", "σ in all", "most of it"), rows)


def cause_table(curves: Sequence[Curve]) -> Table:
    """Return the σ of ranges by cause: a row for each, a column for each place and range."""
    columns = [
        (curve, curve.range_m.index(range_m))
        for curve in curves
        for range_m in BUDGET_SHOWN_M
        if range_m in curve.range_m
    ]
    known = [grouped(curve, index) for curve, index in columns]
    rows = [
        (name, *(small(causes.get(name)) for causes in known))
        for name in GROUPS
        if any(causes.get(name) for causes in known)
    ]
    rows.append(("the limit (Cramér–Rao)", *(small(curve.range_limit_m[index]) for curve, index in columns)))
    rows.append(("all together", *(small(curve.range_sigma_m[index]) for curve, index in columns)))
    heads = (f"{curve.place.name}, {curve.range_m[index]:g} m" for curve, index in columns)
    return Table(("σ of the range by", *heads), rows)


def view_title(camera: CameraBudget) -> str:
    """Return what stands above `view_table`: the exposure too where all have the same."""
    exposures_s = {one.exposure_s for one in camera.in_view}
    within = f", in {1e3 * exposures_s.pop():.3g} ms" if len(exposures_s) == 1 else ""
    return f"The sources where they stand{within}, before a wall lit by all lights"


def view_table(camera: CameraBudget) -> Table:
    """Return what each source in view brings where it stands; its camera where there are several."""
    cameras, exposures = len(camera.cameras) > 1, len({one.exposure_s for one in camera.in_view}) > 1
    foggy = any(one.fog_transmittance < 1.0 for one in camera.in_view)
    rows = []
    for one in camera.in_view:
        row = [one.source, *([one.camera] if cameras else [])]
        row += [metres(one.range_m), degrees(math.degrees(one.field_angle_rad))]
        row += [f"{1e3 * one.exposure_s:.3g} ms"] if exposures else []
        row += [electrons(one.electrons_e)]
        row += [electrons(one.brightest_pixel_e) + (" clips" if one.saturated else "")]
        row += [small(one.range_limit_m), small(one.range_sigma_m)]
        rows.append([*row, metres(one.fog_bias_m)] if foggy else row)
    heads = [
        "source",
        *(["camera"] if cameras else []),
        "range",
        "angle",
        *(["exposure"] if exposures else []),
    ]
    heads += ["electrons", "peak px", "limit σ", "σ in all", *(["fog adds"] if foggy else [])]
    return Table(heads, rows)


def ambient_table(camera: CameraBudget) -> Table:
    """Return what each light that is no robot's brings to a pixel, for each exposure."""
    rows = [
        (
            one.name,
            significant(one.irradiance_w_per_m2) if one.irradiance_w_per_m2 >= 1e-5 else "0",
            *(electrons(one.wall_e_per_s * exposure_s) for exposure_s in camera.stated_exposure_s),
            "–" if one.seen_e_per_s is None else electrons(one.seen_e_per_s * camera.stated_exposure_s[0]),
            "–" if one.rejection is None else f"{100.0 * one.rejection:.2f} %",
            _leak(one.in_band_e_per_j, one.out_of_band_e_per_j),
            _leak(one.in_band_e_per_j, one.out_of_band_low_e_per_j, one.out_of_band_high_e_per_j),
        )
        for one in camera.ambient
    ]
    walls = [f"e/px in {1e3 * exposure_s:.3g} ms" for exposure_s in camera.stated_exposure_s]
    heads = ("light", "W/m² on the wall", *walls, "seen itself", "kept out", "leak", "within")
    return Table(heads, rows)


def eye_table(budget: Budget) -> Table:
    """Return what sources bring to an eye as shares of the limits: lit for any time, and by one pulse."""
    rows = [
        (
            alike(one.sources),
            significant(1e3 * one.intensity_w_per_sr),
            _of_limit(one.cornea_w_per_m2 / one.cornea_limit_w_per_m2),
            _of_limit(one.retina_w_per_m2_sr / one.retina_limit_w_per_m2_sr),
            "–" if one.pulse_of_limit is None else _of_limit(one.pulse_of_limit),
            _group(one),
        )
        for one in budget.eye_safety
    ]
    return Table(("source", "mW/sr", "cornea", "retina", "a pulse", "group"), rows)


def fog_sentence(fog: Mapping[str, Any]) -> str:
    """Say what the fog takes, how far eyes see in it, and how it scatters."""
    seen = "" if fog["visibility_m"] is None else f", a visibility of {metres(fog['visibility_m'])} at 550 nm"
    sigma = "" if fog["ratio_sigma"] is None else f" ± {fog['ratio_sigma']:.3f}"
    text = (
        f"Fog: extinction {fog['extinction_per_m']:.4g} /m at 940 nm{seen} "
        f"(σ(940)/σ(550) = {fog['ratio_940_to_550']:.3f}{sigma}, that of {fog['ratio_of']}); "
        f"1 − albedo {fog['absorbed_share']:.2g}, g {fog['asymmetry']:.3f}"
    )
    if fog["droplets_per_cm3"] is not None:
        number, volume = fog["droplets_per_cm3"], fog["volume_cm3_per_m3"]
        text += f"; {number:.3g} droplets per cm³, {volume:.3g} cm³ of them in a m³"
    if fog["profile"] is not None:
        points = ", ".join(f"{density:g} at {height_m:g} m" for height_m, density in fog["profile"])
        text += f". So where its profile over height is 1; that is {points}, linear between"
    return f"{text}."


def source_sentences(source: SourceBudget) -> str:
    """Say of a source what becomes electrons, where its flare clips, what most of a range's σ comes of."""
    said = [_light_sentence(source), *_saturation_sentences(source), _leading_sentence(source.curves[0])]
    return " ".join(sentence for sentence in said if sentence)


def _light_sentence(source: SourceBudget) -> str:
    text = (
        f"{share(source.in_band_share)} of its {significant(1e3 * source.sent_flux_w)} mW pass the filter on "
        f"the axis; a joule of its light becomes {source.electrons_per_j:.3g} electrons."
    )
    within = source.out_of_band_share_within
    if within is not None and within[1] > 0.01:
        text += f" From out of band it may leak {_ratio(within[0])} to {_ratio(within[1])} beside that."
    mean, most = source.intensity_w_per_sr, source.largest_intensity_w_per_sr
    if source.largest_relative_intensity > 1.001:
        text += (
            f" Curves are of its mean intensity, {significant(1e3 * mean)} mW/sr; "
            f"it sends up to {significant(1e3 * most)} mW/sr."
        )
    blinking = {drive for drive in source.drives.values() if drive != "fully lit"}
    if blinking:
        text += f" Not always lit ({'; '.join(sorted(blinking)[:3])}): figures are of it fully lit."
    return text


def _saturation_sentences(source: SourceBudget) -> list[str]:
    found: dict[str, dict[str, str]] = {}
    for curve in source.curves:
        exposure = "at the shortest exposure" if curve.exposure == "automatic" else f"in {curve.exposure}"
        where = {"axis": "on the axis", "edge": "near the edge"}[curve.place.name]
        found.setdefault(exposure, {})[where] = _saturation(curve.saturation)
    said_of = [
        f"Its flare {said} {exposure}."
        for exposure, by_place in found.items()
        for said in (
            [next(iter(by_place.values()))]
            if len(set(by_place.values())) == 1
            else [f"{where} {what}" for where, what in by_place.items()]
        )
    ]
    return said_of + _brightest_side(source)


def _brightest_side(source: SourceBudget) -> list[str]:
    """Say from where on a source clips that turns its brightest side to the camera, if that is elsewhere."""
    most = source.largest_relative_intensity
    if most <= LOBE:
        return []
    farthest = [
        curve.saturation_at_largest_intensity.range_m or 0.0
        for curve in source.curves
        if curve.place.name == "axis"
    ]
    if not any(farthest):
        return []
    return [
        f"Where it shines brightest, {most:.3g} times its mean, it clips nearer than {metres(max(farthest))}."
    ]


def _leading_sentence(curve: Curve) -> str:
    at = [
        i for i, range_m in enumerate(curve.range_m) if range_m == 3.0 and curve.range_sigma_m[i] is not None
    ]
    if not at:
        return ""
    causes = grouped(curve, at[0])
    first = max(causes, key=lambda name: causes[name])
    return (
        f"At 3 m a range has σ {metres(curve.range_sigma_m[at[0]])}, most of it {first} "
        f"({metres(causes[first])}); what light alone allows is {metres(curve.range_limit_m[at[0]])}."
    )


def small(value_m: float | None) -> str:
    """Write a length, micrometres and less too."""
    if value_m is None or not 0.0 < value_m < 1e-4:
        return metres(value_m)
    return f"{1e6 * value_m:.2g} µm" if value_m >= 1e-8 else "0"


def electrons(value: float) -> str:
    """Write a number of electrons: 0.0727, 36,000, 1.28 M, and <0.001 of none to speak of."""
    if 0.0 < value < 1e-3:
        return "<0.001"
    if 999_500.0 <= value < 999.5e6:
        return f"{value / 1e6:.3g} M"
    return f"{value:.3g}" if value >= 1e6 else f"{float(f'{value:.3g}'):,g}"


def _saturation(found: Saturation) -> str:
    if found.range_m is not None:
        return f"clips nearer than {metres(found.range_m)}"
    return "clips nowhere" if found.when == "never" else "clips everywhere, by its background alone,"


def _leak(in_band: float, *out_of_band: float) -> str:
    return "–" if in_band <= 0.0 else " … ".join(_ratio(one / in_band) for one in out_of_band)


def _ratio(value: float) -> str:
    return f"{100.0 * value:.2g} %" if value < 1.0 else f"{times(value)} ×"


def _of_limit(value: float) -> str:
    return f"{significant(100.0 * value, 2)} %" if value >= 1e-4 else "<0.01 %"


def _group(one: EyeSafety) -> str:
    group = "exempt" if one.exempt_lit else "exempt, pulsed" if one.exempt_as_driven else "above the limit"
    return f"{group}, if no laser" if one.narrow_spectrum else group
