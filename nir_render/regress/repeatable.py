"""Whether the same input gives the same bits twice in a row, whatever made the reference."""

from collections.abc import Mapping, Sequence

from nir_render.regress.findings import Finding
from nir_render.regress.make import FrameSetting, detections_of, electrons_of, frame_of
from nir_render.regress.reference import Reference, ReferenceShot
from nir_render.scene.scene import Scene
from perception import Detection

TakenFrame = tuple[FrameSetting, ReferenceShot]
FoundByEstimator = Mapping[str, tuple[Detection, ...]]


def check_repeatable(
    scene: Scene, reference: Reference, taken: Sequence[TakenFrame], found: FoundByEstimator
) -> Finding:
    """Compute electrons, frames and detections of the reference's input two times, and compare their bits.

    `taken` are the frames, each with its setting, whose light and size fit the scene's camera; `found` what
    the estimators have found in the reference's frames the first time.
    """
    one, other = (_computed_bits(scene, reference, taken) for _ in range(2))
    again = detections_of([shot.frame for shot in reference.shots], reference.calibrations)
    for made, hits in ((one, found), (other, again)):
        # NaN is not equal to itself, but reads the same.
        made |= {f"detections of {estimator}": repr(hits[estimator]).encode() for estimator in hits}
    unlike = [what for what in one if one[what] != other[what]]
    return Finding(
        "camera",
        "electrons, frames, detections: computed twice",
        "fail" if unlike else "pass",
        f"other bits the second time: {', '.join(unlike)}" if unlike else "equal",
        "one bit",
        same_bits=not unlike,
    )


def _computed_bits(scene: Scene, reference: Reference, taken: Sequence[TakenFrame]) -> dict[str, bytes]:
    made = {}
    for setting, shot in taken:
        label = f"{setting.camera} {setting.index}"
        light = reference.lights[shot.light].light
        made[f"{label} electrons"] = electrons_of(scene, setting, light).tobytes()
        _, camera = scene.camera(setting.camera)
        frame = frame_of(camera, setting, shot.electrons, reference.seed)
        made[f"{label} frame"] = frame.data_dn.tobytes()
    return made
