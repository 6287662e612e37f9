"""The observer turns and drives between the frames of a set: what they say in the body axes of one time.

Rays of cameras that expose one after the other meet only there: at half a radian per second 10 ms turn them
by 5 mrad, some pixels. A measurement leaves in the axes of its own time, as one of a single camera does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.odometry import poses_at
from perception.rig.sightings import Sightings
from perception.types import Measurement, Odometry

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OneTime:
    """Sightings in the body axes of one time, and when that is; without odometry, of each its own."""

    sightings: Sightings
    time_s: float
    odometry: tuple[Odometry, ...]

    def back(self, measurements: Sequence[Measurement]) -> tuple[Measurement, ...]:
        """Return measurements in the body axes of their own times."""
        if not (self.odometry and measurements):
            return tuple(measurements)
        times_s = np.array([one.time_s for one in measurements])
        turn, moved_m = _from(times_s, self.time_s, self.odometry)
        origin_m = np.array([one.origin_body_m for one in measurements])
        bearing = np.array([one.bearing_body for one in measurements])
        origin_m = np.einsum("kji,kj->ki", turn, origin_m - moved_m)
        bearing = np.einsum("kji,kj->ki", turn, bearing)
        rows = zip(measurements, origin_m.tolist(), bearing.tolist(), strict=True)
        return tuple(replace(one, origin_body_m=tuple(o), bearing_body=tuple(b)) for one, o, b in rows)


def at_one_time(sightings: Sightings, odometry: Sequence[Odometry]) -> OneTime:
    """Carry sightings to the mean of their times by what the observer knows of its own motion.

    What it does not know counts where two cameras are compared. Between two records, each wrong by σ, a pose
    goes astray by √2 σ times the share of that time which passes from one sighting to the other, here at most
    from the first to the last; half of its variance is put down to either. All alike, so that a place and
    its time lean on them alike, and what is astray is taken off again on the way back.
    """
    rays = sightings.rays
    if not len(odometry) or not len(rays.time_s) or np.ptp(rays.time_s) == 0.0:
        return OneTime(sightings, float("nan"), ())
    time_s = float(rays.time_s.mean())
    odometry = _around(rays.time_s, odometry)
    turn, moved_m = _from(rays.time_s, time_s, odometry)
    here = rays._replace(
        origin_m=np.einsum("kij,kj->ki", turn, rays.origin_m) + moved_m,
        axes=np.einsum("kij,kaj->kai", turn, rays.axes),
    )
    newest, apart_s = odometry[-1], float(np.ptp(rays.time_s))
    gaps_s = np.diff([record.time_s for record in odometry])
    between_s = float(np.min(gaps_s[gaps_s > 0.0], initial=np.inf)) if (gaps_s > 0.0).any() else 0.0
    share2 = min(apart_s / between_s, 1.0) ** 2 if between_s > 0.0 else 0.0
    turned_rad2 = share2 * newest.rotation_sigma_rad**2 + newest.rotation_walk_rad_per_sqrt_s**2 * apart_s
    shaken_m2 = share2 * newest.position_sigma_m**2 + newest.position_walk_m_per_sqrt_s**2 * apart_s
    shaken2 = shaken_m2 / np.where(np.isfinite(rays.range_m), rays.range_m, 1.0) ** 2
    together = here._replace(
        angular_rad2=rays.angular_rad2 + (turned_rad2 + shaken2)[:, None, None] * np.eye(2),
        noise=np.sqrt(rays.noise**2 + shaken2),
    )
    return OneTime(replace(sightings, rays=here, together=together), time_s, tuple(odometry))


def _around(times_s: Array, odometry: Sequence[Odometry]) -> Sequence[Odometry]:
    """Return the records between which times lie, two at least: others are of no use, and cost time."""
    known_s = np.array([record.time_s for record in odometry])
    first = int(np.searchsorted(known_s, times_s.min(), side="right")) - 1
    last = int(np.searchsorted(known_s, times_s.max(), side="right"))
    first, last = min(max(first, 0), max(len(known_s) - 2, 0)), max(last, min(1, len(known_s) - 1))
    return odometry[first : last + 1]


def _from(times_s: Array, time_s: float, odometry: Sequence[Odometry]) -> tuple[Array, Array]:
    """Return what takes body axes of some times to another: rotations (n, 3, 3), then shifts (n, 3)."""
    poses = poses_at(odometry, np.append(times_s, time_s))
    back = poses.rotation[-1].T
    return back @ poses.rotation[:-1], (poses.position_m[:-1] - poses.position_m[-1]) @ back.T
