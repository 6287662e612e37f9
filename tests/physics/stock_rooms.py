"""The six rooms by Mitsuba's own integrators: rendered once, kept in `stock_rooms.npz`, and held against ours.

They take twenty minutes of two cores, and change only with the rooms or with their sampling, which the file
knows them by. Where those change, the tests say to render them anew: ``python -m tests.physics.stock_rooms``.
Of each render the means and variances of tiles and frame are kept, once whole, with what surrounds the image of
each source spread evenly over it, and once without these surroundings.
"""

import hashlib
import json
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from nir_render import Light, Scene, expected_electrons, render
from nir_render.transport.backend.variant import backend
from tests.physics import stock
from tests.physics.rooms import FOCAL_PX, HEIGHT_PX, ROOMS, SIGMA_PX, WIDTH_PX, groups, load_room, plain
from tests.physics.stock import stock_radiance
from tests.statistics import Parts, parts_of

Array = NDArray[np.float64]

CAMERA = "r1.c"
EXPOSURE_S = 1e-3
FILE = Path(__file__).with_suffix(".npz")


@dataclass(frozen=True)
class Sampling:
    """Samples per pixel of each batch and number of batches."""

    samples: int
    batches: int


# Beside ours (`test_groups`) so much that one per cent of any one group is nine standard errors or more of the
# frame's mean away from the images of sources, and seven in thin fog, which is dear. At this significance, so many
# tiles and so few batches it takes six to seven.
SAMPLING = {
    "diffuse room": Sampling(4, 32),
    "glossy corridor": Sampling(8, 32),
    "mirror room": Sampling(128, 32),
    "occluders": Sampling(64, 48),
    # Mitsuba meets the lamp in the fog by chance alone: its tiles are skewed, and 48 batches may hold none of the
    # bright ones (a tile 4.5 % darker than 144 others had it).
    "thin fog": Sampling(64, 96),
    "dense fog": Sampling(32, 64),
}


@dataclass(frozen=True, eq=False)
class StockRoom:
    """A room by Mitsuba: all groups on, and each alone; `aside` tells the pixels away from images of sources.

    Of each render both its parts: whole, and what is aside.
    """

    aside: NDArray[np.bool_]
    together: tuple[Parts, Parts]
    alone: tuple[tuple[Parts, Parts], ...]


def weighted(radiance: Array) -> Array:
    """Weight plain radiance, shape (..., rows, columns), with cos⁴ of the field angle and blur it."""
    x = (np.arange(WIDTH_PX) - 0.5 * (WIDTH_PX - 1)) / FOCAL_PX
    y = (np.arange(HEIGHT_PX) - 0.5 * (HEIGHT_PX - 1)) / FOCAL_PX
    cos4 = radiance * (1.0 + x**2 + y[:, None] ** 2) ** -2
    sigma_px = (*(0.0 for _ in radiance.shape[:-2]), SIGMA_PX, SIGMA_PX)
    return np.asarray(gaussian_filter(cos4, sigma_px, mode="nearest", truncate=6.0))


def straight(scene: Scene, light: Light) -> Array:
    """Return the straight light of each group as the camera places it, in the unit of `weighted`.

    Electrons of an even radiance give the scale; without a filter it is the same at every angle.
    """
    arrays = light.indirect
    assert arrays is not None
    frames = []
    for group in range(len(light.groups)):
        even, irradiance = np.zeros_like(arrays.radiance_per_w), light.direct.irradiance_per_w
        even[group] = 1.0
        mine = np.where((light.direct.group == group)[:, None], irradiance, 0.0)
        parts = [(np.zeros_like(irradiance), even), (mine, np.zeros_like(even))]
        scale, straight = (
            expected_electrons(
                replace(
                    light,
                    direct=replace(light.direct, irradiance_per_w=table),
                    indirect=replace(arrays, radiance_per_w=radiance),
                ),
                scene,
                EXPOSURE_S,
            )
            for table, radiance in parts
        )
        scale /= weighted(np.ones(scale.shape))
        assert np.ptp(scale) < 1e-4 * scale.max()
        frames.append(straight / scale.mean())
    return np.stack(frames)


def both_parts(frames: Array, aside: NDArray[np.bool_]) -> tuple[Parts, Parts]:
    """Return the parts of frames, shape (batches, rows, columns), whole and aside.

    Mitsuba's image of a source is sampled on pixels before it is blurred; only its sum is as exact as ours.
    """
    whole = frames
    places, count = label(~aside)
    for number in range(1, count + 1):
        mean = frames[:, places == number].mean(axis=1)
        whole = np.where(places == number, mean[:, None, None], whole)
    return parts_of(whole), parts_of(frames * aside)


def stock_room(room: str) -> StockRoom:
    """Return a room as it is kept.

    Raises
    ------
    AssertionError
        The room, how it is rendered, or Mitsuba is another than that of the file.
    """
    with np.load(FILE) as kept:
        known = str(kept[f"{room}/key"])
        assert known == _key(room), f"{room} has changed: python -m tests.physics.stock_rooms renders it anew"
        shape = (HEIGHT_PX, WIDTH_PX)
        aside = np.unpackbits(kept[f"{room}/aside"], count=HEIGHT_PX * WIDTH_PX).reshape(shape).astype(bool)
        numbers = kept[f"{room}/parts"]  # (renders, whole and aside, mean and variance, parts)
    half, full = SAMPLING[room].batches // 2, SAMPLING[room].batches
    renders = [
        (Parts(whole[0], whole[1], count), Parts(without[0], without[1], count))
        for (whole, without), count in zip(numbers, [half, *[full] * (len(numbers) - 1)], strict=True)
    ]
    return StockRoom(aside, renders[0], tuple(renders[1:]))


def render_room(room: str, seed: int = 1) -> StockRoom:
    """Render a room by Mitsuba, all groups together by half the batches, and each alone."""
    names, sampling = groups(plain(room)), SAMPLING[room]
    aside = _aside(room)

    def stacks(emitting: list[list[str]], batches: int) -> Array:
        return weighted(
            stock_radiance(
                plain(room), emitting, samples=sampling.samples, batches=batches, variant=backend().variant,
                seed=seed,
            )
        )  # fmt: skip

    (together,) = stacks([names], sampling.batches // 2)
    alone = stacks([[name] for name in names], sampling.batches)
    return StockRoom(aside, both_parts(together, aside), tuple(both_parts(stack, aside) for stack in alone))


def _aside(room: str) -> NDArray[np.bool_]:
    """Return which pixels no straight light, nor any by way of one mirror, falls on."""
    with tempfile.TemporaryDirectory() as folder:
        scene = load_room(room, Path(folder), 16)
        return np.asarray(~(straight(scene, render(scene, CAMERA, seed=0)) > 0.0).any(axis=0))


def _key(room: str) -> str:
    """Return what a room is known by: its document, how it is sampled and blurred, and by what it is rendered."""
    how = [asdict(SAMPLING[room]), SIGMA_PX, FOCAL_PX, version("mitsuba"), Path(stock.__file__).read_text()]
    return hashlib.sha256(json.dumps([plain(room), how], sort_keys=True).encode()).hexdigest()


def _write(room: str, one: StockRoom) -> None:
    arrays: dict[str, Any] = {}
    if FILE.exists():
        with np.load(FILE) as kept:
            arrays = dict(kept)
    numbers = [[(part.mean, part.variance) for part in both] for both in (one.together, *one.alone)]
    arrays[f"{room}/key"] = np.array(_key(room))
    arrays[f"{room}/aside"] = np.packbits(one.aside)
    arrays[f"{room}/parts"] = np.array(numbers)
    aside = FILE.with_suffix(".tmp")
    with aside.open("wb") as file:
        np.savez_compressed(file, **dict(sorted(arrays.items())))
    aside.replace(FILE)


if __name__ == "__main__":
    for asked in sys.argv[1:] or ROOMS:
        _write(asked, render_room(asked))
        sys.stdout.write(f"{asked}: rendered\n")
