"""Frames that are hard to read, and what an estimator makes of them: `python -m tests.hard_frames [ROW ...]`.

Prints one JSON object for each row: how many flares were found, how many detections are of nothing, errors of
place and flux over the bound that a lone flare or a pair of known number would have, and how true the claimed
sigmas are. The photons come from `tests.unit.perception.simulation`, which shares no code with `perception`;
pairs have a bound of their own here, from numerical derivatives of that simulator.

What counts as found: detections and flares are paired one to one, nearest first, within half the distance of the
pair, and within 1 px elsewhere. What is left over of the detections are false alarms.
"""
