"""Where the repository and its example scenes lie."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes"
