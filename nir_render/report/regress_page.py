"""A regression check, or an update of references, on one page: what drifted, and old, new and difference."""

import base64
from collections.abc import Iterator, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.compare import TILE_PX, Estimate, compare_parts, sums
from nir_render.regress.findings import Check, Finding, Pair, SceneCheck, percent
from nir_render.regress.reference import Reference, changes_of
from nir_render.regress.suites import Update
from nir_render.report import style
from nir_render.report.parts import page, table
from nir_render.report.wording import counted
from nir_render.transport.light import Indirect

_FULL_COLOUR = 6.0  # standard errors
_SOFTENING = 0.1  # of the median: what is darker is shown linearly
_DIM = 1e-3  # of the brightest: relative to no less is a difference without noise shown
_WORD = {"pass": "pass", "fail": "FAIL", "skipped": "skipped"}
_LEVEL = {"pass": "good", "fail": "bad", "skipped": "none"}

_MORE = "#ff9f1c"

Image = NDArray[np.float64]


def check_page(result: Check) -> str:
    """Return the page of a check."""
    drifted = [scene.name for scene in result.scenes if not scene.holds]
    body = [_cards(result.scenes), _versions(result.versions), _reading(result.false_alarm_rate)]
    body += [_scene(scene) for scene in sorted(result.scenes, key=lambda scene: scene.holds)]
    said = f"drifted: {', '.join(drifted)}" if drifted else "nothing drifted"
    return page(f"Regression check: {result.suite}", [counted(len(result.scenes), "scene"), said], body)


def update_page(done: Update) -> str:
    """Return the page of an update: the old references, the new ones, and what the check said of the old."""
    checked = {scene.name: scene for scene in done.before.scenes}
    subtitle = [f"{word} {', '.join(names)}" for word, names in _what(done).items() if names]
    body = [
        f"<h2>Why</h2><p>{escape(done.reason)}</p>",
        _cards(done.before.scenes),
        _versions(done.before.versions),
        _reading(done.before.false_alarm_rate),
    ]
    for name, new in done.new.items():
        pairs = tuple(_references(done.old[name], new)) if name in done.old else tuple(_alone(new))
        scene = checked.get(name, SceneCheck(name, ("a new scene",), ()))
        changes = changes_of(done.old[name].document, new.document) if name in done.old else scene.changes
        body.append(_scene(SceneCheck(name, changes, scene.findings, pairs), opened=True))
    return page(f"Regression references: {done.before.suite}", subtitle, body)


def _what(done: Update) -> dict[str, Sequence[str]]:
    return {"made anew:": done.made, "kept:": done.kept, "removed:": done.removed}


def _cards(scenes: Sequence[SceneCheck]) -> str:
    cards = []
    for scene in scenes:
        failed = [finding for finding in scene.findings if finding.verdict == "fail"]
        said = f"{failed[0].what}: {failed[0].seen}." if failed else "Nothing speaks against it."
        more = f" And {counted(len(failed) - 1, 'more thing')}." if len(failed) > 1 else ""
        level, word = ("good", "pass") if scene.holds else ("bad", "FAIL")
        cards.append(
            f'<div class="card {level}"><div class="about"><span>{escape(scene.name)}</span>'
            f'<span class="level">{word}</span></div>'
            f'<div class="value">{"drifted" if failed else "the same"}</div>'
            f'<div class="sentence">{escape(said)}{more}</div></div>'
        )
    return f'<h2>Scenes</h2><div class="cards">{"".join(cards)}</div>' if cards else ""


def _versions(changes: Sequence[str]) -> str:
    if not changes:
        return "<p>Versions, processor and code are those that made the references.</p>"
    lines = "".join(f"<li>{escape(change)}</li>" for change in changes)
    return f"<h3>Not as of the references</h3><ul>{lines}</ul>"


def _reading(false_alarm_rate: float) -> str:
    ramp = f"linear-gradient(90deg, {style.TRUTH}, {style.PANEL}, {_MORE})"
    bar = f'<span style="display:inline-block;width:120px;height:12px;background:{ramp}"></span>'
    return (
        "<p class='faint'>Each stage begins from the reference: light is rendered anew; electrons come of "
        "the reference's light, frames of its electrons, detections of its frames. A drift “would have "
        "been seen” with a chance of 95 %; a check of equal renders finds one in "
        f"{percent(false_alarm_rate)} of cases.</p>"
        f'<div class="key"><span>less {bar} more</span><span>grey follows an asinh curve, old and new alike'
        "</span></div>"
    )


def _scene(scene: SceneCheck, *, opened: bool = False) -> str:
    changes = "".join(f"<li>{escape(change)}</li>" for change in scene.changes)
    parts = [f"<h3>What changed in the scene</h3><ul>{changes}</ul>"] if changes else []
    if scene.findings:
        parts.append(_table(scene.findings))
    parts += [_pair(pair) for pair in scene.pairs]
    inner = "\n".join(parts)
    name = escape(scene.name)
    if opened or not scene.holds:
        return f"<h2>{name}</h2>{inner}"
    return f"<h2>{name}</h2><details><summary>the same: numbers and pictures</summary>{inner}</details>"


def _table(findings: Sequence[Finding]) -> str:
    headings = ["stage", "what", "", "seen", "would have seen", "bits"]
    bits = {True: "the same", False: "others", None: ""}
    rows = [
        [
            finding.stage,
            escape(finding.what),
            f'<b class="{_LEVEL[finding.verdict]}" style="color:var(--level)">{_WORD[finding.verdict]}</b>',
            escape(finding.seen),
            escape(finding.detectable),
            bits[finding.same_bits],
        ]
        for finding in findings
    ]
    return table(headings, rows, text=(1, 2, 3, 4, 5))


def _references(old: Reference, new: Reference) -> Iterator[Pair]:
    """Yield the electrons and the indirect light of two references, of what both have."""
    for before in old.shots:
        for after in new.shots:
            key = (before.frame.camera, before.frame.index)
            if key == (after.frame.camera, after.frame.index):
                title = f"{key[0]} {key[1]} expected electrons"
                yield Pair(title, "electrons", *(_float(one.electrons) for one in (before, after)))
    for number, (one, other) in enumerate(zip(old.lights, new.lights, strict=False)):
        before_light, after_light = one.light.indirect, other.light.indirect
        if before_light is None or after_light is None:
            continue
        for group, name in enumerate(one.light.groups):
            if name not in other.light.groups:
                continue
            i, j = group, other.light.groups.index(name)
            first = Estimate(*_of_group(before_light, i), before_light.samples)
            second = Estimate(*_of_group(after_light, j), after_light.samples)
            error = None
            if first.mean.shape == second.mean.shape:
                third = None if one.third is None else one.third[i]
                parts = compare_parts(first, second, third)
                error = parts.error[: parts.tiles].reshape(-(-np.array(first.mean.shape) // TILE_PX))
            title = f"light {number} {name}" if len(old.lights) > 1 else name
            yield Pair(title, "1/(m² sr) per W", first.mean, second.mean, error)


def _alone(new: Reference) -> Iterator[Pair]:
    for shot in new.shots:
        image = _float(shot.electrons)
        title = f"{shot.frame.camera} {shot.frame.index} expected electrons"
        yield Pair(title, "electrons", np.zeros_like(image), image)


def _pair(pair: Pair) -> str:
    top = max(float(pair.before.max()), float(pair.after.max()), 1e-300)
    softening = float(np.clip(_SOFTENING * np.median(pair.after) / top, 1e-4, 0.1))
    figures = [
        _figure(_grey(image, top, softening), f"{word}, up to {image.max():.3g} {pair.unit}")
        for word, image in (("old", pair.before), ("new", pair.after))
    ]
    if pair.before.shape == pair.after.shape:
        figures.append(_figure(*_difference(pair)))
    return (
        f'<h3>{escape(pair.title)}</h3><div class="wholes" '
        f'style="grid-template-columns: repeat(3, 1fr)">{"".join(figures)}</div>'
    )


def _difference(pair: Pair) -> tuple[NDArray[np.uint8], str]:
    """Return the picture of what is new minus old, and what its colours say."""
    if pair.error is not None:
        rows, columns = pair.before.shape
        wide = np.kron(pair.error, np.ones((TILE_PX, TILE_PX)))[:rows, :columns]
        change = np.kron(sums(pair.after - pair.before, TILE_PX), np.ones((TILE_PX, TILE_PX)))[
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


def _figure(image: NDArray[np.uint8], said: str) -> str:
    done, buffer = cv2.imencode(".png", image)
    if not done:
        raise RuntimeError("OpenCV could not encode a picture as PNG")
    data = base64.b64encode(buffer.tobytes()).decode()
    return (
        f'<figure><img alt="{escape(said)}" src="data:image/png;base64,{data}" '
        'style="display:block;width:100%;image-rendering:pixelated">'
        f"<figcaption>{escape(said)}</figcaption></figure>"
    )


def _of_group(indirect: Indirect, group: int) -> tuple[Image, Image]:
    return _float(indirect.radiance_per_w[group, 0]), _float(indirect.variance[group, 0])


def _float(array: NDArray[np.float32]) -> Image:
    return array.astype(np.float64)
