"""A tracker of one's own, `file.py:function`."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.odometry import AT_REST, Pose, pose_at
from perception.own_code import error_line, kind_of, load_function
from perception.types import Measurement, Odometry, Track

TRACKERS = ("sound", "paper")
"""Names that one's own function cannot have: they are built in."""


class TrackerError(ValueError):
    """A tracker cannot be loaded, or failed on a set of measurements."""


class OwnTracker:
    """A tracker of the user's own, with the methods of `Tracker`; calling it checks what comes back.

    The function is called with the measurements of a set, the odometry around it, and a dictionary that is
    empty at first and is the function's to keep what it wants in from set to set.

    Attributes
    ----------
    name, reference, path
        The function's name; what the user wrote, for error texts; the file that holds it.
    """

    def __init__(
        self, name: str, reference: str, path: Path, function: Callable[..., Iterable[Track]]
    ) -> None:
        self.name, self.reference, self.path = name, reference, path
        self._function = function
        self._state: dict[Any, Any] = {}
        self._newest: tuple[Track, ...] = ()
        self._pose: Pose = AT_REST

    def update(
        self, time_s: float, measurements: Sequence[Measurement], odometry: Sequence[Odometry] = ()
    ) -> tuple[Track, ...]:
        """Hand a set of measurements to the function, and return its tracks.

        Raises
        ------
        TrackerError
            If the function raises, or returns anything but tracks with numbers of their own.
        """
        where = f"{self.reference}: set at {time_s:g} s"
        try:
            found = self._function(list(measurements), list(odometry), self._state)
            listed = tuple(found) if isinstance(found, Iterable) else None
        except Exception as error:
            raise TrackerError(f"{where}: {error_line(error, self.path)}") from error
        if listed is None:
            raise TrackerError(f"{where}: returned {kind_of(found)}; wanted a list of tracks")
        self._newest = tuple(_checked(track, where) for track in listed)
        numbers = [track.track for track in self._newest]
        if len(set(numbers)) < len(numbers):
            raise TrackerError(f"{where}: two tracks have one number; wanted each number once")
        self._pose = pose_at(odometry, time_s)
        return self._newest

    def predicted(self, time_s: float, odometry: Sequence[Odometry] = ()) -> tuple[Track, ...]:
        """Return the newest tracks, gone on as they moved, in body axes at a time; their σ stay."""
        pose = pose_at(odometry, time_s)
        turn = pose.rotation.T @ self._pose.rotation
        both = np.kron(np.eye(2), turn)
        moved = []
        for track in self._newest:
            place = track.position_body_m + (time_s - track.time_s) * track.velocity_body_m_per_s
            moved.append(
                dataclasses.replace(
                    track,
                    time_s=time_s,
                    position_body_m=turn @ place
                    + pose.rotation.T @ (self._pose.position_m - pose.position_m),
                    velocity_body_m_per_s=turn @ track.velocity_body_m_per_s,
                    covariance=both @ track.covariance @ both.T,
                    detections=(),
                    unseen_s=track.unseen_s + max(time_s - track.time_s, 0.0),
                )
            )
        return tuple(moved)


def load_tracker(reference: str) -> OwnTracker:
    """Load the function that `file.py:function` names.

    Parameters
    ----------
    reference
        Path of a Python file, a colon, and the name of a function in it that takes measurements, odometry
        and its state, in this order, and returns tracks.

    Raises
    ------
    TrackerError
        If there is no such file or function, it cannot be called, or the file raises while it is imported.
    """
    name, path, function = load_function(
        reference, "tracker", "my_tracker.py:nearest", TRACKERS, TrackerError
    )
    return OwnTracker(name, reference, path, function)


def _checked(track: object, where: str) -> Track:
    """Return a track with arrays of the contract's shapes, or say what about it is wrong."""
    if not isinstance(track, Track):
        raise TrackerError(f"{where}: returned {kind_of(track)} among its tracks; wanted a Track")
    arrays: dict[str, Any] = {}
    for name, shape in (
        ("position_body_m", (3,)),
        ("velocity_body_m_per_s", (3,)),
        ("covariance", (6, 6)),
    ):
        try:
            arrays[name] = np.asarray(getattr(track, name), dtype=float)
        except (TypeError, ValueError) as error:
            raise TrackerError(f"{where}: {name} of a track: {error}") from None
        if arrays[name].shape != shape:
            raise TrackerError(f"{where}: {name} of a track has shape {arrays[name].shape}; wanted {shape}")
        if not np.isfinite(arrays[name]).all():
            raise TrackerError(f"{where}: {name} of a track is not finite; leave out what is not known")
    if not isinstance(track.track, int | np.integer):
        raise TrackerError(f"{where}: number of a track is {track.track!r}; wanted a whole number")
    return dataclasses.replace(track, track=int(track.track), **arrays)
