"""What perception says: detections, measurements of a rig, tracks, what they send."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Detection:
    """One flare found in one frame.

    `flux_dn` is the background-subtracted integral, of one that something hides in part (another source, a
    straight edge) that of the whole, as `range_m` is; `mean_dn` the mean grey value over the blob as read
    (black level included), `background_dn` the local background as read. `range_sigma_m` and the pixel
    sigmas are what the estimator claims; NaN where it makes no claim. `range_m` is NaN where no range
    could be had, and a lower bound of the flux (so an upper bound of the range) where `saturated` and not
    recovered. `bearing_body` is the unit vector from the camera's centre in body axes. `flux_sigma_dn` is the
    flux's standard deviation. `range_sigma_common_m` is the part of `range_sigma_m` that measurements of one
    source share, in whatever frame or camera: by range constant, the robot's own flux, the source's radius.
    Where the calibration does not exclude fog, `range_by_size_m` and its σ are what size alone says; NaN for
    a source too far to tell.
    """

    camera: str
    index: int
    time_s: float
    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_dn: float
    mean_dn: float
    background_dn: float
    area_px: int
    saturated: bool
    merged: bool
    ghost: bool
    range_m: float
    range_sigma_m: float
    bearing_body: tuple[float, float, float]
    flux_sigma_dn: float = math.nan
    range_sigma_common_m: float = math.nan
    range_by_size_m: float = math.nan
    range_by_size_sigma_m: float = math.nan


class Detections(list[Detection]):
    """The flares of one frame, and what is to be known of them as a whole.

    Attributes
    ----------
    reason
        Why it is empty, in words; "" where it is not, or where the estimator does not say.
    truncated
        Whether more was seen than was measured: time was up, or there were too many, in the frame or in one
        place. The brightest are kept.
    range_doubt
        How far, relatively, its ranges may be off, in the median of those that are doubted, because sizes
        and fluxes of near sources, or the width of small ones, contradict the calibration; 0 where none shows
        it, and where fog is not excluded. Their σ cover it, of a single such source its own; upper bounds
        are so much farther.
    psf_width_off
        By about what share small flares are wider than the calibration's point spread makes them, or
        narrower if below 0; 0 where nothing shows it.
    psf_width_seen
        The same share as this frame alone sees it, noise or not, and its σ, infinite where it sees nothing:
        frames of a recording tell together what none tells alone.
    swept_px
        How far flares that rest are swept over the image while it is exposed, in their median, as the camera
        turns; 0 where they tell of no turn. They are fitted as drawn out by it.
    """

    def __init__(
        self,
        found: Iterable[Detection] = (),
        *,
        reason: str = "",
        truncated: bool = False,
        range_doubt: float = 0.0,
        psf_width_off: float = 0.0,
        psf_width_seen: tuple[float, float] = (0.0, math.inf),
        swept_px: float = 0.0,
    ) -> None:
        super().__init__(found)
        self.reason, self.truncated = reason, truncated
        self.range_doubt, self.psf_width_off = range_doubt, psf_width_off
        self.psf_width_seen, self.swept_px = psf_width_seen, swept_px

    def replaced_by(self, now: Iterable[Detection]) -> "Detections":
        """Return others in their place, with what is known of these as a whole."""
        told = Detections(now)
        told.__dict__.update(self.__dict__)
        return told


Ghost = Literal["no", "possible", "yes"]
"""Whether something is the mirror image of a robot."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """One source, as all cameras of a rig saw it in one set of frames.

    Attributes
    ----------
    robot
        The observer's name.
    time_s
        Mid-exposure, the mean over its detections weighted by how well each places it.
    cameras
        Those that saw it, each once.
    detections
        Of which detections it is made: camera, index of the frame, place among that frame's detections.
    origin_body_m
        The point that bearing and range count from, in body axes: the camera's centre, of several their mean.
    bearing_body
        Unit vector from there, in body axes.
    range_m
        Distance from there; NaN where no detection has a range, or only a bound of it.
    covariance
        Of the bearing's angle to the left (about the body's z), its angle upwards, and the range, in rad²,
        rad m and m², shape (3, 3); NaN where no σ is claimed.
    range_sigma_common_m
        The part of the range's σ that every measurement of this source shares.
    saturated, merged
        Whether one of its detections is.
    ghost
        Whether it is a mirror image: `yes` where mirror images of several robots, or of the observer itself,
        agree on one plane; `possible` where no more than chance speaks for or against it.
    ghost_probability
        What geometry and brightness say of that, from 0 to 1.
    """

    robot: str
    time_s: float
    cameras: tuple[str, ...]
    detections: tuple[tuple[str, int, int], ...]
    origin_body_m: tuple[float, float, float]
    bearing_body: tuple[float, float, float]
    range_m: float
    covariance: NDArray[np.float64]
    range_sigma_common_m: float
    saturated: bool
    merged: bool
    ghost: Ghost = "no"
    ghost_probability: float = 0.0

    @property
    def position_body_m(self) -> NDArray[np.float64]:
        """Where it is, from the body's origin, shape (3,)."""
        return np.asarray(self.origin_body_m) + self.range_m * np.asarray(self.bearing_body)

    @property
    def axes_body(self) -> NDArray[np.float64]:
        """Unit vectors to the left, upwards and along the bearing, as rows, shape (3, 3)."""
        return bearing_axes(np.asarray(self.bearing_body))

    @property
    def position_covariance_m2(self) -> NDArray[np.float64]:
        """Covariance of `position_body_m`, shape (3, 3)."""
        scaled = self.axes_body * np.array([self.range_m, self.range_m, 1.0])[:, None]
        return np.asarray(scaled.T @ self.covariance @ scaled)


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """A flat mirror that a set of measurements shows: n · x = c in body axes.

    Attributes
    ----------
    normal_body
        Unit vector n from the observer to the mirror.
    distance_m
        c, from the body's origin.
    kind
        `constant` reflectance, as metal has; `surface` or `pane`: one side of a dielectric, or both of it.
    parameter
        The reflectance of a `constant` one, the refractive index of the others.
    covariance
        Of the normal's angles to the left and upwards (rad), of the distance (m) and of the parameter,
        shape (4, 4).
    images
        How many mirror images it explains.
    """

    normal_body: tuple[float, float, float]
    distance_m: float
    kind: Literal["constant", "surface", "pane"]
    parameter: float
    covariance: NDArray[np.float64]
    images: int


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """One way in which a robot may stand.

    Attributes
    ----------
    odds
        How probable it is, given that the flares are one robot of this kind; those of a robot sum to 1.
    position_body_m
        Of the robot's origin from the observer's, in the observer's body axes.
    heading_rad
        Angle from the observer's x axis to the robot's, about z, from −π to π.
    covariance
        Of position and heading, in m², m rad, rad², shape (4, 4).
    sources
        Which source of the layout each flare is, counted from 0.
    """

    odds: float
    position_body_m: tuple[float, float, float]
    heading_rad: float
    covariance: NDArray[np.float64]
    sources: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class RobotPose:
    """A robot whose layout of sources is known, as a set shows it: upright, at any height.

    Attributes
    ----------
    robot, time_s
        The observer's name, and the mean of its flares' times.
    kind
        Whose layout it has.
    flares
        Of which measurements it is made: the first detection of each.
    group_odds
        How probable it is that these flares, and no others, are one robot of this kind.
    hypotheses
        The most probable first.
    """

    robot: str
    time_s: float
    kind: str
    flares: tuple[tuple[str, int, int], ...]
    group_odds: float
    hypotheses: tuple[PoseHypothesis, ...]


@dataclass(frozen=True, eq=False)
class SetMeasurements:
    """What a rig measures in one set of frames.

    Attributes
    ----------
    measurements
        One for each source and each mirror image.
    detections
        Of each frame, in the order of the frames: what they are made of.
    planes
        Mirrors found, and those handed in that show something.
    extinction_per_m, extinction_sigma_per_m
        Of the fog, with which ranges were corrected; NaN where it was not looked for, or the set did not
        tell it.
    robots
        Position and heading of robots with several sources, where the calibration knows their layout.
    """

    measurements: tuple[Measurement, ...]
    detections: tuple[Detections, ...]
    planes: tuple[MirrorPlane, ...] = ()
    extinction_per_m: float = math.nan
    extinction_sigma_per_m: float = math.nan
    robots: tuple[RobotPose, ...] = ()


@dataclass(frozen=True, eq=False)
class Track:
    """One source followed over time, as it is known at one time.

    Attributes
    ----------
    robot
        The observer's name.
    time_s
        When it is as said.
    track
        Its number, which it keeps for life and no other track of the observer ever has.
    position_body_m, velocity_body_m_per_s
        Where it is from the observer's origin, and how it moves over ground, in the observer's body axes at
        `time_s`, shape (3,) each.
    covariance
        Of both, in this order, in m, s: shape (6, 6).
    detections
        Of which detections its measurement is made, as in `Measurement`; empty where it was not seen (dark,
        hidden, out of view) and is predicted.
    unseen_s
        Time since it was last seen, 0 if it is.
    identity
        Who it says it is, None as long as it has not said so.
    ghost
        Whether it is a mirror image, by all that was measured of it so far.
    """

    robot: str
    time_s: float
    track: int
    position_body_m: NDArray[np.float64]
    velocity_body_m_per_s: NDArray[np.float64]
    covariance: NDArray[np.float64]
    detections: tuple[tuple[str, int, int], ...] = ()
    unseen_s: float = 0.0
    identity: str | None = None
    ghost: Ghost = "no"


@dataclass(frozen=True, eq=False)
class Signal:
    """How bright one track was over time: what a decoder reads.

    Attributes
    ----------
    robot, track
        The observer's name, and the track's number.
    time_s, exposure_s
        Mid-exposure at the source's row, increasing, and how long each exposure was, shape (n,) each. A
        dropped frame is missing.
    level
        Measured brightness over what it is when lit at the predicted place: 0 dark, about 1 lit, shape (n,).
        Between them where an edge falls into the exposure. One factor common to all (the source's own flux,
        the range constant) is not known better than to some 10 %.
    sigma_dark, sigma_lit
        Standard deviation of `level` where the source is dark, and where it is lit, shape (n,) each; infinite
        where nothing is known: hidden, out of view, merged with another.
    """

    robot: str
    track: int
    time_s: NDArray[np.float64]
    exposure_s: NDArray[np.float64]
    level: NDArray[np.float64]
    sigma_dark: NDArray[np.float64]
    sigma_lit: NDArray[np.float64]


@dataclass(frozen=True)
class Message:
    """What one source said.

    Attributes
    ----------
    robot, track
        The observer's name, and the number of the track that said it.
    start_s, end_s
        From the first start bit to the end of the last stop bit that was read.
    word
        The payload, 0 to 127.
    command
        What it means: one of the sixteen commands for 0 to 15, the ASCII character for 32 to 126.
    confidence
        The probability that it is this word.
    frames
        How many of the repetitions were read.
    identity
        Who says it, None where nobody has said so.
    ambiguous_with
        The number of another track that may have said it instead.
    """

    robot: str
    track: int
    start_s: float
    end_s: float
    word: int
    command: str
    confidence: float
    frames: int
    identity: str | None = None
    ambiguous_with: int | None = None


def bearing_axes(bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors to the left (about z), upwards and along bearings, shape (..., 3) → (..., 3, 3).

    A bearing straight up or down counts y as left.
    """
    x, y, z = bearing[..., 0], bearing[..., 1], bearing[..., 2]
    level = np.hypot(x, y)
    flat = level > 1e-12
    level = np.where(flat, level, 1.0)
    axes = np.zeros((*bearing.shape[:-1], 3, 3))
    axes[..., 0, 0] = left_x = np.where(flat, -y, 0.0) / level
    axes[..., 0, 1] = left_y = np.where(flat, x, 1.0) / level
    axes[..., 1, 0], axes[..., 1, 1] = -z * left_y, z * left_x
    axes[..., 1, 2] = x * left_y - y * left_x
    axes[..., 2, :] = bearing
    return axes
