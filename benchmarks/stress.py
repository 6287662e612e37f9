"""How long a campaign takes: from nothing, with all light in the cache, and when it is done already.

    python benchmarks/stress.py [CAMPAIGN] [--workers N]

prints one JSON object: seconds of `nir-render stress` (start, check, page and all), and of the check by job.
It is scenes/campaigns/ranging_clutter.yaml unless another is named. Each is measured once; nothing is kept.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from nir_render.stress.campaign import load_campaign
from nir_render.stress.jobs import plan

CAMPAIGN = Path(__file__).parents[1] / "scenes" / "campaigns" / "ranging_clutter.yaml"


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign", nargs="?", default=str(CAMPAIGN))
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    asked = parser.parse_args()
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
