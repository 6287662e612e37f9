"""Write what the presets of droplets do to light: nir_render/data/droplets/tables, by Mie theory.

    .venv/bin/python tools/droplet_tables.py [NAME ...]

Run it after a change of a preset, of an index, or of the angles; `tests/unit/scattering` holds the tables
against what is computed anew. It takes some minutes.
"""

import sys
from pathlib import Path

from nir_render.scattering.optics import Particles, computed, table_text
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.scene.documents.files import preset_names

FOLDER = Path(__file__).parents[1] / "nir_render" / "data" / "droplets" / "tables"
NODES = 8000  # 1 - albedo hangs on resonances of large spheres: to 2 % then
NODES_OF_DROPS = 1000  # each of them takes a hundred times as long
MOST_X = 30_000.0
LARGE_M = 50e-6


def main() -> None:
    """Write the tables of the presets named, of all where none is."""
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or preset_names("droplets"):
        droplets = Droplets.model_validate(name)
        particles = Particles(droplets.sizes.sizes(), droplets.index.value, droplets.index_550.value)
        large = particles.sizes.mean_volume_m3() > LARGE_M**3
        optics = computed(particles, NODES_OF_DROPS if large else NODES, MOST_X)
        (FOLDER / f"{name}.csv").write_text(table_text(particles, optics), encoding="utf-8")
        print(
            f"{name}: sigma(940)/sigma(550) {optics.ratio:.4f}, g {optics.asymmetry:.4f}, "
            f"1 - albedo {optics.absorbed_share:.3g}"
        )


if __name__ == "__main__":
    main()
