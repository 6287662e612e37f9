"""The independent check: a scene rendered by Mitsuba's own `path` and `volpath`, written out here again.

`stock_radiance` takes a scene document as plain data, as YAML gives it, and renders it in another process.
Nothing of the program's is imported there: units are read, shapes placed, materials and emission built a
second time, so that a fault has to be made twice to pass. It knows only what the test scenes use: cameras that
look along +x, rectangles, boxes turned by yaw, spheres, cylinders, fog everywhere.

Two habits of Mitsuba's to know: a sphere samples the cone that it fills as 1 − cos α in float32, so sources here
are large and near (6 cm or more at 4 m or less); fog around the camera is ignored unless the sensor names it.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FOG_REACH_M = 100.0


def stock_radiance(
    document: Mapping[str, Any],
    emitting: Sequence[Sequence[str]],
    *,
    samples: int,
    batches: int,
    variant: str,
    max_depth: int | None = None,
    seed: int = 1,
) -> NDArray[np.float64]:
    """Return the whole radiance of a scene, straight light included, per watt of each emitting group.

    Parameters
    ----------
    document
        The scene, with one camera; its `render.indirect.max_depth` holds unless `max_depth` is given.
    emitting
        One render per entry: the groups, `robot.source` or `lamps.name`, that send one watt each in it.
    samples, batches
        Samples per pixel in each batch, a power of two, and the number of batches, each of another seed.

    Returns
    -------
    Radiance in 1/(m² sr), shape (renders, batches, rows, columns).
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "stock.npy"
        case = {
            "document": document, "emitting": [list(groups) for groups in emitting], "samples": samples, "batches": batches,
            "variant": variant, "max_depth": max_depth or document["render"]["indirect"]["max_depth"], "seed": seed,
            "out": str(out),
        }  # fmt: skip
        done = subprocess.run(
            [sys.executable, __file__], input=json.dumps(case), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return np.asarray(np.load(out))


def _numbers(text: str | Sequence[float]) -> list[float]:
    """Read "[1, 2, 3] m" or "8 cm" in metres, "25 deg" in degrees, "0.05 /m" per metre, or a plain list."""
    if not isinstance(text, str):
        return [float(value) for value in text]
    number, _, unit = text.rpartition(" ")
    scale = {"m": 1.0, "cm": 0.01, "mm": 0.001, "deg": 1.0, "/m": 1.0}[unit]
    return [scale * float(value) for value in number.strip("[]").split(",")]


class _Builder:
    """Makes Mitsuba's scene of a document."""

    def __init__(self, mi: Any, document: Mapping[str, Any]) -> None:
        self.mi = mi
        self.document = document
        self.black = {"type": "diffuse", "reflectance": self._value(0.0)}
        fog = document.get("fog")
        self.fog = None if fog is None else self._medium(fog)

    def scene(self, emitting: Sequence[str]) -> Any:
        made: dict[str, Any] = {"type": "scene"}
        for name, shape in self.document.get("shapes", {}).items():
            surface = self._surface(self.document["materials"][shape["material"]])
            for index, part in enumerate(self._parts(shape)):
                made[f"{name}_{index}"] = {**part, "bsdf": surface, **self._surroundings()}
        for robot, entry in self.document["robots"].items():
            for name, source in entry["rig"].get("sources", {}).items():
                (radius_m,) = _numbers(source["radius"])
                ball = {
                    "type": "sphere",
                    "center": _numbers(entry["position"]),
                    "radius": radius_m,
                    "bsdf": self.black,
                }
                shining = f"{robot}.{name}" in emitting
                # One watt from 4π r², each element of it into π: L = 1 / (4π² r²).
                shine = self._shine(1.0 / (4.0 * np.pi**2 * radius_m**2)) if shining else {}
                made[f"source_{robot}_{name}"] = {**ball, **shine, **self._surroundings()}
        for name, lamp in self.document.get("lamps", {}).items():
            panel = {**lamp, "normal": lamp.get("normal", [0, 0, -1])}
            width_m, height_m = _numbers(lamp["size"])
            shine = self._shine(1.0 / (np.pi * width_m * height_m)) if f"lamps.{name}" in emitting else {}
            made[f"lamp_{name}"] = {
                **self._rectangle(panel),
                "bsdf": self.black,
                **shine,
                **self._surroundings(),
            }
        if self.fog is not None:
            made["edge"] = {
                "type": "cube", "to_world": self.mi.ScalarTransform4f().scale(_FOG_REACH_M), "bsdf": {"type": "null"},
                "interior": self.fog,
            }  # fmt: skip
        return self.mi.load_dict(made, optimize=False)

    def sensor(self) -> Any:
        (robot,) = (entry for entry in self.document["robots"].values() if "cameras" in entry["rig"])
        (camera,) = robot["rig"]["cameras"].values()
        at = np.array(_numbers(robot.get("position", [0.0, 0.0, 0.0])))
        width = camera["sensor"]["columns"]
        pitch_m = float(camera["sensor"]["pixel_pitch"].removesuffix(" um")) * 1e-6
        (focal_m,) = _numbers(camera["lens"]["focal_length"])
        transform = self.mi.ScalarTransform4f().look_at(
            origin=at.tolist(), target=[*(at[:1] + 1.0), *at[1:]], up=[0, 0, 1]
        )
        made = {
            "type": "perspective", "fov": float(np.degrees(2.0 * np.arctan(0.5 * width * pitch_m / focal_m))),
            "fov_axis": "x", "near_clip": 1e-3, "to_world": transform, "sampler": {"type": "independent"},
            "film": {"type": "hdrfilm", "width": width, "height": camera["sensor"]["rows"], "pixel_format": "luminance",
                     "component_format": "float32", "rfilter": {"type": "box"}},
        }  # fmt: skip
        if self.fog is not None:
            made["medium"] = self.fog
        return self.mi.load_dict(made)

    def _value(self, value: float) -> dict[str, Any]:
        return {"type": "uniform", "value": float(value)}

    def _shine(self, radiance: float) -> dict[str, Any]:
        return {"emitter": {"type": "area", "radiance": self._value(radiance)}}

    def _medium(self, fog: Mapping[str, Any]) -> Any:
        assert fog["phase"]["type"] == "henyey_greenstein"
        (extinction_per_m,) = _numbers(fog["extinction"])
        return self.mi.load_dict({
            "type": "homogeneous", "sigma_t": self._value(extinction_per_m), "albedo": self._value(fog["albedo"]),
            "phase": {"type": "hg", "g": float(fog["phase"]["g"])},
        })  # fmt: skip

    def _surroundings(self) -> dict[str, Any]:
        """Both sides of every surface lie in the fog; nothing opaque is entered."""
        return {} if self.fog is None else {"exterior": self.fog, "interior": self.fog}

    def _surface(self, material: Mapping[str, Any]) -> dict[str, Any]:
        match material["type"]:
            case "diffuse":
                made: dict[str, Any] = {
                    "type": "diffuse",
                    "reflectance": self._value(material["reflectance"]),
                }
            case "rough_conductor":
                made = {
                    "type": "roughconductor", "distribution": "ggx", "alpha": material["roughness"],
                    "eta": self._value(material["index"]), "k": self._value(material["extinction_index"]),
                }  # fmt: skip
            case "plastic":
                rough = {"type": "roughplastic", "distribution": "ggx", "alpha": material["roughness"]}
                made = {
                    **(rough if material["roughness"] else {"type": "plastic"}), "ext_ior": 1.0,
                    "int_ior": material["index"], "diffuse_reflectance": self._value(material["reflectance"]),
                }  # fmt: skip
            case "dielectric":
                return {"type": "dielectric", "int_ior": material["index"], "ext_ior": 1.0}
            case "mirror":
                reflectance = self._value(material["reflectance"])
                made = {"type": "conductor", "material": "none", "specular_reflectance": reflectance}
            case other:
                raise ValueError(other)
        return {"type": "twosided", "bsdf": made}

    def _parts(self, shape: Mapping[str, Any]) -> list[dict[str, Any]]:
        transform = self.mi.ScalarTransform4f
        match shape["type"]:
            case "rectangle":
                return [self._rectangle(shape)]
            case "box":
                (yaw_deg,) = _numbers(shape.get("orientation", {}).get("yaw", "0 deg"))
                half = [0.5 * edge for edge in _numbers(shape["size"])]
                placed = (
                    transform().translate(_numbers(shape["center"])).rotate([0, 0, 1], yaw_deg).scale(half)
                )
                return [{"type": "cube", "to_world": placed}]
            case "sphere":
                (radius_m,) = _numbers(shape["radius"])
                return [{"type": "sphere", "center": _numbers(shape["center"]), "radius": radius_m}]
            case "cylinder":
                start, end, (radius_m,) = (_numbers(shape[key]) for key in ("start", "end", "radius"))
                up = (np.array(end) - start) / np.linalg.norm(np.array(end) - start)
                caps = [
                    {"type": "disk", "to_world": transform().look_at(
                        origin=at, target=(np.array(at) + sign * up).tolist(), up=np.roll(up, 1).tolist(),
                    ).scale([radius_m, radius_m, 1.0])}
                    for at, sign in ((start, -1.0), (end, 1.0))
                ]  # fmt: skip
                return [{"type": "cylinder", "p0": start, "p1": end, "radius": radius_m}, *caps]
            case other:
                raise ValueError(other)

    def _rectangle(self, shape: Mapping[str, Any]) -> dict[str, Any]:
        """Width lies level, along x where the rectangle faces up or down; Mitsuba's spans −1 to 1 and faces z."""
        centre, normal = _numbers(shape["center"]), shape.get("normal", [0, 0, 1])
        width_m, height_m = _numbers(shape["size"])
        level = normal[0] == normal[1] == 0
        target = (np.array(centre) + normal).tolist()
        turned = self.mi.ScalarTransform4f().look_at(
            origin=centre, target=target, up=[0, 1, 0] if level else [0, 0, 1]
        )
        return {"type": "rectangle", "to_world": turned.scale([0.5 * width_m, 0.5 * height_m, 1.0])}


def _main() -> None:
    case = json.loads(sys.stdin.read())
    import mitsuba as mi

    mi.set_variant(case["variant"])
    made = _Builder(mi, case["document"])
    kind = "path" if made.fog is None else "volpath"
    integrator = mi.load_dict({"type": kind, "max_depth": case["max_depth"]})
    sensor = made.sensor()
    renders = []
    for number, emitting in enumerate(case["emitting"]):
        scene = made.scene(emitting)
        seeds = [case["seed"] * 100_000 + number * 1_000 + batch for batch in range(case["batches"])]
        stack = [
            np.array(
                mi.render(scene, sensor=sensor, integrator=integrator, spp=case["samples"], seed=seed),
                np.float64,
            )
            for seed in seeds
        ]
        renders.append(np.stack(stack).reshape(len(stack), *stack[0].shape[:2]))
    np.save(case["out"], np.stack(renders))


if __name__ == "__main__":
    _main()
