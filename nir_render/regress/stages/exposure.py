"""Automatic exposure against its reference: what it makes of the reference's own frames.

It is arithmetic on whole counts, and no random number is in it.
"""

from collections.abc import Sequence

from nir_render.camera.timing.exposure_control import Setting
from nir_render.regress.findings import Finding
from nir_render.regress.make import choices
from nir_render.regress.reference import ReferenceShot
from nir_render.scene.scene import Scene

_ALLOWED = 1e-12  # a few float64 operations


def compare_choices(scene: Scene, shots: Sequence[ReferenceShot], *, exact: bool) -> list[Finding]:
    """Compare, for each camera, the exposures and gains chosen after its frames with those chosen before."""
    known = set(scene.all_cameras())
    taken = [shot for shot in shots if shot.frame.camera in known]
    now = choices(scene, [shot.frame for shot in taken])
    findings = []
    for name in dict.fromkeys(shot.frame.camera for shot in taken):
        own = [shot for shot in taken if shot.frame.camera == name]
        pairs = [(shot.frame.index, shot.chosen, now.get((name, shot.frame.index))) for shot in own]
        if any(before is not None or after is not None for _, before, after in pairs):
            findings.append(_finding(f"{name} automatic exposure", pairs, exact=exact))
    return findings


def _finding(
    what: str, pairs: Sequence[tuple[int, Setting | None, Setting | None]], *, exact: bool
) -> Finding:
    worst, seen = 0.0, "equal"
    for index, before, after in pairs:
        if before is None:
            words = "the reference has no choices: 'nir-render regress update --all' adds them"
            return Finding("camera", what, "skipped", words)
        if after is None:
            return Finding("camera", what, "fail", "exposure is not automatic any more")
        for unit, one, other in (
            ("exposure in s", before.exposure_s, after.exposure_s),
            ("gain", before.gain, after.gain),
        ):
            share = abs(other / one - 1.0)
            if share > worst:
                worst, seen = share, f"after frame {index}, {unit}: {one:.9g} → {other:.9g}"
    return Finding(
        "camera",
        what,
        "fail" if worst > _ALLOWED or (exact and worst > 0.0) else "pass",
        seen,
        f"{_ALLOWED:.0e} of exposure and gain",
        same_bits=worst == 0.0,
    )
