"""How long a campaign takes: from nothing, with all light in the cache, and when it is done already.

    python benchmarks/stress.py [CAMPAIGN] [--workers N] [--combinations 0]

prints one JSON object: seconds of `nir-render stress` (start, check, page and all), and of the check by job.
It is scenes/campaigns/ranging_clutter.yaml unless another is named. Each is measured once; nothing is kept.
With `--combinations N` it is instead what N combinations, drawn at random, take: to be
planned (`--plan`), and to be counted when all are done (`--status`).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

from nir_render.scene.text.yaml_text import read_yaml
from nir_render.stress.campaign import load_campaign
from nir_render.stress.jobs import plan
from nir_render.stress.sweep import MANIFEST, PLANNED
from nir_render.stress.workers.pool import PART_KIND

CAMPAIGN = Path(__file__).parents[1] / "scenes" / "campaigns" / "ranging_clutter.yaml"


def planned(file: str, count: int) -> dict[str, Any]:
    """Return how long so many combinations of a campaign take to be planned, and to be counted."""
    document = read_yaml(Path(file))
    document["scene"] = str((Path(file).parent / document["scene"]).resolve())
    document |= {"seeds": 1, "sample": {"design": "random", "count": count}}
    seconds = {}
    with tempfile.TemporaryDirectory() as place:
        changed, folder = Path(place) / "campaign.yaml", Path(place) / "out"
        changed.write_text(yaml.safe_dump(document))
        command = [sys.executable, "-m", "nir_render.command.main", "stress", str(changed), "-o", str(folder)]
        started = time.perf_counter()
        subprocess.run([*command, "--plan"], check=True, capture_output=True)  # noqa: S603 (our own command)
        seconds["plan"] = time.perf_counter() - started
        # What a sweep leaves, without its content.
        keys = [f"{number:032x}" for number in range(count)]
        (folder / "jobs").mkdir(parents=True)
        for key in keys:
            (folder / "jobs" / f"{key}{PART_KIND}").touch()
        (folder / MANIFEST).write_text(json.dumps({"format": 1, "name": document["name"]}))
        (folder / PLANNED).write_text(json.dumps({"format": 1, "jobs": keys}))
        started = time.perf_counter()
        told = subprocess.run(  # noqa: S603
            [*command, "--status", "--json"], check=True, capture_output=True, text=True
        )
        seconds["status"] = time.perf_counter() - started
    assert json.loads(told.stdout)["done"] == count
    return {"campaign": document["name"], "combinations": count, "seconds": seconds}


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign", nargs="?", default=str(CAMPAIGN))
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--combinations", type=int, default=0)
    asked = parser.parse_args()
    if asked.combinations:
        print(json.dumps(planned(asked.campaign, asked.combinations)))
        return
    campaign = load_campaign(asked.campaign)
    started = time.perf_counter()
    jobs = plan(campaign)
    seconds = {"check_per_job": (time.perf_counter() - started) / len(jobs)}
    with tempfile.TemporaryDirectory() as place:
        for name, folder in (("from_nothing", "one"), ("with_light_cached", "two"), ("done_already", "two")):
            command = [sys.executable, "-m", "nir_render.command.main", "stress", asked.campaign, "--json"]
            command += ["-o", f"{place}/{folder}", "--light-cache", f"{place}/light"]
            started = time.perf_counter()
            subprocess.run(  # noqa: S603 (our own command)
                [*command, "--workers", str(asked.workers)], check=True, capture_output=True
            )
            seconds[name] = time.perf_counter() - started
    rounded = {name: round(value, 4) for name, value in seconds.items()}
    print(
        json.dumps(
            {"campaign": campaign.name, "jobs": len(jobs), "workers": asked.workers, "seconds": rounded}
        )
    )


if __name__ == "__main__":
    main()
