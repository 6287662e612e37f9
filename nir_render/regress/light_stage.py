"""Indirect light against its reference: by statistics, group by group, all of a suite in one family."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.compare import TILE_PX, Estimate, Parts, Verdict, compare_parts
from nir_render.regress.findings import Finding, Pair, percent
from nir_render.regress.reference import ReferenceLight, edge_image
from nir_render.transport.light import Edges, Indirect, Light

# Which pixels lie on an edge is traced in float32: of some hundred, one may be told otherwise elsewhere.
_EDGE_PIXELS = 3
_EDGE_SHARE = 0.01

UNIT = "1/(m² sr) per W"


@dataclass(frozen=True, eq=False)
class Pending:
    """The tests of one group's array, to be judged with all others of the suite.

    `scale` is how many pixels of the camera its pixels have on a side.
    """

    what: str
    parts: Parts
    scale: int
    pair: Pair | None
    along_edges: bool = False


def compare_indirect(
    reference: ReferenceLight, light: Light, label: str, *, alike: bool
) -> tuple[list[Finding], list[Pending]]:
    """Compare the indirect light of a render with the reference's.

    Returns what is certain at once, and the tests that are judged together with others.

    Parameters
    ----------
    alike
        Whether the same integrator made both.
    """
    before, after = reference.light.indirect, light.indirect
    if before is None or after is None:
        if before is after:
            return [], []
        return [_fails(f"{label}indirect light", "there is none any more" if after is None else "is new")], []
    if reference.light.groups != light.groups:
        groups = f"{', '.join(reference.light.groups)} → {', '.join(light.groups)}"
        return [_fails(f"{label}light groups", groups)], []
    old, new = before.radiance_per_w.shape[1:], after.radiance_per_w.shape[1:]
    if old != new:
        return [_fails(f"{label}film", f"{old[-1]} × {old[-2]} → {new[-1]} × {new[-2]} pixels")], []
    pending = list(_of_film(reference, before, after, light.groups, label, alike))
    findings: list[Finding] = []
    if before.edges is not None and after.edges is not None:
        finding, of_edges = _of_edges(reference, before, after, light.groups, label, alike)
        findings.append(finding)
        pending += of_edges
    elif before.edges is not None:
        findings.append(
            Finding("transport", f"{label}pixels along edges", "skipped", "this renderer has none")
        )
    return findings, pending


def settled(pending: Pending, verdict: Verdict, *, same_bits: bool | None, must_be_same: bool) -> Finding:
    """Return what a verdict says of a group; light whose bits are the reference's own render passes."""
    if verdict.same or same_bits:
        seen = f"frame {percent(verdict.frame_change, signed=True)}"
        word = "pass"
    else:
        place = _place(pending, verdict)
        seen = f"{percent(verdict.change, signed=True)} {place}"
        if place.startswith("in "):
            seen += f"; frame {percent(verdict.frame_change, signed=True)}"
        word = "fail"
    if must_be_same and not same_bits:
        word = "fail"
        seen = f"other bits than by the same versions; {seen}"
    tile = verdict.tile_drift if np.isfinite(verdict.tile_drift) else None
    frame = verdict.frame_drift if np.isfinite(verdict.frame_drift) else None
    of_tile = f"tile {_drift(tile)} ({verdict.judged_tiles} of {verdict.tiles}), "
    return Finding(
        "transport",
        pending.what,
        "pass" if word == "pass" else "fail",
        seen,
        f"all {_drift(frame)}" if pending.along_edges else f"{of_tile}frame {_drift(frame)}",
        same_bits=same_bits,
        tile_drift=None if pending.along_edges else tile,
        frame_drift=frame,
    )


def _drift(value: float | None) -> str:
    if value is None:
        return "–"
    return percent(value) if value < 1.0 else f"{1.0 + value:.0f}-fold"


def _place(pending: Pending, verdict: Verdict) -> str:
    if pending.along_edges:
        return "along edges"
    top, bottom, left, right = (pending.scale * edge for edge in verdict.part)
    if bottom - top > 2 * TILE_PX * pending.scale or right - left > 2 * TILE_PX * pending.scale:
        return "over the frame"
    return f"in rows {top}–{bottom - 1}, columns {left}–{right - 1}"


def _of_film(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    groups: tuple[str, ...],
    label: str,
    alike: bool,
) -> Iterator[Pending]:
    for group, name in enumerate(groups):
        one, other = (
            Estimate(
                light.radiance_per_w[group, 0].astype(np.float64),
                light.variance[group, 0].astype(np.float64),
                light.samples,
            )
            for light in (before, after)
        )
        third = None if reference.third is None else reference.third[group]
        parts = compare_parts(one, other, third, alike=alike)
        tiles = -(-np.array(one.mean.shape) // TILE_PX)
        error = parts.error[: parts.tiles].reshape(tiles[0], tiles[1])
        pair = Pair(f"{label}{name}", UNIT, one.mean, other.mean, error)
        yield Pending(f"{label}{name}", parts, before.scale, pair)


def _of_edges(
    reference: ReferenceLight,
    before: Indirect,
    after: Indirect,
    groups: tuple[str, ...],
    label: str,
    alike: bool,
) -> tuple[Finding, list[Pending]]:
    assert before.edges is not None  # noqa: S101 (the caller has looked)
    assert after.edges is not None  # noqa: S101
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
    pending = []
    for group, name in enumerate(groups):
        one = _listed(before.edges, before.samples, group, i)
        other = _listed(after.edges, after.samples, group, j)
        if not one.mean.size:
            break
        parts = compare_parts(one, other, None if third is None else third[group], alike=alike)
        pending.append(Pending(f"{label}{name}, edges", parts, 1, None, along_edges=True))
    return finding, pending


def _listed(edges: Edges, samples: int, group: int, which: NDArray[np.int64]) -> Estimate:
    mean, variance = (
        edge_image(array[group, 0, which].astype(np.float64))
        for array in (edges.radiance_per_w, edges.variance)
    )
    return Estimate(mean, variance, samples)


def _fails(what: str, seen: str) -> Finding:
    return Finding("transport", what, "fail", seen)
