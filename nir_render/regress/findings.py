"""What a check says: findings, one for each thing compared, and the pictures that go with them.

And what an update of references did.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.regress.reference import Reference

Word = Literal["pass", "fail", "skipped"]


@dataclass(frozen=True)
class Finding:
    """One thing that was compared.

    Attributes
    ----------
    stage
        `scene`, `transport`, `camera` or `perception`; each but the first begins from the reference.
    verdict
        What came of it; `skipped` where this machine cannot do it.
    seen
        What was seen, in words.
    detectable
        The drift that would have been found, in words.
    same_bits
        Whether all bits are the reference's; None where there is nothing to compare bit by bit.
    tile_drift, frame_drift
        The relative drift of a tile of 8 × 8 pixels and of the frame that would have been found with a
        chance of 95 %; None of what is no Monte Carlo, and where none would.
    """

    stage: Literal["scene", "transport", "camera", "perception"]
    what: str
    verdict: Word
    seen: str
    detectable: str = ""
    same_bits: bool | None = None
    tile_drift: float | None = None
    frame_drift: float | None = None


@dataclass(frozen=True, eq=False)
class ImagePair:
    """An image before and after, shape (rows, columns); `error` that of tiles of 8 × 8 pixels' differences.

    `error` is None of what is no Monte Carlo. `unit` is that of the images.
    """

    title: str
    unit: str
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    error: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class SceneCheck:
    """What a check says of one scene; `changes` are the fields of its document that differ."""

    name: str
    changes: tuple[str, ...]
    findings: tuple[Finding, ...]
    pairs: tuple[ImagePair, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether nothing drifted."""
        return all(finding.verdict != "fail" for finding in self.findings)


@dataclass(frozen=True, eq=False)
class Check:
    """What a check says of a suite.

    Attributes
    ----------
    suite
        The suite's folder, as given.
    false_alarm_rate
        The chance that a check of the whole suite finds a drift where there is none.
    versions
        What of versions, processor and code differs from those that made the references, a line each.
    """

    suite: str
    false_alarm_rate: float
    versions: tuple[str, ...]
    scenes: tuple[SceneCheck, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing drifted."""
        return all(scene.holds for scene in self.scenes)

    def record(self) -> dict[str, Any]:
        """Return this as one JSON object."""
        return {
            "format": 1,
            "suite": self.suite,
            "holds": self.holds,
            "false_alarm_rate": self.false_alarm_rate,
            "versions_changed": list(self.versions),
            "scenes": {
                scene.name: {
                    "holds": scene.holds,
                    "changes": list(scene.changes),
                    "findings": [asdict(finding) for finding in scene.findings],
                }
                for scene in self.scenes
            },
        }


@dataclass(frozen=True, eq=False)
class Update:
    """What an update did.

    Attributes
    ----------
    made, kept, removed
        Scenes whose references are new, as they were, and gone.
    before
        What a check against the old references said, of the scenes that had any.
    old, new
        The references of the scenes that were made anew, before (where there were any) and after.
    """

    reason: str
    made: tuple[str, ...]
    kept: tuple[str, ...]
    removed: tuple[str, ...]
    before: Check
    old: Mapping[str, Reference]
    new: Mapping[str, Reference]

    @property
    def changed(self) -> bool:
        """Whether anything was written."""
        return bool(self.made or self.removed)


def percent(value: float, *, signed: bool = False) -> str:
    """Write a relative change with two digits; what is infinite in words."""
    if not math.isfinite(value):
        return "light where there was none"
    size = abs(100.0 * value)
    digits = 0 if size >= 9.95 or size == 0.0 else min(max(1, 1 - math.floor(math.log10(1.005 * size))), 7)
    text = f"{100.0 * value:+.{digits}f} %" if signed else f"{100.0 * value:.{digits}f} %"
    return text.replace("-", "−")
