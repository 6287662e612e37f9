"""A regression check, or an update of references, on one page: what drifted, and old, new and difference."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from nir_render.light.light import Indirect
from nir_render.regress.findings import Check, Finding, ImagePair, SceneCheck, Update, percent
from nir_render.regress.reference import Reference, changes_of
from nir_render.regress.statistics import TILE_PX, MonteCarloImage, compare_parts, tile_sums
from nir_render.report import style
from nir_render.report.parts import Table, render_page
from nir_render.report.pictures import png_uri
from nir_render.report.wording import counted

_FULL_COLOUR = 6.0  # standard errors
_SOFTENING = 0.1  # of the median: what is darker is shown linearly
_DIM = 1e-3  # of the brightest: relative to no less is a difference without noise shown
_WORD = {"pass": "pass", "fail": "FAIL", "skipped": "skipped"}
_LEVEL = {"pass": "good", "fail": "bad", "skipped": "none"}

_MORE = "#ff9f1c"

Image = NDArray[np.float64]


@dataclass(frozen=True)
class Card:
    """A scene on its card: whether it drifted, and where first."""

    name: str
    level: str
    word: str
    value: str
    sentence: str


@dataclass(frozen=True)
class Picture:
    """A picture of a pair, by its address, and what stands below it."""

    address: str
    caption: str


@dataclass(frozen=True)
class ShownPair:
    """An image before, after, and the difference."""

    title: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class ShownScene:
    """What the page shows of a scene; `folded` where there is nothing to look into."""

    name: str
    folded: bool
    changes: tuple[str, ...]
    findings: Table | None
    pairs: tuple[ShownPair, ...]


def check_page(result: Check) -> str:
    """Return the page of a check."""
    drifted = [scene.name for scene in result.scenes if not scene.holds]
    outcome = f"drifted: {', '.join(drifted)}" if drifted else "nothing drifted"
    return render_page(
        "regress/check.html",
        title=f"Regression check: {result.suite}",
        subtitle=[counted(len(result.scenes), "scene"), outcome],
        scenes=[_shown(scene) for scene in sorted(result.scenes, key=lambda scene: scene.holds)],
        **_overview(result),
    )


def update_page(done: Update) -> str:
    """Return the page of an update: the old references, the new ones, and what the check said of the old."""
    checked = {scene.name: scene for scene in done.before.scenes}
    scenes = []
    for name, new in done.new.items():
        pairs = tuple(_references(done.old[name], new)) if name in done.old else tuple(_alone(new))
        scene = checked.get(name, SceneCheck(name, ("a new scene",), ()))
        changes = changes_of(done.old[name].document, new.document) if name in done.old else scene.changes
        scenes.append(_shown(SceneCheck(name, changes, scene.findings, pairs), opened=True))
    names = {"made anew:": done.made, "kept:": done.kept, "removed:": done.removed}
    return render_page(
        "regress/update.html",
        title=f"Regression references: {done.before.suite}",
        subtitle=[f"{word} {', '.join(listed)}" for word, listed in names.items() if listed],
        reason=done.reason,
        scenes=scenes,
        **_overview(done.before),
    )


def _overview(result: Check) -> dict[str, Any]:
    return {
        "cards": [_card(scene) for scene in result.scenes],
        "versions": result.versions,
        "false_alarm_rate": percent(result.false_alarm_rate),
        "more_colour": _MORE,
    }


def _card(scene: SceneCheck) -> Card:
    failed = [finding for finding in scene.findings if finding.verdict == "fail"]
    sentence = f"{failed[0].what}: {failed[0].seen}." if failed else "Nothing speaks against it."
    if len(failed) > 1:
        sentence += f" And {counted(len(failed) - 1, 'more thing')}."
    level, word = ("good", "pass") if scene.holds else ("bad", "FAIL")
    return Card(scene.name, level, word, "drifted" if failed else "the same", sentence)


def _shown(scene: SceneCheck, *, opened: bool = False) -> ShownScene:
    return ShownScene(
        name=scene.name,
        folded=scene.holds and not opened,
        changes=scene.changes,
        findings=_table(scene.findings) if scene.findings else None,
        pairs=tuple(_pair(pair) for pair in scene.pairs),
    )


def _table(findings: Sequence[Finding]) -> Table:
    bits = {True: "the same", False: "others", None: ""}
    verdict = Markup('<b class="{}" style="color:var(--level)">{}</b>')
    rows = [
        [
            finding.stage,
            finding.what,
            verdict.format(_LEVEL[finding.verdict], _WORD[finding.verdict]),
            finding.seen,
            finding.detectable,
            bits[finding.same_bits],
        ]
        for finding in findings
    ]
    return Table(("stage", "what", "", "seen", "would have seen", "bits"), rows)


def _references(old: Reference, new: Reference) -> Iterator[ImagePair]:
    """Yield the electrons and the indirect light of two references, of what both have."""
    for before in old.shots:
        for after in new.shots:
            key = (before.frame.camera, before.frame.index)
            if key == (after.frame.camera, after.frame.index):
                title = f"{key[0]} {key[1]} expected electrons"
                yield ImagePair(title, "electrons", *(_float(one.electrons) for one in (before, after)))
    for number, (one, other) in enumerate(zip(old.lights, new.lights, strict=False)):
        before_light, after_light = one.light.indirect, other.light.indirect
        if before_light is None or after_light is None:
            continue
        for group, name in enumerate(one.light.groups):
            if name not in other.light.groups:
                continue
            i, j = group, other.light.groups.index(name)
            first = MonteCarloImage(*_of_group(before_light, i), before_light.samples)
            second = MonteCarloImage(*_of_group(after_light, j), after_light.samples)
            error = None
            if first.mean.shape == second.mean.shape:
                third = None if one.third is None else one.third[i]
                parts = compare_parts(first, second, third)
                error = parts.error[: parts.tiles].reshape(-(-np.array(first.mean.shape) // TILE_PX))
            title = f"light {number} {name}" if len(old.lights) > 1 else name
            yield ImagePair(title, "1/(m² sr) per W", first.mean, second.mean, error)


def _alone(new: Reference) -> Iterator[ImagePair]:
    for shot in new.shots:
        image = _float(shot.electrons)
        title = f"{shot.frame.camera} {shot.frame.index} expected electrons"
        yield ImagePair(title, "electrons", np.zeros_like(image), image)


def _pair(pair: ImagePair) -> ShownPair:
    top = max(float(pair.before.max()), float(pair.after.max()), 1e-300)
    softening = float(np.clip(_SOFTENING * np.median(pair.after) / top, 1e-4, 0.1))
    pictures = [
        Picture(png_uri(_grey(image, top, softening)), f"{word}, up to {image.max():.3g} {pair.unit}")
        for word, image in (("old", pair.before), ("new", pair.after))
    ]
    if pair.before.shape == pair.after.shape:
        coloured, caption = _difference(pair)
        pictures.append(Picture(png_uri(coloured), caption))
    return ShownPair(pair.title, tuple(pictures))


def _difference(pair: ImagePair) -> tuple[NDArray[np.uint8], str]:
    """Return the picture of what is new minus old, and what its colours say."""
    if pair.error is not None:
        rows, columns = pair.before.shape
        wide = np.kron(pair.error, np.ones((TILE_PX, TILE_PX)))[:rows, :columns]
        change = np.kron(tile_sums(pair.after - pair.before, TILE_PX), np.ones((TILE_PX, TILE_PX)))[
            :rows, :columns
        ]
        z = change / np.where(wide > 0.0, wide, np.inf)
        far = float(z.flat[np.argmax(np.abs(z))])
        said = f"difference of tiles of 8 × 8, full colour at {_FULL_COLOUR:g} σ; farthest {far:+.1f} σ"
        return _coloured(z / _FULL_COLOUR), said.replace("-", "−")
    floor = _DIM * max(float(pair.before.max()), float(pair.after.max()), 1e-300)
    relative = (pair.after - pair.before) / np.maximum(pair.before, floor)
    largest = float(np.abs(relative).max())
    if largest == 0.0:
        return _coloured(relative), "no difference"
    return _coloured(relative / largest), f"relative difference, full colour at {percent(largest)}"


def _grey(image: Image, top: float, softening: float) -> NDArray[np.uint8]:
    curve = np.arcsinh(np.clip(image / top, 0.0, 1.0) / softening) / np.arcsinh(1.0 / softening)
    return np.asarray(np.rint(255.0 * curve), dtype=np.uint8)


def _coloured(image: Image) -> NDArray[np.uint8]:
    """Colour −1 to 1, shape (rows, columns), as BGR: less, the panel's ground, more."""
    size = np.clip(np.abs(image), 0.0, 1.0)[..., None]
    end = np.where(image[..., None] > 0.0, _bgr(_MORE), _bgr(style.TRUTH))
    return np.asarray(np.rint((1.0 - size) * _bgr(style.PANEL) + size * end), dtype=np.uint8)


def _bgr(colour: str) -> Image:
    return np.array([int(colour[i : i + 2], 16) for i in (5, 3, 1)], dtype=np.float64)


def _of_group(indirect: Indirect, group: int) -> tuple[Image, Image]:
    return _float(indirect.radiance_per_w[group, 0]), _float(indirect.variance[group, 0])


def _float(array: NDArray[np.float32]) -> Image:
    return array.astype(np.float64)
