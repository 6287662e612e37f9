"""Poses of cameras, and places of sources, that make bearings and ranges of shared flares likeliest.

A flare is seen by two cameras or more, each with a bearing e and the logarithm of a range. Unknown are each
camera's pose but the first one's, a place for every flare, and errors that ranges share: one for each camera
(its K), one for all sources and one for each of them (its flux), in units of their σ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.rig.rays import FARTHEST_M, NEAREST_M

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

IMPROBABLE = 4e-6
"""A flare of a χ² less probable is not of one source."""

_STEPS = 30
_SETTLED2 = 1e-8
_PER_CAMERA = 7  # turn, shift, error of K
_FIXED = 1e-9


@dataclass(frozen=True, eq=False)
class Pose:
    """How a camera stands otherwise than was said: a rotation vector and a displacement in body axes."""

    turned_rad: Array
    shifted_m: Array

    @property
    def rotation(self) -> Array:
        """The rotation, shape (3, 3)."""
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_rotvec(self.turned_rad).as_matrix())


@dataclass(frozen=True, eq=False)
class SharedFlares:
    """Sightings of flares that several cameras see, m of them, as the poses of old have them.

    Attributes
    ----------
    keys
        Which detections each flare is of.
    flare, camera
        Of each sighting: its flare and camera, counted from 0, shape (m,).
    origin_m, axes
        Camera centres, shape (m, 3); left, up and along each bearing, as rows, shape (m, 3, 3).
    angular_rad2
        Covariance of the angles to the left and upwards, shape (m, 2, 2).
    range_m, noise
        Range, NaN where it is not known, and the standard deviation of its logarithm, shape (m,).
    of_camera, of_source
        Standard deviation of that by the camera's K, and by the source, shape (m,).
    """

    keys: tuple[tuple[object, ...], ...]
    flare: Indices
    camera: Indices
    origin_m: Array
    axes: Array
    angular_rad2: Array
    range_m: Array
    noise: Array
    of_camera: Array
    of_source: Array

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def whitening(self) -> Array:
        """What turns residuals into ones of unit variance, shape (m, 3, 3)."""
        whiten = np.zeros((len(self.flare), 3, 3))
        # With C⁻¹ = L Lᵀ the residual r becomes Lᵀ r.
        lower = np.linalg.cholesky(np.linalg.inv(self.angular_rad2))
        whiten[:, :2, :2] = np.swapaxes(lower, 1, 2)
        whiten[:, 2, 2] = 1.0 / self.noise
        return whiten


@dataclass(frozen=True, eq=False)
class PoseFit:
    """What was fitted.

    `poses` are by camera; `covariance` is that of all that is common: of each camera turn, shift and the
    error of its K, then the sources' error. `used` says which flares agree with the rest, shape (flares,);
    `chi2` and `freedom` are of these.
    """

    poses: tuple[Pose, ...]
    covariance: Array
    used: NDArray[np.bool_]
    chi2: float
    freedom: int

    def covariance_of(self, camera: int) -> Array:
        """Return the covariance of a camera's turn and shift, shape (6, 6)."""
        at = _PER_CAMERA * camera
        return self.covariance[at : at + 6, at : at + 6]


def fit_poses(
    flares: SharedFlares, turn_rad: Array, shift_m: Array, start: Sequence[Pose], *, robust: bool
) -> PoseFit:
    """Fit the poses of cameras by Gauss–Newton; the places are eliminated (Schur's complement).

    Parameters
    ----------
    flares
        What is shared.
    turn_rad, shift_m
        σ of what is known of each pose beforehand, per axis, shape (cameras,); 0 is known exactly.
    start
        Poses to start from.
    robust
        Weigh flares by Cauchy's function of their χ², and refuse none.
    """
    from scipy.special import chdtri

    cameras = len(turn_rad)
    prior = np.ones(_PER_CAMERA * cameras + 1)
    for camera in range(cameras):
        at = _PER_CAMERA * camera
        prior[at : at + 3] = max(turn_rad[camera], _FIXED) ** -2.0
        prior[at + 3 : at + 6] = max(shift_m[camera], _FIXED) ** -2.0
    rows = np.bincount(flares.flare, minlength=len(flares))
    ranged = np.bincount(flares.flare, np.isfinite(flares.range_m), minlength=len(flares)).astype(int)
    freedom = 2 * rows + ranged - 3
    gate_chi2 = chdtri(np.maximum(freedom, 1), IMPROBABLE)
    state = _State(list(start), np.zeros(cameras), 0.0, _placed(flares, start), np.zeros(len(flares)))
    weight = np.ones(len(flares))
    for _ in range(_STEPS):
        step = _step(flares, state, prior, weight)
        state = _stepped(state, step)
        chi2 = _chi2(flares, state)
        if robust:
            scale = np.maximum(freedom, np.median(chi2))
            weight = 1.0 / (1.0 + chi2 / scale)
        else:
            weight = (chi2 <= gate_chi2).astype(float)
        if float((step.common**2 / np.diagonal(step.covariance)).max()) < _SETTLED2:
            break
    used = weight > 0.0
    common = int((np.diagonal(step.covariance) * prior < 0.5).sum())
    return PoseFit(
        poses=tuple(state.poses),
        covariance=step.covariance,
        used=used,
        chi2=float(chi2[used].sum()),
        freedom=int(freedom[used].sum()) - common,
    )


@dataclass(frozen=True, eq=False)
class _State:
    poses: list[Pose]
    of_cameras: Array
    of_sources: float
    place_m: Array
    of_source: Array


@dataclass(frozen=True, eq=False)
class _Step:
    common: Array
    own: Array
    covariance: Array


def _placed(flares: SharedFlares, poses: Sequence[Pose]) -> Array:
    """Return where to start each flare: along its first ranged bearing, or at a usual range."""
    place_m = np.zeros((len(flares), 3))
    turn = np.array([pose.rotation for pose in poses])[flares.camera]
    shift = np.array([pose.shifted_m for pose in poses])[flares.camera]
    range_m = np.clip(np.nan_to_num(flares.range_m, nan=3.0), NEAREST_M, FARTHEST_M)
    along = np.einsum("mij,mj->mi", turn, flares.axes[:, 2])
    at_m = flares.origin_m + shift + range_m[:, None] * along
    order = np.argsort(flares.noise)[::-1]  # the surest last: it stays
    place_m[flares.flare[order]] = at_m[order]
    return place_m


def _residuals(flares: SharedFlares, state: _State) -> tuple[Array, Array, Array, Array]:
    """Return residuals, shape (m, 3), axes turned as the poses are, and from cameras to places; how far."""
    turn = np.array([pose.rotation for pose in state.poses])[flares.camera]
    shift = np.array([pose.shifted_m for pose in state.poses])[flares.camera]
    axes = flares.axes @ np.swapaxes(turn, 1, 2)
    from_m = state.place_m[flares.flare] - flares.origin_m - shift
    range_m = np.linalg.norm(from_m, axis=1)
    towards = np.einsum("mij,mj->mi", axes, from_m)
    off = np.empty((len(range_m), 3))
    off[:, :2] = -towards[:, :2] / range_m[:, None]
    said_m = np.where(np.isfinite(flares.range_m), flares.range_m, range_m)
    errors = flares.of_camera * state.of_cameras[flares.camera]
    errors = errors + flares.of_source * (state.of_sources + state.of_source[flares.flare])
    off[:, 2] = np.where(np.isfinite(flares.range_m), np.log(said_m / range_m) - errors, 0.0)
    return off, axes, from_m, range_m


def _chi2(flares: SharedFlares, state: _State) -> Array:
    off, *_ = _residuals(flares, state)
    white = np.einsum("mij,mj->mi", flares.whitening, off)
    return np.bincount(flares.flare, (white**2).sum(axis=1), len(flares)) + state.of_source**2


def _step(flares: SharedFlares, state: _State, prior: Array, weight: Array) -> _Step:
    """Return the step of Gauss–Newton, and the covariance of what is common."""
    off, axes, from_m, range_m = _residuals(flares, state)
    # Derivatives of what is expected: by the place, by the flare's own error, by what is common.
    by_place = np.empty((len(off), 3, 4))
    by_place[:, :2, :3] = axes[:, :2] / range_m[:, None, None]
    by_place[:, 2, :3] = from_m / range_m[:, None] ** 2
    by_place[:, :2, 3], by_place[:, 2, 3] = 0.0, flares.of_source
    by_common = np.zeros((len(off), 3, len(prior)))
    at = _PER_CAMERA * flares.camera
    row = np.arange(len(off))
    for k in range(3):
        unit = np.eye(3)[k]
        # The camera turns by δ: the place turns back by it, −δ × (p − o).
        by_common[row, :2, at + k] = np.einsum(
            "mij,mj->mi", axes[:, :2], -np.cross(unit, from_m)
        ) / range_m[:, None]  # fmt: skip
        by_common[row, :, at + 3 + k] = -by_place[:, :, k]
    by_common[row, 2, at + 6] = flares.of_camera
    by_common[:, 2, -1] = flares.of_source
    ranged = np.isfinite(flares.range_m)
    by_place[~ranged, 2, 3] = by_common[~ranged, 2] = 0.0
    root = np.sqrt(weight)[flares.flare][:, None, None] * flares.whitening
    own, common = root @ by_place, root @ by_common
    white = np.einsum("mij,mj->mi", root, off)
    of_own = np.zeros((len(flares), 4, 4))
    between = np.zeros((len(flares), 4, len(prior)))
    own_score = np.zeros((len(flares), 4))
    np.add.at(of_own, flares.flare, np.swapaxes(own, 1, 2) @ own)
    np.add.at(between, flares.flare, np.swapaxes(own, 1, 2) @ common)
    np.add.at(own_score, flares.flare, np.einsum("mij,mi->mj", own, white))
    of_own[:, 3, 3] += 1.0
    own_score[:, 3] -= state.of_source
    of_own[weight == 0.0, :3, :3] += np.eye(3)
    value = np.concatenate([
        *(
            [*pose.turned_rad, *pose.shifted_m, error]
            for pose, error in zip(state.poses, state.of_cameras, strict=True)
        ),
        [state.of_sources],
    ])  # fmt: skip
    information = np.einsum("mij,mik->jk", common, common) + np.diag(prior)
    score = np.einsum("mij,mi->j", common, white) - prior * value
    solved = np.linalg.solve(of_own, between)
    information -= np.einsum("gij,gik->jk", between, solved)
    score -= np.einsum("gij,gi->j", solved, own_score)
    covariance = np.linalg.inv(information)
    change = covariance @ score
    own_change = np.linalg.solve(of_own, own_score[:, :, None])[:, :, 0] - solved @ change
    return _Step(change, own_change, covariance)


def _stepped(state: _State, step: _Step) -> _State:
    poses = []
    for camera, pose in enumerate(state.poses):
        turn, shift = step.common[_PER_CAMERA * camera :][:3], step.common[_PER_CAMERA * camera + 3 :][:3]
        poses.append(Pose(_turned(pose, turn), pose.shifted_m + shift))
    of_cameras = state.of_cameras + step.common[_PER_CAMERA - 1 : -1 : _PER_CAMERA]
    return _State(
        poses,
        of_cameras,
        state.of_sources + float(step.common[-1]),
        state.place_m + step.own[:, :3],
        state.of_source + step.own[:, 3],
    )


def _turned(pose: Pose, turn_rad: Array) -> Array:
    from scipy.spatial.transform import Rotation

    further = Rotation.from_rotvec(turn_rad) * Rotation.from_rotvec(pose.turned_rad)
    return np.asarray(further.as_rotvec())
