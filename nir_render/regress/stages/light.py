"""Indirect light against its reference: by statistics, group by group, all of a suite in one family."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.light.light import Edges, Indirect, Light, Multiple
from nir_render.regress.findings import Finding, ImagePair, Word, percent
from nir_render.regress.reference import ReferenceLight, by_group_and_node, edge_image
from nir_render.regress.statistics import (
    TILE_PX,
    Judgement,
    MonteCarloImage,
    PartTests,
    compare_parts,
    compare_paths,
)

# Which pixels lie on an edge is traced in float32: of some hundred, one may be told otherwise elsewhere.
_EDGE_PIXELS = 3
_EDGE_SHARE = 0.01

UNIT = "1/(m² sr) per W"


@dataclass(frozen=True, eq=False)
class GroupTests:
    """The tests of one group's array, to be judged with all others of the suite.

    `scale` is how many pixels of the camera its pixels have on a side; `same_paths` tells that they compare
    renders of the same random numbers.
    """

    what: str
    parts: PartTests
    scale: int
    pair: ImagePair | None
    along_edges: bool = False
    same_paths: bool = False


def compare_indirect(
    reference: ReferenceLight, light: Light, label: str, *, alike: bool, own_samples: int = 0
) -> tuple[list[Finding], list[GroupTests]]:
    """Compare the indirect light of a render with the reference's.

    Returns what is certain at once, and the tests that are judged together with others.

    Parameters
    ----------
    alike
        Whether the same integrator made both.
    own_samples
        Of the reference's own render, where this one has its seed: then their paths are compared, too.
    """
    before, after = reference.light.indirect, light.indirect
    if before is None or after is None:
        if before is after:
            return [], []
        return [
            _failed(f"{label}indirect light", "there is none any more" if after is None else "is new")
        ], []
    if reference.light.groups != light.groups:
        groups = f"{', '.join(reference.light.groups)} → {', '.join(light.groups)}"
        return [_failed(f"{label}light groups", groups)], []
    old, new = before.radiance_per_w.shape[1:], after.radiance_per_w.shape[1:]
    if old != new:
        return [_failed(f"{label}film", f"{old[-1]} × {old[-2]} → {new[-1]} × {new[-2]} pixels")], []
    tests = list(_film_tests(reference, before, after, _names(light), label, alike))
    findings = _averaging_findings(before, after, label)
    if before.multiple is not None and after.multiple is not None:
        tests += _multiple_tests(reference, before, after, _names(light), label, alike)
    if alike and own_samples:
        finding, path_tests = _path_tests(reference, before, after, _names(light), label, own_samples)
        findings.append(finding)
        tests += path_tests
    if before.edges is not None and after.edges is not None:
        finding, edge_tests = _edge_tests(reference, before, after, _names(light), label, alike)
        findings.append(finding)
        tests += edge_tests
    elif before.edges is not None:
        findings.append(
            Finding("transport", f"{label}pixels along edges", "skipped", "this renderer has none")
        )
    return findings, tests


def finding_of(
    tests: GroupTests, judgement: Judgement, *, same_bits: bool | None, must_be_same: bool
) -> Finding:
    """Return what a judgement says of a group; light whose bits are the reference's own render passes."""
    if judgement.same or same_bits:
        seen = f"frame {percent(judgement.frame_change, signed=True)}"
        outcome: Word = "pass"
    else:
        place = _place_text(tests, judgement)
        seen = f"{percent(judgement.change, signed=True)} {place}"
        if place.startswith("in "):
            seen += f"; frame {percent(judgement.frame_change, signed=True)}"
        outcome = "fail"
    if must_be_same and not same_bits and not tests.same_paths:
        outcome = "fail"
        seen = f"other bits than by the same versions; {seen}"
    if tests.same_paths:
        seen = f"of the pixels that differ: {seen}"
        return Finding("transport", tests.what, outcome, seen, "20 pixels that differ one way")
    tile = judgement.tile_drift if np.isfinite(judgement.tile_drift) else None
    frame = judgement.frame_drift if np.isfinite(judgement.frame_drift) else None
    tile_text = f"tile {_drift(tile)} ({judgement.judged_tiles} of {judgement.tiles}), "
    return Finding(
        "transport",
        tests.what,
        outcome,
        seen,
        f"all {_drift(frame)}" if tests.along_edges else f"{tile_text}frame {_drift(frame)}",
        same_bits=same_bits,
        tile_drift=None if tests.along_edges else tile,
        frame_drift=frame,
    )


def _drift(value: float | None) -> str:
    if value is None:
        return "–"
    return percent(value) if value < 1.0 else f"{1.0 + value:.0f}-fold"


def _place_text(tests: GroupTests, judgement: Judgement) -> str:
    if tests.along_edges:
        return "along edges"
    top, bottom, left, right = (tests.scale * edge for edge in judgement.part)
    if bottom - top > 2 * TILE_PX * tests.scale or right - left > 2 * TILE_PX * tests.scale:
        return "over the frame"
    return f"in rows {top}–{bottom - 1}, columns {left}–{right - 1}"


def _film_tests(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    names: list[str],
    label: str,
    alike: bool,
) -> Iterator[GroupTests]:
    for group, name in enumerate(names):
        one, other = (_film_image(light, light.samples, group) for light in (before, after))
        third = None if reference.third is None else reference.third[group]
        parts = compare_parts(one, other, third, alike=alike)
        tiles = -(-np.array(one.mean.shape) // TILE_PX)
        error = parts.error[: parts.tiles].reshape(tiles[0], tiles[1])
        pair = ImagePair(f"{label}{name}", UNIT, one.mean, other.mean, error)
        yield GroupTests(f"{label}{name}", parts, before.scale, pair)


def _film_image(light: Indirect | Multiple, samples: int, group: int) -> MonteCarloImage:
    mean, variance = (
        by_group_and_node(array)[group].astype(np.float64) for array in (light.radiance_per_w, light.variance)
    )
    return MonteCarloImage(mean, variance, samples)


def _averaging_findings(before: Indirect, after: Indirect, label: str) -> list[Finding]:
    """Return what is to be said of blocks whose light of many turns is averaged; nothing where none is."""
    what = f"{label}averaged blocks"
    if after.multiple is None:
        return [] if before.multiple is None else [_failed(what, "there are none any more")]
    if before.multiple is None:
        words = "the reference has none: 'nir-render regress update --all' adds them"
        return [Finding("transport", what, "skipped", words)]
    old, new = before.multiple.surface >= 0, after.multiple.surface >= 0
    others, allowed = int((old != new).sum()), _EDGE_PIXELS + int(_EDGE_SHARE * old.sum())
    words = f"{others} of {int(old.sum())} are others"
    outcome: Word = "fail" if others > allowed else "pass"
    same = np.array_equal(before.multiple.surface, after.multiple.surface)
    return [Finding("transport", what, outcome, words, f"{allowed + 1} others", same_bits=same)]


def _multiple_tests(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    names: list[str],
    label: str,
    alike: bool,
) -> Iterator[GroupTests]:
    """Compare the light of many turns, group by group; it is in the whole light, too."""
    assert before.multiple is not None  # the caller has looked
    assert after.multiple is not None
    parts = (before.multiple, before.samples), (after.multiple, after.samples)
    for group, name in enumerate(names):
        one, other = (_film_image(part, samples, group) for part, samples in parts)
        third = None if reference.third_multiple is None else reference.third_multiple[group]
        tests = compare_parts(one, other, third, alike=alike)
        yield GroupTests(f"{label}{name}, turned often", tests, before.scale, None)


def _path_tests(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    names: list[str],
    label: str,
    own_samples: int,
) -> tuple[Finding, list[GroupTests]]:
    """Compare the film with the reference's own render, where random numbers are the same."""
    what = f"{label}paths"
    if reference.own_radiance_per_w is None:
        words = "the reference has none: 'nir-render regress update --all' adds them"
        return Finding("transport", what, "skipped", words), []
    if after.samples != own_samples:
        words = f"{own_samples} → {after.samples} samples in a pixel"
        return Finding("transport", what, "skipped", words), []
    # Of the reference's many samples the variance is known best.
    noise = 2.0 * by_group_and_node(before.variance).astype(np.float64) * (before.samples / own_samples)
    own, now = (
        by_group_and_node(array).astype(np.float64)
        for array in (reference.own_radiance_per_w, after.radiance_per_w)
    )
    compared = [compare_paths(*images) for images in zip(own, now, noise, strict=True)]
    tests = [
        GroupTests(f"{label}{name}, same paths", one.parts, before.scale, None, same_paths=True)
        for name, one in zip(names, compared, strict=True)
        if one.parts is not None
    ]
    others = [name for name, one in zip(names, compared, strict=True) if one.others]
    unlike, pixels = (sum(getattr(one, part) for one in compared) for part in ("unlike", "pixels"))
    if others:
        words = f"most are others of {', '.join(others)}: another sampler; judged by statistics alone"
        return Finding("transport", what, "skipped", words), tests
    words = f"{unlike} of {pixels} pixels differ" if unlike else "all the same"
    detectable = "20 pixels that differ one way"
    return Finding("transport", what, "pass", words, detectable, np.array_equal(own, now)), tests


def _edge_tests(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    names: list[str],
    label: str,
    alike: bool,
) -> tuple[Finding, list[GroupTests]]:
    assert before.edges is not None  # the caller has looked
    assert after.edges is not None
    old, new = before.edges.enlargement.patch, after.edges.enlargement.patch
    same, i, j = np.intersect1d(old, new, return_indices=True)
    others = len(old) + len(new) - 2 * len(same)
    allowed = _EDGE_PIXELS + int(_EDGE_SHARE * len(old))
    finding = Finding(
        "transport",
        f"{label}pixels along edges",
        "fail" if others > allowed else "pass",
        f"{others} of {len(old)} are others",
        f"{allowed + 1} others",
        same_bits=np.array_equal(old, new),
    )
    third = reference.third_edges if others == 0 else None
    tests = []
    for group, name in enumerate(names):
        one = _edge_pixels(before.edges, before.samples, group, i)
        other = _edge_pixels(after.edges, after.samples, group, j)
        if not one.mean.size:
            break
        parts = compare_parts(one, other, None if third is None else third[group], alike=alike)
        tests.append(GroupTests(f"{label}{name}, edges", parts, 1, None, along_edges=True))
    return finding, tests


def _edge_pixels(edges: Edges, samples: int, group: int, which: NDArray[np.int64]) -> MonteCarloImage:
    mean, variance = (
        edge_image(by_group_and_node(array)[group][which].astype(np.float64))
        for array in (edges.radiance_per_w, edges.variance)
    )
    return MonteCarloImage(mean, variance, samples)


def _names(light: Light) -> list[str]:
    """Return a name for each group at each wavelength node, nodes told where there are several."""
    if len(light.wavelengths_m) == 1:
        return list(light.groups)
    return [f"{group} at {1e9 * node_m:.0f} nm" for group in light.groups for node_m in light.wavelengths_m]


def _failed(what: str, seen: str) -> Finding:
    return Finding("transport", what, "fail", seen)
