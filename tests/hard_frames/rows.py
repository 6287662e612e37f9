"""All kinds of frames that are hard to read, by name."""

from collections.abc import Callable
from typing import Any

from tests.hard_frames.flares import clipped, crowd, faint, lit, lone, lone_of, pairs, textured
from tests.hard_frames.near import near_crowd
from tests.hard_frames.nothing import bad_pixels, empty, lamps

ROWS: dict[str, Callable[..., dict[str, Any]]] = {
    **{f"pair {apart:g} px": lambda apart=apart, **more: pairs(apart, **more) for apart in (1.0, 1.5, 2.0, 3.0, 4.0)},
    "pair 1:5 at 2 px": lambda **more: pairs(2.0, 5.0, **more),
    "pair 1:5 at 4 px": lambda **more: pairs(4.0, 5.0, **more),
    "pair 1:20 at 3 px": lambda **more: pairs(3.0, 20.0, **more),
    "lone": lone,
    "lone, kernel 3 % wider": lambda **more: lone(kernel=1.03, **more),
    "lone, kernel 3 % narrower": lambda **more: lone(kernel=0.97, **more),
    **{f"lone of {flux:g} e": lambda flux=flux, **more: lone_of(flux, **more) for flux in (1e3, 4e3, 1.6e4)},
    **{f"clipped {times} times": lambda times=times, **more: clipped(times, **more) for times in (3, 10, 20, 50)},
    "clipped 50 times, kernel known to 3 %": lambda **more: clipped(50, kernel_sigma=0.03, **more),
    "peak of 8 sigma": lambda **more: faint(8.0, **more),
    **{f"lit by {lux} lux": lambda lux=lux, **more: lit(lux, **more) for lux in (300, 500, 800)},
    "60 stuck pixels": lambda **more: bad_pixels(60, 0, **more),
    "120 hot pixels": lambda **more: bad_pixels(0, 120, **more),
    **{f"texture of {px} px": lambda px=px, **more: textured(px, **more) for px in (4, 6, 15, 30)},
    "lamps": lamps,
    "lamps where sources are balls of 1 cm": lambda **more: lamps(source_radius_m=0.01, **more),
    "seven lamps": lambda **more: lamps(per_frame=7, **more),
    "seven lamps where sources are balls of 1 cm": lambda **more: lamps(source_radius_m=0.01, per_frame=7, **more),
    **{f"empty, {kind}": lambda kind=kind, **more: empty(kind, **more)
       for kind in ("texture", "sheen", "sun patches", "blinds")},
    "empty, sun patches that clip": lambda **more: empty("sun patches", times=5.0, **more),
    "crowd of 300": lambda **more: crowd(300, **more),
    **{f"near crowd of {number}{clips}": lambda number=number, exposure_s=exposure_s, **more:
       near_crowd(number, exposure_s, **more)
       for number in (60, 300) for clips, exposure_s in (("", 1e-4), (", clipped", 1e-3))},
}  # fmt: skip
