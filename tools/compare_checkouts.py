"""Hold what two checkouts of this project make of the same scenes against each other, bit by bit.

    python tools/compare_checkouts.py OLD NEW --out DIR [--scene NAME …] [--tolerance 1e-9]

Each checkout renders and perceives every scene of its `scenes/` and `scenes/regression/` (`nir-render run
--keep-light`) into `DIR/old` and `DIR/new`; what lies there already is not rendered again: take a new folder
for new code. Frames and light, and what the manifest says of noise and samples,
must be equal in every bit; the numbers of calibration, truth, detections and summary too, or, with a
tolerance, to that share of their value. Prints one JSON object; the exit status is 1 where something differs.

For whoever moves code about without meaning to change what it does: run it on one machine, with one set of
installed packages, that of the interpreter that runs this file.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

IMAGES = (".png", ".exr")
NUMBERS = (
    *("calibration.json", "summary.json", "truth.jsonl", "frames.jsonl", "detections.*.jsonl"),
    "manifest.json",
)
MANIFEST = ("render_noise", "indirect", "lights")
START = "import sys; from nir_render.{} import main; sys.exit(main())"


def main(arguments: list[str] | None = None) -> int:
    """Run both checkouts over the scenes, compare, print; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", action="append", help="only this one; repeatable")
    parser.add_argument("--tolerance", type=float, default=0.0, help="relative, of numbers in JSON")
    asked = parser.parse_args(arguments)
    known = [name for name in scenes_of(asked.old) if name in scenes_of(asked.new)]
    unknown = [name for name in asked.scene or () if name not in known]
    if unknown:
        parser.error(f"no scene {unknown[0]!r} in both; known: {', '.join(known)}")
    names = asked.scene or known
    seconds: dict[str, dict[str, float]] = {"old": {}, "new": {}}
    for side, checkout in (("old", asked.old), ("new", asked.new)):
        for name in names:
            spent = run(checkout.resolve(), scenes_of(checkout)[name], asked.out / side / name)
            if spent is not None:
                seconds[side][name] = round(spent, 2)
    differences = {
        name: list(compare_runs(asked.out / "old" / name, asked.out / "new" / name, asked.tolerance))
        for name in names
    }
    unlike = {name: found for name, found in differences.items() if found}
    alone = sorted({*scenes_of(asked.old)} ^ {*scenes_of(asked.new)})
    said = {"scenes": names, "in_one_only": alone, "equal": not unlike, "differences": unlike}
    print(json.dumps({**said, "seconds": seconds}))
    return 1 if unlike else 0


def scenes_of(checkout: Path) -> dict[str, Path]:
    """Return the scenes of a checkout by name."""
    files = [*(checkout / "scenes").glob("*.yaml"), *(checkout / "scenes" / "regression").glob("*.yaml")]
    return {file.stem: file for file in sorted(files)}


def run(checkout: Path, scene: Path, folder: Path) -> float | None:
    """Render and perceive a scene with the code of a checkout; return the seconds, None where it is done."""
    if (folder / "summary.json").is_file():
        return None
    module = "command.main" if (checkout / "nir_render" / "command").is_dir() else "cli"
    words = ["run", str(scene), "-o", str(folder.resolve()), "--keep-light", "--overwrite"]
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", START.format(module), *words],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"{checkout}: {scene.name}: {done.stderr}")
    return time.perf_counter() - started


def compare_runs(old: Path, new: Path, tolerance: float) -> Iterator[str]:
    """Yield what differs between two run folders, a line for each file."""
    images = sorted(
        {file.relative_to(run) for run in (old, new) for file in run.rglob("*") if file.suffix in IMAGES}
    )
    for file in images:
        if file.name == "preview.png":
            continue
        if not ((old / file).is_file() and (new / file).is_file()):
            yield f"{file}: is in one only"
            continue
        for name, before in pixels(old / file).items():
            after = pixels(new / file).get(name)
            if after is None or after.shape != before.shape or before.tobytes() != after.tobytes():
                yield f"{file}: {name} differs"
    patterns = (*NUMBERS, "light/*/*.json")
    for file in sorted({file.relative_to(old) for pattern in patterns for file in old.glob(pattern)}):
        if not (new / file).is_file():
            yield f"{file}: is missing"
            continue
        before, after = document(old / file), document(new / file)
        if file.name == "manifest.json":
            before, after = ({key: facts[key] for key in MANIFEST} for facts in (before, after))
        worst, place = difference(before, after)
        if worst > tolerance:
            yield f"{file}: {place} differs, by {worst:.2g}"


def pixels(file: Path) -> dict[str, Any]:
    """Return the arrays of an image, by channel."""
    if file.suffix == ".png":
        return {"image": cv2.imread(str(file), cv2.IMREAD_UNCHANGED)}
    with OpenEXR.File(str(file), separate_channels=True) as image:
        return {name: np.array(channel.pixels) for name, channel in image.channels().items()}


def document(file: Path) -> Any:
    """Return a JSON document, or the list of those in a file of lines."""
    text = file.read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()] if file.suffix == ".jsonl" else json.loads(text)


def difference(before: Any, after: Any, place: str = "") -> tuple[float, str]:
    """Return the largest relative difference of two documents, inf where they disagree, and its place."""
    if isinstance(before, dict) and isinstance(after, dict):
        pairs = [(before.get(key), after.get(key), f"{place}.{key}") for key in {**before, **after}]
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = [
            (one, other, f"{place}[{i}]") for i, (one, other) in enumerate(zip(before, after, strict=True))
        ]
    elif isinstance(before, float) and isinstance(after, float):
        same = before == after or (math.isnan(before) and math.isnan(after))
        size = max(abs(before), abs(after))
        return (0.0 if same else abs(after - before) / size), place
    else:
        return (0.0 if before == after else math.inf), place
    return max((difference(*pair) for pair in pairs), key=lambda found: found[0], default=(0.0, place))


if __name__ == "__main__":
    sys.exit(main())
