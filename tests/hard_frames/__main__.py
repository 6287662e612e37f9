"""Prints the rows asked for: see the package."""

import argparse
import json
import sys
import time
from typing import Any

import tests.hard_frames
from tests.hard_frames.rows import ROWS


def main() -> None:
    """Print the rows asked for, or all of them."""
    parser = argparse.ArgumentParser(
        description=tests.hard_frames.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "rows", nargs="*", metavar="ROW", help=f"any of: {', '.join(ROWS).replace('%', '%%')}"
    )
    parser.add_argument("--estimator", default="robust")
    parser.add_argument("--frames", type=int, help="frames of each row, in place of its own number")
    given = parser.parse_args()
    if unknown := sorted(set(given.rows) - set(ROWS)):
        parser.error(f"no such row: {', '.join(unknown)}; rows are {', '.join(ROWS)}")
    more: dict[str, Any] = {"frames": given.frames} if given.frames else {}
    for name in given.rows or ROWS:
        started = time.perf_counter()
        row = ROWS[name](estimator=given.estimator, **more)
        line = {"row": name, **row, "seconds": round(time.perf_counter() - started, 1)}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
