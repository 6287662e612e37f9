#!/usr/bin/env python3
"""An estimator that is a program, to copy and change: the brightest spot of each frame, with its range.

    nir-render perceive DIR --estimator "cmd: python3 my_detector.py"

It imports nothing of ours: calibrations and frames come as lines of JSON; a line answers each frame.
"""

import array
import json
import math
import sys

cameras = json.loads(sys.stdin.readline())["cameras"]


def number(entry):
    """Return an entry of a calibration: one that is not exact stands as {"value": v, "sigma": s}."""
    return entry["value"] if isinstance(entry, dict) else entry


for line in sys.stdin:
    frame = json.loads(line)
    camera = cameras[frame["camera"]]
    # The frame's counts, as a PGM: four words, then uint16 by rows, the high byte first.
    with open(frame["pgm"], "rb") as file:  # noqa: PTH123
        width, height = (int(word) for word in (file.readline() + file.readline()).split()[1:])
        file.readline()
        counts = array.array("H", file.read())
    if sys.byteorder == "little":
        counts.byteswap()

    # Around the brightest pixel: all light above the black level, and the centroid of what stands out.
    row, column = divmod(max(range(len(counts)), key=counts.__getitem__), width)
    flux = weights = sum_u = sum_v = 0.0
    for v in range(max(row - 6, 0), min(row + 7, height)):
        for u in range(max(column - 6, 0), min(column + 7, width)):
            light = counts[v * width + u] - frame["black_level_dn"]
            weight = max(light - 20.0, 0.0)
            flux, weights, sum_u, sum_v = (
                flux + light,
                weights + weight,
                sum_u + weight * u,
                sum_v + weight * v,
            )

    found = []
    if weights > 0.0:
        u_px, v_px = sum_u / weights, sum_v / weights
        # flux = K · exposure · gain · cos θ / range², with the response of the axis for that of all angles.
        x = (u_px - number(camera["cx_px"])) / number(camera["fx_px"])
        y = (v_px - number(camera["cy_px"])) / number(camera["fy_px"])
        light_at_1_m = number(camera["range_constant_dn_m2_per_s"]) * frame["exposure_s"] * frame["gain"]
        range_m = math.sqrt(light_at_1_m / flux / math.sqrt(1.0 + x * x + y * y))
        found.append({"u_px": u_px, "v_px": v_px, "flux_dn": flux, "range_m": range_m})
    print(json.dumps({"detections": found}), flush=True)  # noqa: T201
