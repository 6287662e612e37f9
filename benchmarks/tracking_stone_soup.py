"""The filter beside Stone Soup's unscented one, on the same measurements: one JSON object.

In an environment of its own (`pip install stonesoup`): `tracking.py --write runs.npz` writes the runs, then
`python tracking_stone_soup.py runs.npz` reads them; of this project it needs nothing.
"""

import datetime as dt
import json
import sys

import numpy as np

TURNED = [0, 3, 1, 4, 2, 5]  # [p; v] to x, vx, y, vy, z, vz


def followed(runs: dict[str, np.ndarray], name: str, start: np.ndarray) -> np.ndarray:
    """Return its estimates of the places, shape (steps, runs, 3); σ of the range at the predicted range."""
    from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
    )
    from stonesoup.predictor.kalman import UnscentedKalmanPredictor
    from stonesoup.types.angle import Bearing, Elevation
    from stonesoup.types.array import StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import UnscentedKalmanUpdater

    interval_s, psd, bearing_rad, noise = runs[f"{name}.case"]
    model = CombinedLinearGaussianTransitionModel([ConstantVelocity(psd)] * 3)
    predictor, updater = UnscentedKalmanPredictor(model), UnscentedKalmanUpdater(None)
    begin = dt.datetime(2000, 1, 1)
    bearing, range_m = runs[f"{name}.bearing"], runs[f"{name}.range_m"]
    found = np.empty((*range_m.shape, 3))
    for run in range(range_m.shape[1]):
        state = GaussianState(runs[f"{name}.first"][run][TURNED], start[np.ix_(TURNED, TURNED)], begin)
        for step in range(len(range_m)):
            when = begin + dt.timedelta(seconds=float((step + 1) * interval_s))
            ahead = predictor.predict(state, timestamp=when)
            far = float(np.linalg.norm(np.asarray(ahead.state_vector, dtype=float)[[0, 2, 4]]))
            x, y, z = bearing[step, run]
            height = float(np.arcsin(z))
            spread = np.diag(
                [bearing_rad**2, (bearing_rad / np.cos(height)) ** 2, (0.5 * noise * far**3) ** 2]
            )
            seen = CartesianToElevationBearingRange(6, (0, 2, 4), spread)
            unbiased = range_m[step, run] - 0.375 * (noise * far**2) ** 2 * far
            vector = StateVector([Elevation(height), Bearing(np.arctan2(y, x)), unbiased])
            state = updater.update(
                SingleHypothesis(ahead, Detection(vector, timestamp=when, measurement_model=seen))
            )
            found[step, run] = np.asarray(state.state_vector, dtype=float)[[0, 2, 4], 0]
    return found


def main() -> None:
    """Print RMSE of both and their ratio, also without the first third of steps, for each case."""
    if len(sys.argv) < 2:
        print(json.dumps({"skipped": "wants a file of tracking.py --write, and Stone Soup"}))
        return
    runs = dict(np.load(sys.argv[1]))
    figures = {}
    for key in [name for name in runs if name.endswith(".case")]:
        name = key.removesuffix(".case")
        truth = runs[f"{name}.truth"][..., :3]
        ours, theirs = (
            np.mean(np.sum((places - truth) ** 2, axis=2), axis=1)
            for places in (runs[f"{name}.estimates"][..., :3], followed(runs, name, runs["start"]))
        )
        late = slice(len(ours) // 3, None)
        figures[name] = {
            "ours_m": float(np.sqrt(ours.mean())),
            "stone_soup_m": float(np.sqrt(theirs.mean())),
            "ratio": round(float(np.sqrt(ours.mean() / theirs.mean())), 4),
            "ratio_without_the_first_third": round(
                float(np.sqrt(ours[late].mean() / theirs[late].mean())), 4
            ),
        }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
