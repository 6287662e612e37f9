"""What a tracker may be told: how robots move, how they blink, when a track begins and ends."""

from dataclasses import dataclass
from typing import Literal

Form = Literal["sound", "paper"]
"""Ours, or what the paper says, for comparison."""


@dataclass(frozen=True)
class TrackerSettings:
    """How a `Tracker` takes the world to be; the defaults suit robots of the paper's kind.

    Attributes
    ----------
    filter
        The update: `sound` (full-rank noise at the predicted range, Joseph form, consider states), or the
        `paper`'s (its singular noise plus `paper_epsilon_m2`, at the measured range).
    association
        `sound`: likelihood ratios against clutter; `paper`: C_IoU + C_θ + w_d (1 − exp(−|Δd|)).
    overlap
        What two tracks do that share one flare: `sound`: each is fed its bearing with inflated noise where
        the range says that it is light of both; `paper`: the one of the nearest depth takes it ("distinct
        radiometric signatures"), the other goes on by prediction.
    acceleration_psd_m2_per_s3
        Power spectral density q of the white acceleration, per axis.
    swerve_m_per_s
        By how much a velocity may change at once, standard deviation per axis: robots turn on the spot.
    speed_sigma_m_per_s
        What is known of a robot's velocity, per axis, before it is seen to move.
    life_s
        A confirmed track that is unseen for longer dies. The longest dark run of a message leaves 0.967 s
        between lit samples at 30 FPS (docs/physics.md, Tracking).
    merged_life_s
        A track that for so long was seen only together with another dies, as it may never have been one;
        one that was seen alone for longer lives for as long, up to ten times this.
    tentative_life_s
        The same as `life_s`, for a track that is not yet confirmed, at most.
    unseen_cost_per_s
        By how much each unseen second lowers the log-odds that a tentative track is of a source: dark bits
        of 0.1 s are common, long runs of them are not.
    confirm_odds
        Log-odds against chance at which a track is confirmed (Wald's sequential test).
    confirm_hits
        And how often it must have been seen.
    seen_probability
        That a lit source is measured in a set.
    gate_chi2
        Measurements farther off are of another source.
    direction_weight
        Cost of a turn by 180 degrees against the direction so far (OC-SORT's momentum), in log-odds.
    resolution_rad
        Flares nearer to each other may merge into one.
    clutter_solid_angle_sr
        Into which false detections fall: what all cameras see.
    late_s
        A set that is older than the newest by more than this says that the clock was set back.
    bearing_sigma_rad, range_sigma_relative, range_common_relative
        Errors of measurements that claim none.
    range_guess_m, range_guess_sigma_m
        Where a source is taken to be that is seen without a range.
    paper_epsilon_m2
        What makes the paper's noise covariance regular.
    paper_box_rad
        Side of the box around a flare, for the paper's overlap.
    paper_depth_weight
        The paper's w_d.
    """

    filter: Form = "sound"
    association: Form = "sound"
    overlap: Form = "sound"
    acceleration_psd_m2_per_s3: float = 0.05
    swerve_m_per_s: float = 0.3
    speed_sigma_m_per_s: float = 0.5
    life_s: float = 1.25
    merged_life_s: float = 3.0
    tentative_life_s: float = 1.0
    unseen_cost_per_s: float = 10.0
    confirm_odds: float = 16.0
    confirm_hits: int = 3
    seen_probability: float = 0.7
    gate_chi2: float = 25.0
    direction_weight: float = 0.2
    resolution_rad: float = 0.008
    clutter_solid_angle_sr: float = 8.0
    late_s: float = 1.0
    bearing_sigma_rad: float = 2e-3
    range_sigma_relative: float = 0.05
    range_common_relative: float = 0.05
    range_guess_m: float = 3.0
    range_guess_sigma_m: float = 2.0
    paper_epsilon_m2: float = 1e-6
    paper_box_rad: float = 0.01
    paper_depth_weight: float = 1.0
