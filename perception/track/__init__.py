"""From measurements of sets of frames to who is where over time: filter, association, birth and death."""

from perception.track.own import OwnTracker, TrackerError, load_tracker
from perception.track.settings import TrackerSettings
from perception.track.tracker import Tracker

__all__ = ["OwnTracker", "Tracker", "TrackerError", "TrackerSettings", "load_tracker"]
