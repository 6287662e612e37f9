"""What the manifest of a run states: versions, seconds, render noise, samples, the error of enlarging."""

import math
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nir_render.camera.optics.leak import Leak, leak
from nir_render.camera.render_noise import RenderNoise
from nir_render.light.light import Light
from nir_render.scene.documents.shapes import Mesh
from nir_render.scene.emission import emission_spectrum, emission_units
from nir_render.scene.scene import Scene
from nir_render.simulation.clock import Shot
from nir_render.simulation.refresh import HELD_OUT, RefreshError
from nir_render.spectra.nodes import BAND_M
from nir_render.transport.fingerprint import package_versions
from nir_render.transport.indirect.sample_plan import MOST_SAMPLES

_DIGITS = 6
_MOST_LEFT_OUT = 0.005
_UNTRUSTED, _SLIGHT_ERROR = 0.5, 0.005


def versions() -> dict[str, str]:
    """Return the versions of what decides the bits of a run."""
    packages = ("nir-render", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless")
    installed = package_versions(*packages)
    return {"python": platform.python_version(), "platform": platform.platform(), **installed}


def noise_facts(target_share: float | None, by_frame: Mapping[str, RenderNoise]) -> dict[str, Any]:
    """Return the shares of render noise over all frames of a run, and whether the target was reached.

    It is where every frame keeps it, by what the render measured of itself; the others are named, as
    "r1.front 3". Null without a target.
    """
    noises = list(by_frame.values())
    medians = [one.median_share for one in noises]
    apertures = [one.aperture_share for one in noises]
    above = None
    if target_share is not None:
        above = [name for name, one in by_frame.items() if not one.keeps(target_share)]
    return {
        "target_share": target_share,
        "target_reached": None if above is None else not above,
        "frames_above_target": above,
        "share_of_temporal_variance": _rounded(np.median(medians)),
        "largest_share": _rounded(max(medians)),
        "mean_share": _rounded(np.mean([one.mean_share for one in noises])),
        "share_behind_lens": _rounded(np.mean([one.share_behind_lens for one in noises])),
        "share_in_99_percent_of_pixels": _rounded(max(one.share_of_99_percent for one in noises)),
        "largest_share_in_a_pixel": _rounded(max(one.largest_share for one in noises)),
        "share_in_apertures": _rounded(np.median(apertures)),
        "largest_share_in_apertures": _rounded(max(apertures)),
    }


def noise_warning(facts: dict[str, Any], frames: int) -> str | None:
    """Return what to tell who asked for a target that some frames of a run do not keep."""
    if facts["target_reached"] is not False:
        return None
    return (
        f"render.noise: the target of {facts['target_share']:.3g} of temporal variance is not kept in "
        f"{len(facts['frames_above_target'])} of {frames} frames: render noise reaches "
        f"{facts['largest_share']:.3g} in a frame's median pixel, "
        f"{facts['largest_share_in_apertures']:.3g} in a flare; manifest.json says more (render_noise). "
        "More samples than these, fixed by render.indirect.samples, bring it down"
    )


def sample_facts(light: Light) -> dict[str, Any]:
    """Return the samples per pixel of a light, and in how many pixels they stay below what the target asks.

    Some of the `pixels_at_cap` may have needed more, too.
    """
    indirect = light.indirect
    assert indirect is not None
    counts = np.array([indirect.samples]) if indirect.counts is None else indirect.counts
    at_cap = 0 if indirect.counts is None else int((counts == MOST_SAMPLES).sum())
    return {
        "least": int(counts.min()),
        "median": float(np.median(counts)),
        "mean": round(float(counts.mean()), 3),
        "most": int(counts.max()),
        "pixels_at_cap": at_cap,
        "pixels_below_need": light.short_pixels,
    }


def ambient_facts(scene: Scene) -> dict[str, Any] | None:
    """Return what lights a scene besides its robots, as it was rendered; null where nothing does.

    Of a lamp whose table ends before 1100 nm, `infrared` is the interval of what it may send beyond, over
    what was rendered. An illuminance counts direct light alone: materials hold values at 940 nm only, so that
    what walls throw on a plane in visible light is not known.
    """
    document = scene.document
    lamps: dict[str, Any] = {}
    for name, lamp in document.shining_lamps.items():
        beyond = lamp.infrared
        interval = None
        if beyond is not None:
            interval = {"share": beyond.share, "least": beyond.least, "most": beyond.most}
        lamps[name] = {"luminous_flux_lm": _rounded(lamp.luminous_flux_lm), "infrared": interval}
    facts: dict[str, Any] = {"lamps": lamps} if lamps else {}
    for name in ("sun", "sky"):
        emitter = scene.emitters().get(name)
        if emitter is not None:
            units, spectrum = emission_units(emitter), emission_spectrum(emitter)
            facts[name] = {
                "irradiance_w_per_m2": _rounded(units),
                "at_940_nm_w_per_m2_per_nm": _rounded(units * float(spectrum(BAND_M)) * 1e-9),
            }
    if document.illuminance is not None:
        level_lx, written_lx = document.illuminance.level_lx, document.written_illuminance_lx
        facts["illuminance"] = {
            "level_lx": level_lx,
            "factor_of_lamps": _rounded(level_lx / written_lx),
            "interreflection": False,
            "why_not": "direct light alone: what walls reflect over 380 to 780 nm is not reckoned",
        }
    return facts or None


def material_facts(scene: Scene) -> dict[str, Any]:
    """Return how well each material that is used is known, and which material each slot of a mesh is of.

    `basis` is null where a scene gives figures without evidence. A slot without a name is "".
    """
    document = scene.document
    used = dict.fromkeys(shape.material for shape in document.all_shapes().values())
    known = {}
    for name in used:
        material = document.materials[name]
        evidence = material.evidence
        known[name] = {
            "type": material.type,
            "basis": None if evidence is None else evidence.basis,
            "uncertainty": None if evidence is None else evidence.uncertainty,
            "deviation": material.deviation,
            "source": None if evidence is None else evidence.source,
        }
    slots: dict[str, dict[str, str]] = {}
    bodies = {f"shapes.{name}": shape for name, shape in document.shapes.items()}
    for robot, carrier in document.robots.items():
        bodies |= {f"robots.{robot}.rig.body.{name}": shape for name, shape in carrier.rig.body.items()}
    for place, shape in bodies.items():
        if isinstance(shape, Mesh):
            of_slots = shape.materials or {}
            slots[place] = {part.slot: of_slots.get(part.slot, shape.material) for part in shape.parts()}
    return {"known": known, "slots": slots}


def refresh_facts(scene: Scene, measured: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return how far interpolated light is off where it was held out, and the times between renders.

    With a target for the error the parts of an interval that keeps it are used, and their error is smaller;
    intervals that do not are not used, nor counted here.
    """
    settings = scene.document.render.indirect
    if settings.every_s is None and settings.error is None:
        return {}
    errors = [RefreshError(**one) for one in measured]
    if settings.error is not None:
        errors = [one for one in errors if one.keeps(settings.error)]
    used = 1.0 if settings.error is None else 1.0 - HELD_OUT
    worst = max(errors, key=lambda one: one.flare_share, default=None)
    facts = {
        "every_s": settings.every_s,
        "target_share": settings.error,
        "held_out": len(errors),
        "longest_apart_s": _rounded(used * max((one.apart_s for one in errors), default=math.nan)),
        "mean_share": _rounded(np.mean([one.mean_share for one in errors] or [math.nan])),
        "largest_share": _rounded(max((one.mean_share for one in errors), default=math.nan)),
        "largest_flare_share": _rounded(worst.flare_share if worst else math.nan),
        "flare_sigma": _rounded(worst.flare_sigma if worst else math.nan),
    }
    known = {name: None if isinstance(one, float) and math.isnan(one) else one for name, one in facts.items()}
    return {"refresh": known}


def wavelength_facts(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return, by camera, at which wavelengths light was carried, and the error of what is between them."""
    from nir_render.transport.wavelengths import carried_wavelengths

    snapshot = scene.at(scene.document.clock.start_s)
    chosen = {name: carried_wavelengths(snapshot, name) for name in scene.cameras()}
    return {
        name: {
            "nodes_nm": [round(1e9 * wavelength_m, 3) for wavelength_m in one.wavelengths_m],
            "error": _rounded(one.error),
        }
        for name, one in chosen.items()
    }


def spectral_facts(scene: Scene) -> dict[str, list[dict[str, Any]]]:
    """Return, by camera, what it sees of each emitter in band and out of it, on its axis, per joule.

    Out of band what frames were rendered with, and between what that is known to lie, as shares of what is
    in band. Emitters of equal figures stand together.
    """
    facts: dict[str, list[dict[str, Any]]] = {}
    for name in scene.cameras():
        alike: dict[Leak, list[str]] = {}
        for emitter_name, emitter in scene.emitters().items():
            alike.setdefault(leak(scene.camera(name)[1], emitter), []).append(emitter_name)
        facts[name] = [_leak_record(one, emitters) for one, emitters in alike.items()]
    return facts


def _leak_record(one: Leak, emitters: list[str]) -> dict[str, Any]:
    known = one.out_of_band_shares
    shares = [None] * 3 if known is None else [float(f"{share:.6g}") for share in known]
    return {
        "emitters": emitters,
        "band_nm": [round(1e9 * end_m, 3) for end_m in one.band_m],
        "in_band_e_per_j": float(f"{one.in_band_e_per_j:.6g}"),
        "out_of_band_share": shares[0],
        "out_of_band_share_within": shares[1:],
    }


def enlarging_facts(shot: Shot) -> dict[str, Any]:
    """Return how far a frame's enlarged light is off the full render; null and why where it is not known."""
    from nir_render.transport.indirect.enlarging_error import upsampling_error

    if shot.mean.rates.between:
        return {"mean": None, "reason": "the light of the first frame lies between two renders"}
    error = upsampling_error(shot.mean)
    if isinstance(error, str):
        return {"mean": None, "reason": error}
    assert shot.light.indirect is not None
    assert shot.light.indirect.edges is not None
    enlargement = shot.light.indirect.edges.enlargement
    return {
        "mean": _rounded(error.share),
        "standard_error": _rounded(error.standard_error),
        "largest": _rounded(error.largest),
        "pixels": error.pixels,
        "pixels_rendered_one_by_one": len(enlargement.patch),
        "pixels_left_out": enlargement.left_out,
    }


def truncation_facts(shot: Shot) -> dict[str, Any]:
    """Return what a frame's light leaves out beyond the longest paths; null and why where it is not known."""
    from nir_render.transport.indirect.truncation import truncation

    left_out = truncation(shot.mean)
    if isinstance(left_out, str):
        return {"max_depth": None, "share": None, "reason": left_out}
    return {
        "max_depth": left_out.max_depth,
        "share": _rounded(left_out.share),
        "standard_error": _rounded(left_out.standard_error),
        "share_by_group": {name: _rounded(share) for name, share in left_out.of_groups.items()},
    }


def truncation_warning(by_camera: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return what to tell where the longest paths leave out more than 0.5 % of a frame's indirect light."""
    worst = max(by_camera, key=lambda name: by_camera[name]["share"] or 0.0, default=None)
    facts: Mapping[str, Any] = {"share": None} if worst is None else by_camera[worst]
    if facts["share"] is None or facts["share"] <= _MOST_LEFT_OUT:
        return None
    return (
        f"render.indirect.max_depth: paths of more than {facts['max_depth']} stretches would bring "
        f"{100.0 * facts['share']:.2g} ± {100.0 * facts['standard_error']:.1g} % of the indirect light of "
        f"{worst}, and are left out; a larger max_depth takes them in"
    )


def group_noise_facts(light: Light) -> dict[str, dict[str, float | None]]:
    """Return how well the light of each group is known when it is exposed alone, by its name.

    `error` is the standard error of the sum over the film, relative to it, by what batches saw; `uncertainty`
    that of its square, from how few pixels bring it: near 1 it is the work of some rare samples, more of
    which may never have been found, and neither figure is to be trusted. Null where a group brings nothing.
    """
    indirect = light.indirect
    assert indirect is not None
    facts: dict[str, dict[str, float | None]] = {}
    for name, radiance, variance in zip(
        light.groups, indirect.radiance_per_w, indirect.variance.astype(np.float64), strict=True
    ):
        # Nodes go along the same paths, and are off together.
        together = np.sqrt(variance).sum(axis=0) ** 2
        total, noise = float(radiance.sum(dtype=np.float64)), float(together.sum())
        facts[name] = {
            "error": _rounded(noise**0.5 / total) if total > 0.0 else None,
            "uncertainty": _rounded(float((together**2).sum()) ** 0.5 / noise) if noise > 0.0 else None,
        }
    return facts


def group_noise_warning(by_camera: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return what to tell of groups whose noise hangs on so few samples that it is not known."""
    found = [
        f"{name} in {camera}"
        for camera, of_groups in by_camera.items()
        for name, one in of_groups.items()
        if (one["uncertainty"] or 0.0) > _UNTRUSTED and (one["error"] or 0.0) > _SLIGHT_ERROR
    ]
    if not found:
        return None
    return (
        f"render noise: that of {', '.join(found)} hangs on few rare samples, and may be larger than stated "
        "when these are exposed with the others off; render them alone, or take more samples"
    )


def _rounded(value: float | np.floating[Any]) -> float:
    return round(float(value), _DIGITS)
