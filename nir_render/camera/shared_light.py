"""Indirect light of many groups in one image: where it is far below the noise, and what that leaves off.

Each group's indirect light is an image of its own, driven by its own drive: a thousand robots that blink each
by themselves are a thousand images, five gigabytes a camera. The light of those far off falls on walls and
floor faintly; as one image, driven by the mean of their drives, it is off only by what single ones are darker
or brighter than the mean, where they shine.
"""

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.beams import electrons_per_radiance
from nir_render.camera.by_spectrum import group_emitters, group_fluxes, spectrum_key
from nir_render.camera.sensor.read_out import dark_variance_e2
from nir_render.camera.timing.drive import drive_of
from nir_render.light.light import Light
from nir_render.scene.snapshot import Snapshot

Array = NDArray[np.float64]

_SWING = 0.25
"""The most that a drive between 0 and 1 varies about its mean: half of the time dark."""


@dataclass(frozen=True)
class SharedLight:
    """Groups whose indirect light is to be one image, and what that leaves off.

    Attributes
    ----------
    groups
        Their numbers in the light.
    mean_share, worst_share
        The mean square that the film is off by over its temporal variance: of all blocks, and of the worst
        one; as if each blinked by itself and were dark half of the time. The lens's blur makes it less.
    """

    groups: tuple[int, ...]
    mean_share: float
    worst_share: float


def shared_light(light: Light, snapshot: Snapshot, exposure_s: float, most_share: float) -> SharedLight:
    """Return the groups that may share an image so that no block is off by more than a share of its noise.

    The faintest first, as many as that allows. With drives d of groups that bring f to a block, and w the
    share of each in all that they send, the block is off by Σ d (f − w Σ f): in the mean square a quarter of
    Σ (f − w Σ f)², as no drive between 0 and 1 varies more than by a quarter about its mean. What the
    render's own noise adds to f makes that larger.
    Under a point spread with glare or ghosts none share: there drives act on what flares spread, too.

    Parameters
    ----------
    exposure_s
        The longest that will be exposed.
    most_share
        Of a block's temporal variance, electrons² over electrons²: what it may be off by in the mean square.
    """
    camera, indirect = snapshot.camera(light.camera).camera, light.indirect
    emitters = group_emitters(light, snapshot)
    drives, fluxes = [drive_of(one) for one in emitters], group_fluxes(light, snapshot)
    known = Counter(drives)
    blinking = [
        group
        for group, one in enumerate(drives)
        if one.constant is None and known[one] == 1 and fluxes[group] > 0.0
    ]  # those of one drive have one image anyhow
    if indirect is None or camera.point_spread.core_share < 1.0 or len(blinking) < 2:
        return SharedLight((), 0.0, 0.0)
    responses: dict[Hashable, NDArray[np.float32]] = {}
    films = [
        _electrons(light, snapshot, group, responses) * np.float32(exposure_s * fluxes[group])
        for group in range(len(emitters))
    ]
    mean_e = np.sum(films, axis=0)
    noise_e2 = mean_e + dark_variance_e2(camera.sensor, exposure_s)
    faintest = sorted(blinking, key=lambda group: float((films[group] ** 2 / noise_e2).max()))
    chosen: list[int] = []
    off = np.zeros(mean_e.shape)
    # Sums over groups of f², f, w f (blocks); of w and w².
    squares, together, weighted = (np.zeros(mean_e.shape) for _ in range(3))
    weight = weight2 = 0.0
    for group in faintest:
        film, sends = films[group].astype(np.float64), float(fluxes[group])
        squares += film**2
        together += film
        weighted += sends * film
        weight += sends
        weight2 += sends**2
        spread = squares - 2.0 * together * weighted / weight + together**2 * weight2 / weight**2
        share = _SWING * np.maximum(spread, 0.0) / noise_e2
        if share.max() > most_share:
            break
        off = share
        chosen.append(group)
    if len(chosen) < 2:
        return SharedLight((), 0.0, 0.0)
    return SharedLight(tuple(chosen), float(off.mean()), float(off.max()))


def _electrons(
    light: Light, snapshot: Snapshot, group: int, responses: dict[Hashable, NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Return the electrons per second of one unit of a group in a pixel of each block, without the blur.

    `responses` keeps those of one unit of radiance, by spectrum and node.
    """
    assert light.indirect is not None
    camera = snapshot.camera(light.camera).camera
    rows, columns = light.indirect.radiance_per_w.shape[2:]
    emitter, scale = group_emitters(light, snapshot)[group], light.indirect.scale
    found = np.zeros((rows, columns), dtype=np.float32)
    for node in light.nodes:
        key = spectrum_key(emitter), node
        if key not in responses:
            of_one = electrons_per_radiance(camera, emitter, 1.0, node)
            responses[key] = of_one.reshape(rows, scale, columns, scale).mean(axis=(1, 3)).astype(np.float32)
        found += light.indirect.in_frames(group, node.index) * responses[key]
    return found
