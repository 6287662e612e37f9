"""The goniometer: a source as it is built, measured over the whole sphere at a distance."""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.randomness import generator
from nir_render.scene.documents.built.cover import Cover, DiffuseSheet
from nir_render.scene.documents.built.source import BuiltSource, Die
from nir_render.transport.backend.user_cache import cache_file, read_answers, write_answers
from nir_render.transport.cache_key import digest
from nir_render.transport.fingerprint import code_hash, matching, package_versions
from nir_render.transport.goniometer import photons
from nir_render.transport.goniometer.goniogram import Goniogram

Array = NDArray[np.float64]

KEPT = cache_file("goniometer.json")
_QUANTILES = 4096
_FINE = 20_000  # steps over the half turn, between which a lobe's flux is summed up
_BATCH = 50_000
_MOST_PHOTONS = 10**10


@dataclass(frozen=True)
class Settings:
    """How it is measured: photons, the seed of their random numbers, steps of angle, and the distance.

    The photometric distance of the paper's Exp. 2 is 1 m. A source that shines the same all around its axis
    is averaged over all azimuths.
    """

    photons: int = 4_000_000
    seed: int = 1
    polar_steps: int = 36
    azimuths: int = 24
    distance_m: float = 1.0


def measure(
    built: BuiltSource,
    settings: Settings,
    progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
) -> Goniogram:
    """Send photons through a source and count where they arrive.

    The same source, settings and program give the same counts, whatever the number of threads. They are kept
    in the file `cache`, of the user's cache folder (`KEPT`), and found there again; without one they are not.

    Raises
    ------
    InputError
        Settings out of range.
    """
    _check(built, settings)
    columns = 1 if built.round_the_axis else settings.azimuths
    key = _key(built, settings)
    known = read_answers(cache)
    found = _from_answer(known.get(key), settings.distance_m)
    if found is not None:
        return found
    optics, dies = optics_of(built), dies_of(built)
    sphere = photons.Sphere(settings.distance_m, built.origin_m, settings.polar_steps, columns)
    seed = int(generator(settings.seed, "goniometer", "", 0).integers(2**63))
    shape = (settings.polar_steps + 1, columns)
    far, near, fates = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(4, np.int64)
    starts = range(0, settings.photons, _BATCH)

    def batch(first: int) -> tuple[photons.Counts, photons.Counts, photons.Counts]:
        count = min(_BATCH, settings.photons - first)
        counted: tuple[photons.Counts, photons.Counts, photons.Counts] = photons.trace(
            seed, first, count, optics, dies, sphere
        )
        return counted

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, counted in enumerate(pool.map(batch, starts), start=1):
            far, near, fates = far + counted[0], near + counted[1], fates + counted[2]
            if progress is not None:
                progress(done, len(starts))
    gram = Goniogram(near, far, settings.distance_m, *map(int, fates))
    write_answers(cache, {**known, key: _answer(gram)})
    return gram


def optics_of(built: BuiltSource) -> photons.Optics:
    """Return board and cover as the photons meet them."""
    board = built.board
    radius_m, reflectance = (0.0, 0.0) if board is None else (board.radius_m, board.reflectance)
    cover = built.cover
    if cover is None:
        return photons.Optics(photons.BARE, radius_m, reflectance, *(0.0,) * 3, 1.0, *(0.0,) * 6)
    return _covered(cover, radius_m, reflectance)


def _covered(cover: Cover, board_radius_m: float, board_reflectance: float) -> photons.Optics:
    around = (board_radius_m, board_reflectance, cover.height_m, cover.radius_m)
    material = cover.material
    if isinstance(material, DiffuseSheet):
        passed, returned = material.transmittance, material.reflectance
        return photons.Optics(
            photons.THIN, *around, cover.radius_m, 1.0, 0.0, 0.0, 0.0, 0.0, passed, returned
        )
    scattering_per_m = absorption_per_m = 0.0
    if material.scattering_length_m is not None:
        scattering_per_m = 1.0 / material.scattering_length_m
        absorption_per_m = scattering_per_m * (1.0 - material.albedo) / material.albedo
    return photons.Optics(
        photons.WALL,
        *around,
        cover.radius_m - cover.thickness_m,
        material.index,
        material.roughness,
        scattering_per_m,
        absorption_per_m,
        material.g,
        0.0,
        0.0,
    )


def dies_of(built: BuiltSource) -> photons.Dies:
    """Return the dies as arrays."""
    dies = built.dies
    up_to = np.cumsum([die.share for die in dies])
    axis = np.array([die.direction for die in dies])
    return photons.Dies(
        up_to / up_to[-1],
        np.array([die.position_m for die in dies]),
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        np.array([die.radius_m for die in dies]),
        np.array([_exponent(die) for die in dies]),
        np.array([_quantiles(die) for die in dies]),
    )


def _exponent(die: Die) -> float:
    """Return n of the lobe cos^n that is ½ at the half angle; −1 where it is a table."""
    return -1.0 if die.half_angle_rad is None else math.log(0.5) / math.log(math.cos(die.half_angle_rad))


def _quantiles(die: Die) -> Array:
    """Return the cosines of a table's lobe, even in probability."""
    if die.pattern is None:
        return np.zeros(_QUANTILES + 1)
    polar_rad, value = np.array(die.pattern.points).T
    fine_rad = np.linspace(0.0, np.pi, _FINE + 1)
    middle_rad = 0.5 * (fine_rad[1:] + fine_rad[:-1])
    flux = np.interp(middle_rad, polar_rad, value) * np.sin(middle_rad)
    summed = np.concatenate([[0.0], np.cumsum(flux)]) / flux.sum()
    even = np.linspace(0.0, 1.0, _QUANTILES + 1)
    rises = np.concatenate([[True], np.diff(summed) > 0.0])  # where nothing is sent, nothing is drawn
    first = max(int(np.argmax(summed > 0.0)) - 1, 0)
    rises[:first], rises[first] = False, True
    return np.asarray(np.cos(np.interp(even, summed[rises], fine_rad[rises])))


def _check(built: BuiltSource, settings: Settings) -> None:
    if not 1 <= settings.photons <= _MOST_PHOTONS:
        raise InputError(f"photons: {settings.photons} is out of range; wanted 1 to {_MOST_PHOTONS}")
    if not 2 <= settings.polar_steps <= 3600:
        raise InputError("the step of the polar angle is out of range; wanted 0.05 to 90 deg")
    if not 2 <= settings.azimuths <= 3600 or settings.azimuths % 2:
        raise InputError(f"azimuths: {settings.azimuths} do not do; wanted an even number from 2 to 3600")
    reach_m = built.radius_m if built.board is None else max(built.radius_m, built.board.radius_m)
    reach_m += abs(built.origin_m)
    if not (math.isfinite(settings.distance_m) and settings.distance_m > 2.0 * reach_m):
        raise InputError(
            f"distance {settings.distance_m:g} m: is too near; wanted more than {2.0 * reach_m:g} m"
        )


def _key(built: BuiltSource, settings: Settings) -> str:
    here = Path(__file__).parent
    return digest(
        {
            "source": (built.dies, built.board, built.cover),
            "settings": (settings.photons, settings.seed, settings.polar_steps, settings.azimuths),
            "distance_m": settings.distance_m,
            "made_by": [code_hash(matching(here, ("*.py",))), *package_versions("numba", "numpy").values()],
        }
    )


def _answer(gram: Goniogram) -> dict[str, Any]:
    return {
        "near": gram.near.tolist(),
        "far": gram.far.tolist(),
        "fates": [gram.left, gram.in_cover, gram.in_board, gram.lost],
    }


def _from_answer(answer: dict[str, Any] | None, distance_m: float) -> Goniogram | None:
    """Return what was kept; None where there is nothing, or it is no such thing."""
    try:
        near, far = (np.array(answer[name], dtype=np.int64) for name in ("near", "far"))  # type: ignore[index]
        gram = Goniogram(near, far, distance_m, *map(int, answer["fates"]))  # type: ignore[index]
    except (TypeError, KeyError, ValueError):
        return None
    return gram if near.shape == far.shape and near.sum() == gram.left == far.sum() else None
