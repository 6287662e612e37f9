"""Campaigns whose errors are known: tables as `gathered` makes them, of errors drawn from a formula."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import pyarrow as pa

from nir_render.randomness import generator
from nir_render.scene.scene import Scene
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.axes import Axis
from nir_render.stress.design.points import combinations_of
from nir_render.stress.metrics import METRICS, parse_bound

RANGE = Axis(
    "robots.r2.x", "range", ("robots.r2.x",), ("1 m", "1.7 m", "2.8 m", "4.8 m", "8 m"),
    ("1 m", "1.7 m", "2.8 m", "4.8 m", "8 m"), "m", (1.0, 1.7, 2.8, 4.8, 8.0), (1.0, 1.7, 2.8, 4.8, 8.0), log=True,
)  # fmt: skip
FOG = Axis(
    "fog.visibility", "visibility", ("fog.visibility",), ("10 m", "20 m", "40 m", "80 m"),
    ("10 m", "20 m", "40 m", "80 m"), "m", (10.0, 20.0, 40.0, 80.0), (10.0, 20.0, 40.0, 80.0), log=True,
)  # fmt: skip
LAMP = Axis("lamp", "lamp", ("lamps",), ("off", "side", "behind"), ("off", "side", "behind"))

Row = dict[str, Any]
_SOURCE_NUMBERS = ("true_range_m", "range_limit_m", "bearing_limit_deg", "range_error_m", "bearing_error_deg")
_SEQUENCE_NUMBERS = ("track_hota", "track_idf1", "message_bit_error_rate")
_FRAME_NUMBERS = ("exposure_s", "gain", "render_noise_share", "render_noise_target")


def campaign(
    axes: Sequence[Axis],
    bounds: Mapping[str, str],
    seeds: int = 2,
    *,
    metrics: Sequence[str] = (),
    **named: str,
) -> Campaign:
    asked = tuple(name for name in METRICS if name in {*bounds, *metrics})
    return Campaign(
        name=named.get("name", "clutter"), description=named.get("description", ""), scene=cast(Scene, None), settings={},
        axes=tuple(axes), sample=None, seeds=tuple(range(1, seeds + 1)), estimators=("paper", "robust"), metrics=asked,
        bounds=tuple(parse_bound(name, text) for name, text in bounds.items()), path="clutter.yaml",
    )  # fmt: skip


def source(error_m: float | None, **changes: Any) -> Row:
    """A source that counts, at 2 m with a limit of 1 cm; found and ranged if there is an error."""
    found = error_m is not None
    return {
        "kind": "source", "camera": "r1.front", "index": 0, "robot": "r2", "source": "top", "countable": True,
        "found": found, "ranged": found, "true_range_m": 2.0, "range_limit_m": 0.01, "bearing_limit_deg": 0.01,
        "range_error_m": error_m, "bearing_error_deg": 0.02 if found else None, "saturated": found and False,
    } | changes  # fmt: skip


def frame(false_alarms: int = 0, **changes: Any) -> Row:
    return {
        "kind": "frame", "camera": "r1.front", "index": 0, "frame_false_alarms": false_alarms,
        "frame_ghosts_reported": 0, "frame_lamps_reported": 0, "exposure_s": 1e-3, "gain": 1.0,
        "render_noise_share": 0.004, "render_noise_target": 0.05,
    } | changes  # fmt: skip


def sequence(hota: float | None, switches: int = 0, **changes: Any) -> Row:
    return {
        "kind": "sequence", "camera": "r1", "track_hota": hota, "track_idf1": hota, "track_switches": switches,
        "message_wrong": 0, "message_bit_error_rate": None,
    } | changes  # fmt: skip


def packet(received: bool) -> Row:
    return {"kind": "packet", "camera": "r1", "robot": "r2", "source": "top", "received": received}


def table(
    axes: Sequence[Axis],
    seeds: int,
    rows: Callable[[dict[str, int], int, str], list[Row]],
    estimators: Sequence[str] = ("paper", "robust"),
) -> pa.Table:
    """Return the table of every combination of values; `rows` gets the indices by axis name, seed, estimator."""
    out: list[Row] = []
    for values in combinations_of(axes):
        for seed in range(1, seeds + 1):
            at = {axis.name: index for axis, index in zip(axes, values, strict=True)}
            own: Row = {"job": f"{'-'.join(map(str, values))}-{seed}", "seed": seed}
            for axis, index in zip(axes, values, strict=True):
                own[f"axis.{axis.name}"] = (
                    axis.labels[index] if axis.values_si is None else axis.values_si[index]
                )
            for name in estimators:
                out += [{**own, "estimator": name, **row} for row in rows(at, seed, name)]
    types = {
        **dict.fromkeys(("seed", "index", "frame_false_alarms", "frame_ghosts_reported", "frame_lamps_reported"), pa.int64()),
        **dict.fromkeys(("track_switches", "message_wrong"), pa.int64()),
        **dict.fromkeys(("countable", "found", "ranged", "saturated", "received"), pa.bool_()),
        **dict.fromkeys(("job", "estimator", "kind", "camera", "robot", "source"), pa.string()),
        **{f"axis.{axis.name}": pa.string() if axis.values_si is None else pa.float64() for axis in axes},
        **dict.fromkeys((*_SOURCE_NUMBERS, *_FRAME_NUMBERS, *_SEQUENCE_NUMBERS), pa.float64()),
    }  # fmt: skip
    return pa.Table.from_pylist(out, schema=pa.schema(list(types.items())))


def clutter(seeds: int = 2, per_job: int = 6) -> tuple[list[Axis], pa.Table]:
    """Range × visibility × lamp: `paper` is biased by fog and lamps, `robust` near its limit, blind in thick fog."""
    axes = [RANGE, FOG, LAMP]

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        range_m = (RANGE.numbers or ())[at[RANGE.name]]
        visibility_m = (FOG.numbers or ())[at[FOG.name]]
        lamp = at["lamp"]
        random = generator(seed, f"clutter/{name}", "", at[RANGE.name] * 100 + at[FOG.name] * 10 + lamp)
        depth = 3.9 * range_m / visibility_m
        limit_m = 0.003 * range_m**2 * math.exp(0.3 * depth) * (1.0 + 0.5 * lamp)
        out = [frame(int(random.poisson(0.05 + 0.2 * lamp) if name == "paper" else random.poisson(0.004)))]
        for _ in range(per_job):
            countable = depth < 3.0
            seen = random.random() < (
                0.995 if name == "robust" else 1.0 / (1.0 + math.exp(2.0 * (depth - 2.2 + 0.3 * lamp)))
            )
            bias = (
                -0.08 * range_m * (1.0 + depth) * (1.0 + 0.4 * lamp)
                if name == "paper"
                else 0.002 * range_m * lamp
            )
            error = bias + random.normal() * limit_m * (2.0 if name == "paper" else 1.08)
            out.append(
                source(
                    float(error) if seen else None, countable=bool(countable), true_range_m=range_m,
                    range_limit_m=limit_m, bearing_limit_deg=0.003 * range_m,
                    bearing_error_deg=abs(0.004 * range_m * random.normal()) if seen else None,
                )
            )  # fmt: skip
        return out

    return axes, table(axes, seeds, rows)
