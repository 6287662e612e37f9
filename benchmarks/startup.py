"""How soon the command and the packages are there: CPU seconds, user and system, of whole processes.

Prints one JSON object: medians over runs. Bytecode is on the disk before the first run that counts.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
RUNS = 9
COMMAND = "from nir_render.command.main import main; main()"
CALLS = {
    "help": [COMMAND, "--help"],
    "validate_arena": [COMMAND, "validate", str(ROOT / "scenes" / "arena.yaml")],
    "import_perception": ["import perception"],
    "import_nir_render": ["import nir_render"],
    "import_numpy": ["import numpy"],
    "python": ["pass"],
}


def cpu_seconds(words: list[str]) -> float:
    """Return the CPU time of one process that runs `words[0]` with the others as its arguments."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = str(ROOT)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-c", *words]
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)  # noqa: S603 (our own)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure, round by round, so that what slows the machine down slows all of them."""
    for words in CALLS.values():
        cpu_seconds(words)
    rounds = [{name: cpu_seconds(words) for name, words in CALLS.items()} for _ in range(RUNS)]
    medians = {name: round(statistics.median(one[name] for one in rounds), 3) for name in CALLS}
    print(json.dumps({"benchmark": "startup", "runs": RUNS, "cpu_s": medians}))


if __name__ == "__main__":
    main()
