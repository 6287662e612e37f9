"""How the cameras of a robot stand to each other, from flares that two of them see at once."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.extrinsics.pose_fit import Pose, PoseFit, SharedFlares, fit_poses
from perception.files.fields import RecordingError
from perception.model.fisher import flare_limit
from perception.rig.frame_sets import Exposed
from perception.rig.fusion import associated
from perception.rig.rays import NEAREST_M
from perception.rig.sightings import CAMERAS_MOST, CAMERAS_SHARE, LEAST_NOISE, Sightings, sightings_of
from perception.types import Calibration, Detection

Array = NDArray[np.float64]

LEAST_FLARES = 12
"""So many flares must be shared before cameras are said to stand anywhere."""

ASSUMED_TURN_RAD, ASSUMED_SHIFT_M = math.radians(2.0), 0.02
"""How well poses are taken to be known beforehand where the calibration says no σ: screwed on by eye."""

_DETERMINED = 0.5
_PASSES = 8
_REFUSED = 0.2
_WIDE_CHI2 = 1.2
_SAME_PLACE_PX = 0.5


@dataclass(frozen=True, eq=False)
class CameraPose:
    """What was learned of how one camera stands.

    Attributes
    ----------
    camera
        Its name.
    flares
        How many of its flares another camera shared.
    turned_rad, shifted_m
        By how much it stands otherwise than was said: rotation vector and displacement, in body axes,
        shape (3,).
    covariance
        Of both, in this order, shape (6, 6).
    has_rotation, has_position
        Whether the flares tell them; what they do not tell stays as it was.
    """

    camera: str
    flares: int
    turned_rad: Array
    shifted_m: Array
    covariance: Array
    has_rotation: bool
    has_position: bool


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """How a robot's cameras stand to each other.

    Attributes
    ----------
    reference
        The camera whose pose stays as it was: flares tell how cameras stand to each other, not to the body.
    calibrations
        By camera: as they were, but for the poses and their σ. The σ of a rotation and of a position are
        those of one axis, root mean square over the three.
    poses
        Of all cameras but the reference.
    flares, refused
        Shared flares that were used, and those that contradict the rest (mirror images, mistaken identity).
    reduced_chi2
        Of the flares used; a σ is widened by its root where it is above 1.2.
    """

    reference: str
    calibrations: Mapping[str, Calibration]
    poses: tuple[CameraPose, ...]
    flares: int
    refused: int
    reduced_chi2: float

    @property
    def faults(self) -> list[str]:
        """Say what speaks against it, one sentence each; nothing where it holds."""
        found = []
        if self.refused > _REFUSED * (self.refused + self.flares):
            found.append(
                f"{self.refused} of {self.refused + self.flares} flares that two cameras share do not agree "
                "with the rest: are there mirrors, do sources move, are intrinsics right?"
            )
        return found

    def record(self) -> dict[str, Any]:
        """Return the numbers, as JSON has them."""
        cameras = {}
        for pose in self.poses:
            sigma = np.sqrt(np.diagonal(pose.covariance)).tolist()
            cameras[pose.camera] = {
                "flares": pose.flares,
                "turned_rad": pose.turned_rad.tolist() if pose.has_rotation else None,
                "turned_sigma_rad": sigma[:3] if pose.has_rotation else None,
                "shifted_m": pose.shifted_m.tolist() if pose.has_position else None,
                "shifted_sigma_m": sigma[3:] if pose.has_position else None,
            }
        return {
            "reference": self.reference,
            "flares": self.flares,
            "refused": self.refused,
            "reduced_chi2": self.reduced_chi2,
            "cameras": cameras,
            "faults": self.faults,
        }


FrameSet = tuple[Sequence[Exposed], Sequence[Sequence[Detection]]]
"""The frames of a set, or their records, and the detections of each."""


def calibrate_extrinsics(sets: Iterable[FrameSet], calibrations: Mapping[str, Calibration]) -> Extrinsics:
    """Learn how the cameras of one robot stand to each other.

    A flare that two cameras see is one source: two bearings and two ranges of one place, which is not known.
    Poses, places, and what ranges have in common (each camera's K, the sources' flux) are fitted at once to
    all of them, by least squares weighted by the σ that detections claim. Which flares are one is found
    with the poses as they are known, at first by their σ in the calibration (2° and 2 cm where it has none),
    and again with those just fitted; early fits weigh by Cauchy's function, the last ones leave out what lies
    beyond χ² of 4 in a million. Where a source rests in several sets, what is fixed about its pixels counts
    once. Intrinsics are taken as known, and robots as resting while a set is taken.

    Parameters
    ----------
    sets
        Of one robot's cameras.
    calibrations
        Of each of them, by its name. The first stays where it is.

    Raises
    ------
    RecordingError
        If fewer than 12 flares are shared, or there is but one camera.
    """
    said = _Said.of(sets, calibrations)
    names = said.names
    if len(names) < 2:
        raise RecordingError(f"{', '.join(names) or 'no camera'}: it takes two cameras to share flares")
    known = dict(zip(names, said.cameras, strict=True))
    priors = [_Prior.of(one, fixed=number == 0) for number, one in enumerate(said.cameras)]
    fit, shared = _fitted(said, priors)
    # A position that is hardly better known than before is none: it stays, and rotations hold for it.
    left = {k for k in range(1, len(names)) if not _tells(fit, k, priors[k])[1]}
    if left:
        priors = [prior.at_rest if k in left else prior for k, prior in enumerate(priors)]
        fit, shared = _fitted(said, priors)
    reduced = fit.chi2 / fit.freedom if fit.freedom > 0 else math.nan
    widening = reduced if reduced > _WIDE_CHI2 else 1.0
    poses = []
    for number, name in enumerate(names[1:], start=1):
        has_rotation, has_position = _tells(fit, number, priors[number])
        pose = fit.poses[number]
        poses.append(
            CameraPose(
                camera=name,
                flares=int((shared.camera[fit.used[shared.flare]] == number).sum()),
                turned_rad=pose.turned_rad,
                shifted_m=pose.shifted_m,
                covariance=widening * fit.covariance_of(number),
                has_rotation=has_rotation,
                has_position=has_position,
            )
        )
    moved = {pose.camera: _moved(known[pose.camera], pose) for pose in poses}
    used = int(fit.used.sum())
    return Extrinsics(
        reference=names[0],
        calibrations={**calibrations, **moved},
        poses=tuple(poses),
        flares=used,
        refused=len(fit.used) - used,
        reduced_chi2=reduced,
    )


@dataclass(frozen=True)
class _Prior:
    """How well a pose is known beforehand, per axis."""

    turn_rad: float
    shift_m: float

    @staticmethod
    def of(calibration: Calibration, *, fixed: bool) -> "_Prior":
        if fixed:
            return _Prior(0.0, 0.0)
        return _Prior(
            calibration.sigma.get("rotation_body_camera", ASSUMED_TURN_RAD),
            calibration.sigma.get("position_body_m", ASSUMED_SHIFT_M),
        )

    @property
    def at_rest(self) -> "_Prior":
        return replace(self, shift_m=0.0)


def _tells(fit: PoseFit, number: int, prior: _Prior) -> tuple[bool, bool]:
    """Return whether flares tell rotation and position: both are known twice as well as before, each axis."""
    sigma = np.sqrt(np.diagonal(fit.covariance_of(number)))
    return (
        bool(sigma[:3].max() < _DETERMINED * prior.turn_rad),
        prior.shift_m > 0.0 and bool(sigma[3:].max() < _DETERMINED * prior.shift_m),
    )


def _fitted(said: "_Said", priors: Sequence[_Prior]) -> tuple[PoseFit, SharedFlares]:
    """Tell which flares are one, fit, and again until that does not change."""
    turn_rad = np.array([prior.turn_rad for prior in priors])
    shift_m = np.array([prior.shift_m for prior in priors])
    poses = [Pose(np.zeros(3), np.zeros(3)) for _ in priors]
    doubt = [(prior.turn_rad, prior.shift_m) for prior in priors]
    shared = said.shared(poses, doubt)
    for number in range(_PASSES):
        if len(shared) < LEAST_FLARES:
            raise RecordingError(
                f"{said.names[0].rpartition('.')[0]}: {len(shared)} flares are in the view of two cameras, "
                f"wanted {LEAST_FLARES} or more: put sources where views overlap, turn the robot between "
                "frames, and check that cameras stand within some degrees of what calibration.json says"
            )
        fit = fit_poses(shared, turn_rad, shift_m, poses, robust=number == 0)
        poses = list(fit.poses)
        doubt = [_doubt(fit, k) for k in range(len(priors))]
        before, shared = shared, said.shared(poses, doubt)
        if number > 0 and before.keys == shared.keys:
            break
    return fit, before


def _doubt(fit: PoseFit, number: int) -> tuple[float, float]:
    sigma = np.sqrt(np.diagonal(fit.covariance_of(number)))
    return float(sigma[:3].max()), float(sigma[3:].max())


def _moved(calibration: Calibration, pose: CameraPose) -> Calibration:
    """Return a camera's calibration with what was learned of its pose."""
    if not pose.has_rotation:
        return calibration
    variance = np.diagonal(pose.covariance)
    sigma = {**calibration.sigma, "rotation_body_camera": math.sqrt(float(variance[:3].mean()))}
    position_m = calibration.position_body_m
    if pose.has_position:
        sigma["position_body_m"] = math.sqrt(float(variance[3:].mean()))
        position_m = position_m + pose.shifted_m
    turned = Pose(pose.turned_rad, pose.shifted_m).rotation @ calibration.rotation_body_camera
    return replace(calibration, rotation_body_camera=turned, position_body_m=position_m, sigma=sigma)


@dataclass(frozen=True, eq=False)
class _Said:
    """What detections of each set say, by the poses of old, which count as exact here.

    `hits` are the detections by key, `names` and `cameras` the cameras in the order of the poses.
    """

    sets: Sequence[Sightings]
    hits: Mapping[tuple[str, int, int], Detection]
    names: Sequence[str]
    cameras: Sequence[Calibration]

    @staticmethod
    def of(sets: Iterable[FrameSet], calibrations: Mapping[str, Calibration]) -> "_Said":
        plain = {
            name: replace(one, sigma={k: v for k, v in one.sigma.items() if k not in _POSE})
            for name, one in calibrations.items()
        }
        said: list[Sightings] = []
        hits: dict[tuple[str, int, int], Detection] = {}
        seen = set()
        for frames, found in sets:
            seen |= {frame.camera for frame in frames}
            kept = [[hit for hit in own if _tells_place(hit)] for own in found]
            one = sightings_of(frames, kept, plain)
            said.append(one)
            hits |= zip(one.keys, (hit for own in kept for hit in own), strict=True)
        names = [name for name in calibrations if name in seen]
        return _Said(said, hits, names, [calibrations[name] for name in names])

    def shared(self, poses: Sequence[Pose], doubt: Sequence[tuple[float, float]]) -> SharedFlares:
        """Return the flares that several cameras share, told by poses of some σ."""
        keys: list[tuple[tuple[str, int, int], ...]] = []
        rows: list[tuple[int, int, int]] = []  # set, sighting, flare
        for number, said in enumerate(self.sets):
            if not said.keys:
                continue
            for group in associated(self._now(said, poses, doubt)):
                best: dict[str, int] = {}
                for k in sorted(group.members, key=said.rays.noise.__getitem__):
                    best.setdefault(said.keys[k][0], k)
                if len(best) > 1:
                    rows += [(number, k, len(keys)) for k in best.values()]
                    keys.append(tuple(said.keys[k] for k in best.values()))
        return self._flares(rows, tuple(keys))

    def _now(self, said: Sightings, poses: Sequence[Pose], doubt: Sequence[tuple[float, float]]) -> Sightings:
        """Return sightings as cameras of other poses have them, with the σ of these."""
        camera = self._camera_of(said.keys)
        turn = np.array([pose.rotation for pose in poses])[camera]
        shift = np.array([pose.shifted_m for pose in poses])[camera]
        turn_rad, shift_m = np.array(doubt)[camera].T
        rays = said.rays
        at_m = np.where(np.isfinite(rays.range_m), rays.range_m, NEAREST_M)
        wider = (turn_rad**2 + (shift_m / at_m) ** 2)[:, None, None] * np.eye(2)
        moved = rays._replace(
            origin_m=rays.origin_m + shift,
            axes=rays.axes @ np.swapaxes(turn, 1, 2),
            angular_rad2=rays.angular_rad2 + wider,
        )
        return replace(said, rays=moved, together=moved)

    def _camera_of(self, keys: Iterable[tuple[str, int, int]]) -> NDArray[np.int64]:
        place = {name: number for number, name in enumerate(self.names)}
        return np.array([place[camera] for camera, _, _ in keys], dtype=np.int64)

    def _flares(
        self, rows: Sequence[tuple[int, int, int]], keys: tuple[tuple[tuple[str, int, int], ...], ...]
    ) -> SharedFlares:
        rays = [self.sets[number].rays for number, _, _ in rows]
        of_rows = [self.sets[number].keys[k] for number, k, _ in rows]
        hits = [self.hits[key] for key in of_rows]

        def taken(field: str, *shape: int) -> Array:
            return np.array(
                [getattr(ray, field)[k] for ray, (_, k, _) in zip(rays, rows, strict=True)]
            ).reshape(-1, *shape)

        range_m, noise2 = taken("range_m"), taken("noise") ** 2
        shared2 = np.nan_to_num([hit.range_sigma_common_m / hit.range_m for hit in hits]) ** 2
        of_camera2 = np.where(np.isfinite(range_m), np.minimum(CAMERAS_SHARE * shared2, CAMERAS_MOST**2), 0.0)
        camera = self._camera_of(of_rows)
        together = _together(hits, camera, self.cameras)
        return SharedFlares(
            keys=keys,
            flare=np.array([flare for _, _, flare in rows], dtype=np.int64),
            camera=camera,
            origin_m=taken("origin_m", 3),
            axes=taken("axes", 3, 3),
            angular_rad2=taken("angular_rad2", 2, 2) * together[:, None, None],
            range_m=range_m,
            noise=np.sqrt(np.maximum(noise2 - of_camera2, LEAST_NOISE**2) * together),
            of_camera=np.sqrt(of_camera2),
            of_source=taken("common"),
        )


_POSE = ("rotation_body_camera", "position_body_m")


def _tells_place(hit: Detection) -> bool:
    return not (hit.merged or hit.ghost) and math.isfinite(hit.u_sigma_px + hit.v_sigma_px)


def _together(
    hits: Sequence[Detection],
    camera: NDArray[np.int64],
    cameras: Sequence[Calibration],
) -> Array:
    """Return by how much variances are to grow so that n flares on the same pixels count as they should.

    1 + (n − 1) f, f the share that is fixed about pixels: their mean then has the variance (1 − f)/n + f.
    """
    factor = np.ones(len(hits))
    by_place: dict[tuple[int, ...], list[int]] = {}
    place = [(round(hit.u_px / _SAME_PLACE_PX), round(hit.v_px / _SAME_PLACE_PX)) for hit in hits]
    for row, at in enumerate(place):
        by_place.setdefault((int(camera[row]), *at), []).append(row)
    for (number, *_), members in by_place.items():
        if len(members) > 1:
            share = _fixed_share(hits[members[0]], cameras[number])
            factor[members] = 1.0 + (len(members) - 1) * share
    return factor


def _fixed_share(hit: Detection, calibration: Calibration) -> float:
    """Return which share of the variance of a flare's place is fixed about its pixels."""
    if not (hit.range_m > 0.0 and hit.flux_dn > 0.0):
        return 1.0
    gain = calibration.system_gain_dn_per_e
    background_e = max(hit.background_dn - calibration.black_level_dn, 0.0) / gain
    of_flare = (hit.u_px, hit.v_px, hit.range_m, hit.flux_dn / gain, background_e)
    ideal = replace(calibration, prnu=0.0, dsnu_e=0.0)
    bounds = [flare_limit(one, *of_flare).u_sigma_px for one in (ideal, calibration)]
    return 1.0 - min((bounds[0] / bounds[1]) ** 2, 1.0) if math.isfinite(bounds[1]) else 1.0
