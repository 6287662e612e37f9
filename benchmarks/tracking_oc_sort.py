"""Tracks in space beside OC-SORT in the image, on the same detections of a run: one JSON object.

`tracking_oc_sort.py --write RUN FILE.json` takes detections, truth and the tracks of `robust` out of a run.
Then, in an environment of its own (`pip install trackers`, which brings another OpenCV),
`python tracking_oc_sort.py FILE.json` follows them by OC-SORT (J. Cao et al., CVPR 2023) and scores both. Of
this project it needs only the file of scores.

A source and a track are alike by max(0, 1 − distance in the image / what 0.2 m spans there); cameras are
sequences, one after the other. `seen` counts only sources that are lit, and tracks that are measured, where
both say where their detection is; `all` also sources that are dark for up to a second, where OC-SORT says
nothing. Flares are smaller than what they move from frame to frame: OC-SORT gets square boxes of several
widths about them; it keeps tracks for as long as ours.
"""

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
REACH_M = 0.2
WIDTHS_PX = (8.0, 16.0, 32.0, 64.0)
KEPT_S = 1.25


def written(folder: Path, name: str = "robust") -> list[list[dict[str, Any]]]:
    """Return the frames of each camera of a run: truth, detections and tracks, as plain data."""
    sys.path.insert(0, str(ROOT))
    from nir_render.evaluate.tracks import evaluate_tracks
    from nir_render.run.folder import lines_of, parse_lines
    from nir_render.truth.sources import parse_truth
    from perception import frame_sets, parse_detection, parse_track, read_recording
    from perception.model.lens import project
    from perception.rig.frame_sets import robot_of, set_time_s

    recording = read_recording(folder)
    sets = [
        (robot_of(each[0].camera), set_time_s(each), [(frame.camera, frame.index) for frame in each])
        for each in frame_sets(recording.records)
    ]
    truth = parse_lines(folder / "truth.jsonl", parse_truth)
    tracks = lines_of(folder, "tracks", [name], parse_track)
    moments = evaluate_tracks(sets, truth, recording.calibrations, tracks).moments
    found: dict[Any, list[Any]] = {}
    for hit in lines_of(folder, "detections", [name], parse_detection)[name]:
        found.setdefault((hit.camera, hit.index), []).append(hit)
    lives: dict[Any, int] = {}
    cameras: dict[str, list[dict[str, Any]]] = {}
    for (robot, time_s, keys), moment in zip(sets, moments, strict=True):
        counted = [one for one in moment.present if one.life is not None]
        gone = {one.name for one in moment.present if one.life is None}
        for camera, index in keys:
            known = recording.calibrations[camera]
            sources, said = [], []
            for one in counted:
                place = project(
                    (one.position_body_m - known.position_body_m) @ known.rotation_body_camera, known
                )
                if _inside(place, known):
                    reach_px = REACH_M * known.fx_px / float(np.linalg.norm(one.position_body_m))
                    who = lives.setdefault((robot, one.name, one.life), len(lives))
                    sources.append([who, *map(float, place), one.lit > 0.0, reach_px])
            for track, follows in moment.tracks[name]:
                place = project(
                    (track.position_body_m - known.position_body_m) @ known.rotation_body_camera, known
                )
                own = [key[2] for key in track.detections if key[:2] == (camera, index)]
                if own:
                    place = found[camera, index][own[0]].u_px, found[camera, index][own[0]].v_px
                # Who goes on with one that is hidden for long, or has left, is not wrong.
                astray = follows in gone and not own
                if track.ghost != "yes" and not astray and _inside(place, known):
                    said.append([track.track, *map(float, place), bool(own)])
            hits = [[hit.u_px, hit.v_px] for hit in found.get((camera, index), []) if hit.ghost != "yes"]
            frame = {"time_s": time_s, "truth": sources, "detections": hits, "ours": said}
            cameras.setdefault(camera, []).append(frame)
    return list(cameras.values())


def _inside(place: Any, camera: Any) -> bool:
    u, v = place
    return bool(-0.5 <= u <= camera.width_px - 0.5 and -0.5 <= v <= camera.height_px - 0.5)


def followed(frames: list[dict[str, Any]], width_px: float) -> list[list[list[Any]]]:
    """Return what OC-SORT says in each frame of one camera: number, u, v, and that it is seen."""
    import supervision as sv
    from trackers import OCSORTTracker

    rate_hz = 1.0 / float(np.median(np.diff([frame["time_s"] for frame in frames])))
    tracker = OCSORTTracker(lost_track_buffer=round(30.0 * KEPT_S), frame_rate=rate_hz)
    said = []
    for frame in frames:
        places = np.array(frame["detections"], dtype=float).reshape(-1, 2)
        boxes = np.concatenate([places - 0.5 * width_px, places + 0.5 * width_px], axis=1)
        out = tracker.update(sv.Detections(xyxy=boxes, confidence=np.ones(len(boxes))))
        centres = 0.5 * (out.xyxy[:, :2] + out.xyxy[:, 2:])
        numbers = [] if out.tracker_id is None else out.tracker_id.tolist()
        said.append(
            [[number, *place, True] for number, place in zip(numbers, centres, strict=True) if number >= 0]
        )
    return said


def scored(cameras: list[list[dict[str, Any]]], said: list[list[Any]], *, seen_only: bool) -> dict[str, Any]:
    """Score tracks in the image: HOTA, IDF1, MOTA, switches."""
    metrics = _metrics()
    instants = []
    for number, (frames, own) in enumerate(zip(cameras, said, strict=True)):
        for frame, tracks in zip(frames, own, strict=True):
            truth = [one for one in frame["truth"] if one[3] or not seen_only]
            kept = [one for one in tracks if one[3] or not seen_only]
            there = np.array([one[1:3] for one in truth], dtype=float).reshape(-1, 1, 2)
            told = np.array([one[1:3] for one in kept], dtype=float).reshape(1, -1, 2)
            reach_px = np.array([one[4] for one in truth]).reshape(-1, 1)
            apart = np.linalg.norm(there - told, axis=2) / reach_px
            instants.append(
                metrics.Instant(
                    np.array([1_000_000 * number + one[0] for one in truth], dtype=np.int64),
                    np.array([1_000_000 * number + one[0] for one in kept], dtype=np.int64),
                    np.maximum(0.0, 1.0 - apart),
                )
            )
    found = metrics.track_scores(instants)
    tracks = len({int(one) for instant in instants for one in instant.tracks})
    figures = {name: round(getattr(found, name), 4) for name in ("hota", "idf1", "mota")}
    return {**figures, "switches": found.switches, "tracks": tracks}


def _metrics() -> Any:
    """Return the module of scores by itself: it needs numpy and scipy, and nothing of the project."""
    path = ROOT / "nir_render" / "evaluate" / "track_metrics.py"
    spec = importlib.util.spec_from_file_location("track_metrics", path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["track_metrics"] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Write a run's detections, or print the scores of both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path, metavar="RUN", help="a run folder to take detections out of")
    parser.add_argument("file", type=Path, nargs="?", help="what --write has written")
    chosen = parser.parse_args()
    if chosen.file is None:
        print(json.dumps({"skipped": "wants a file of --write, and the package trackers"}))
        return
    if chosen.write is not None:
        chosen.file.write_text(json.dumps(written(chosen.write)))
        return
    cameras = json.loads(chosen.file.read_text())
    ours = [[frame["ours"] for frame in frames] for frames in cameras]
    by_width = {width: [followed(frames, width) for frames in cameras] for width in WIDTHS_PX}
    figures = {
        kind: {
            "ours": scored(cameras, ours, seen_only=kind == "seen"),
            **{
                f"oc_sort, boxes of {width:g} px": scored(cameras, said, seen_only=kind == "seen")
                for width, said in by_width.items()
            },
        }
        for kind in ("seen", "all")
    }
    frames = sum(map(len, cameras))
    print(json.dumps({"cameras": len(cameras), "frames": frames, **figures}, indent=2))


if __name__ == "__main__":
    main()
