"""Where a robot stands and whither it heads, from the flares of its sources: model, bound, posterior.

Unknown are the robot's place (three coordinates) and its heading about z: robots are taken to stand upright,
their z axes along the observer's. A flare says two angles and the logarithm of a range, once for each camera
that sees it. Errors that flares share (range constant, the camera's pose) are part of one joint covariance.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.types import Layout

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

COARSE = 72
"""Headings at which the posterior is looked at first. It is a smooth function of sine and cosine."""

MERGED = 0.1
"""Two modes with a valley between them of more than this share of the lower are one hypothesis."""

LEAST_ODDS = 1e-6
"""Hypotheses below are left out."""

LEAST_COSINE = 0.5
"""A source more than 60 degrees off its bearing is not what is seen."""

_STEPS, _STEPS_NEAR = 4, 3
_WITHIN_SIGMAS = np.linspace(-6.0, 6.0, 25)
_WORTH_CHI2 = 30.0
_FINEST_CHI2 = 6.0
_BISECTIONS = 4
_REFINING = 8


@dataclass(frozen=True, eq=False)
class Sights:
    """What is seen of some sources, n sightings.

    Attributes
    ----------
    origin_m
        Camera centres, shape (n, 3).
    axes
        Left, up and along each bearing, as rows, shape (n, 3, 3).
    log_range
        Logarithm of the range (m) by the range constant, shape (n,).
    by_flux
        The share of that range which comes of flux and not of size, shape (n,).
    own
        Covariance of left, up (rad) and logarithm of range, by noise of each sighting, shape (n, 3, 3).
    shared
        What errors of one σ that sightings share do to them, shape (3 n, errors).
    constant
        What the error of the range constant does to the logarithms, at one σ, shape (n,).
    """

    origin_m: Array
    axes: Array
    log_range: Array
    by_flux: Array
    own: Array
    shared: Array
    constant: Array

    def some(self, rows: Indices) -> "Sights":
        """Return some of the sightings."""
        three = (3 * rows[:, None] + np.arange(3)).ravel()
        return Sights(
            self.origin_m[rows], self.axes[rows], self.log_range[rows], self.by_flux[rows], self.own[rows],
            self.shared[three], self.constant[rows],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Mode:
    """One peak of the posterior of a pose: its share, the mean, and the covariance of x, y, z, heading."""

    share: float
    position_m: Array
    heading_rad: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """Peaks of a pose, the logarithm of the evidence (per m³ of prior density), and the least χ²."""

    modes: tuple[Mode, ...]
    log_evidence: float
    chi2: float


class PoseModel:
    """The likelihood of a pose, given which source of a layout each sighting shows.

    `source`, shape (n,), says for each sighting which source of the layout it is.
    """

    def __init__(self, sights: Sights, layout: Layout, source: Indices) -> None:
        self._arm_m = np.array(layout.places_body_m)[source]
        self._sights = sights
        log_flux = np.log(np.array(layout.relative_flux)[source])
        log_range = sights.log_range + 0.5 * sights.by_flux * log_flux
        # A range that is not known has a σ that makes it count for nothing.
        self._log_range = np.where(np.isnan(log_range), np.nanmean(log_range), log_range)
        covariance = joint_covariance(sights, layout, source)
        root = np.linalg.cholesky(covariance)
        self._white = np.linalg.inv(root)
        n = len(covariance)
        self._log_norm = -0.5 * n * math.log(2.0 * math.pi) - float(np.log(np.diag(root)).sum())

    def _turned(self, heading_rad: Array) -> tuple[Array, Array]:
        """Return the sources from the robot's origin, and how they move as it turns: (b, n, 3) each."""
        cosine, sine = np.cos(heading_rad)[:, None], np.sin(heading_rad)[:, None]
        x, y, z = self._arm_m.T
        up = np.broadcast_to(z, (len(heading_rad), len(z)))
        arm = np.stack([cosine * x - sine * y, sine * x + cosine * y, up], -1)
        return arm, np.stack([-arm[..., 1], arm[..., 0], np.zeros_like(arm[..., 0])], -1)

    def whitened(self, position_m: Array, heading_rad: Array) -> tuple[Array, Array]:
        """Return residuals of unit variance, shape (b, 3 n), and slopes, shape (b, 3 n, 4), at b poses."""
        arm, swing = self._turned(heading_rad)
        from_m = position_m[:, None] + arm - self._sights.origin_m
        range_m = np.linalg.norm(from_m, axis=-1, keepdims=True)
        along = from_m / range_m
        off = np.einsum("nak,bnk->bna", self._sights.axes[:, :2], along)
        forward = np.einsum("nk,bnk->bn", self._sights.axes[:, 2], along)
        slope = np.empty((*off.shape[:2], 3, 4))
        across = self._sights.axes[:, :2] - off[..., None] * along[..., None, :]
        slope[..., :2, :3] = across / range_m[..., None]
        slope[..., 2, :3] = along / range_m
        slope[..., 3] = np.einsum("bnck,bnk->bnc", slope[..., :3], swing)
        # Straight behind the camera both angles' sines are 0 again, which is no fit.
        off[..., 0] += np.where(forward < LEAST_COSINE, 1.0 - forward, 0.0)
        seen = np.concatenate([-off, self._log_range[:, None] - np.log(range_m)], axis=-1)
        b, n = off.shape[:2]
        return seen.reshape(b, 3 * n) @ self._white.T, self._white @ slope.reshape(b, 3 * n, 4)

    def information(self, position_m: Array, heading_rad: float) -> Array:
        """Return Fisher's information of x, y, z (m) and heading (rad) at a pose, shape (4, 4)."""
        _, slope = self.whitened(position_m[None], np.array([heading_rad]))
        return np.asarray(slope[0].T @ slope[0])

    def _placed(
        self, heading_rad: Array, middle_m: Array | None = None, steps: int = _STEPS
    ) -> tuple[Array, Array, Array]:
        """Return the best place at each heading, χ² there, and the place's information.

        `middle_m` is about where the middle of the flares is: it hardly moves as the robot turns.
        """
        if middle_m is None:
            seen_m = self._sights.origin_m + np.exp(self._log_range)[:, None] * self._sights.axes[:, 2]
            middle_m = seen_m.mean(axis=0)
        place_m = middle_m - self._turned(heading_rad)[0].mean(axis=1)
        for _ in range(steps):
            residual, slope = self.whitened(place_m, heading_rad)
            slope = slope[..., :3]
            information = np.swapaxes(slope, 1, 2) @ slope
            score = np.swapaxes(slope, 1, 2) @ residual[..., None]
            place_m = place_m + np.linalg.solve(information, score)[..., 0]
        residual, slope = self.whitened(place_m, heading_rad)
        slope = slope[..., :3]
        return place_m, (residual**2).sum(axis=1), np.swapaxes(slope, 1, 2) @ slope

    def _nodes(self, worth_chi2: float) -> tuple[Array, Array, Array, Array]:
        """Return headings over a turn that resolve the posterior; places, χ², informations there."""
        heading: Array = np.arange(COARSE, dtype=np.float64) * (2.0 * math.pi / COARSE)
        found = (heading, *self._placed(heading))
        chi2 = found[2]
        low = np.flatnonzero((chi2 <= np.roll(chi2, 1)) & (chi2 < np.roll(chi2, -1)))
        low = low if len(low) else np.array([int(np.argmin(chi2))])  # all alike: nothing tells the heading
        # The lowest alone matter, but on a coarse grid a narrow valley seems shallow: all are gone down.
        best, place_m = heading[low], found[1][low]
        sigma = np.full(len(low), 0.1)
        for _ in range(_REFINING):
            residual, slope = self.whitened(place_m, best)
            information = np.swapaxes(slope, 1, 2) @ slope
            information[:, range(4), range(4)] *= 1.0 + 1e-9
            information[:, 3, 3] += 1e-6  # a thousand radians: where nothing tells the heading
            step = np.linalg.solve(information, np.swapaxes(slope, 1, 2) @ residual[..., None])[..., 0]
            sigma = np.sqrt(np.linalg.inv(information)[:, 3, 3])
            short = np.minimum(1.0, 0.5 * 2.0 * math.pi / COARSE / np.maximum(np.abs(step[:, 3]), 1e-12))
            place_m, best = place_m + short[:, None] * step[:, :3], best + short * step[:, 3]
        gone_down = (self.whitened(place_m, best)[0] ** 2).sum(axis=1)
        deep = gone_down < gone_down.min() + _WORTH_CHI2
        best, place_m, sigma = best[deep], place_m[deep], np.minimum(sigma[deep], 0.2)
        if gone_down.min() > worth_chi2:
            return (best % (2.0 * math.pi), place_m, gone_down[deep], found[3][: len(best)])
        middle_m = place_m + self._turned(best)[0].mean(axis=1)
        near = (best[:, None] + sigma[:, None] * _WITHIN_SIGMAS).ravel() % (2.0 * math.pi)
        found = self._with(found, near, np.repeat(middle_m, len(_WITHIN_SIGMAS), axis=0))
        for _ in range(_BISECTIONS):
            heading, _, chi2, _ = found
            gap = np.diff(heading, append=heading[0] + 2.0 * math.pi)
            after = np.roll(chi2, -1)
            worth = np.minimum(chi2, after) < chi2.min() + _WORTH_CHI2
            rough = worth & (np.abs(after - chi2) > _FINEST_CHI2) & (gap > 1e-7)
            if not rough.any():
                break
            between = (heading + 0.5 * gap)[rough] % (2.0 * math.pi)
            middle_m = found[1][rough] + self._turned(heading[rough])[0].mean(axis=1)
            found = self._with(found, between, middle_m)
        return found

    def _with(
        self, found: tuple[Array, Array, Array, Array], heading: Array, middle_m: Array
    ) -> tuple[Array, Array, Array, Array]:
        more = (heading, *self._placed(heading, middle_m, _STEPS_NEAR))
        joined = [np.concatenate(pair) for pair in zip(found, more, strict=True)]
        _, order = np.unique(joined[0], return_index=True)
        a, b, c, d = (each[order] for each in joined)
        return a, b, c, d

    def posterior(self, worth_chi2: float = math.inf) -> Posterior | None:
        """Return the posterior of the pose, all headings and places alike beforehand.

        None where no pose has a χ² of less than `worth_chi2`.
        """
        heading, place_m, chi2, information = self._nodes(worth_chi2)
        if chi2.min() > worth_chi2:
            return None
        cut = int(np.argmax(chi2))  # a turn begins where the robot heads least
        heading, place_m, chi2, information = (
            np.roll(each, -cut, axis=0) for each in (heading, place_m, chi2, information)
        )
        heading = np.unwrap(heading)
        edges = np.concatenate([[heading[0]], 0.5 * (heading[1:] + heading[:-1]), [heading[-1]]])
        _, log_det = np.linalg.slogdet(information)
        least = float(chi2.min())
        density = np.exp(-0.5 * (chi2 - least) - 0.5 * log_det)
        mass = density * np.diff(edges)
        total = float(mass.sum())
        log_evidence = (
            self._log_norm - 0.5 * least + 1.5 * math.log(2.0 * math.pi) + math.log(total / (2.0 * math.pi))
        )
        modes = [
            self._mode(heading[part], place_m[part], information[part], mass[part], total)
            for part in _peaks(density)
            if mass[part].sum() > LEAST_ODDS * total
        ]
        modes.sort(key=lambda mode: -mode.share)
        return Posterior(tuple(modes), log_evidence, least)

    def evidence_of_place(self) -> float:
        """Return the logarithm of the evidence of a source that has no heading."""
        _, chi2, information = self._placed(np.zeros(1))
        _, log_det = np.linalg.slogdet(information[0])
        return self._log_norm - 0.5 * float(chi2[0]) - 0.5 * float(log_det) + 1.5 * math.log(2.0 * math.pi)

    @staticmethod
    def _mode(heading: Array, place_m: Array, information: Array, mass: Array, total: float) -> Mode:
        share = mass.sum()
        weight = mass / share
        pose = np.column_stack([place_m, heading])
        mean = weight @ pose
        covariance = (weight[:, None] * (pose - mean)).T @ (pose - mean)
        covariance[:3, :3] += np.tensordot(weight, np.linalg.inv(information), 1)
        angle = float((mean[3] + math.pi) % (2.0 * math.pi) - math.pi)
        return Mode(float(share / total), mean[:3], angle, covariance)


def _peaks(density: Array) -> list[slice]:
    """Return the stretches of a density that each hold one peak, valleys between them."""
    begins = [0]
    peak, low = 0, 0
    for k in range(1, len(density)):
        parted = density[low] < MERGED * min(density[peak], density[k])
        if parted:
            begins.append(low)
            peak = low = k
        elif density[k] > density[peak]:
            peak = low = k
        elif density[k] < density[low]:
            low = k
    ends = [*begins[1:], len(density)]
    return [slice(a, b) for a, b in zip(begins, ends, strict=True)]


def joint_covariance(sights: Sights, layout: Layout, source: Indices) -> Array:
    """Return the covariance of all angles and logarithms of ranges of a robot, shape (3 n, 3 n)."""
    n = len(source)
    covariance = sights.shared @ sights.shared.T
    constant = sights.constant
    if not math.isnan(layout.flux_sigma_common):
        constant = 0.5 * layout.flux_sigma_common * sights.by_flux
    ranges = 3 * np.arange(n) + 2
    covariance[np.ix_(ranges, ranges)] += np.outer(constant, constant)
    # A source's own flux is the same in each camera that sees it.
    own = 0.5 * layout.flux_sigma_own * sights.by_flux
    covariance[np.ix_(ranges, ranges)] += np.outer(own, own) * (source[:, None] == source)
    for k in range(n):
        covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += sights.own[k]
    return np.asarray(covariance)
