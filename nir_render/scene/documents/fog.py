"""Models of fog: how much it takes from light on its way, how it scatters, and where it lies."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.errors import InputError, shown
from nir_render.scattering.optics import Optics, mean_cosine
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.scene.documents.base import Document, Extinction, Fraction, Length, Position, Size3, typed
from nir_render.scene.documents.curves import (
    Points,
    one_form,
    parse_half_turn,
    parse_points,
    read_curve,
    write_points,
)
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.text.units import (
    ANGLE,
    EXTINCTION,
    LENGTH,
    VISIBILITY,
    format_quantity,
    parse_quantity,
)

# Koschmieder: an extinction of σ dims a contrast to 2 % over a distance of −ln 0.02 / σ = 3.912/σ.
_VISIBILITY_TIMES_EXTINCTION = 3.912

_LEAST_DENSITY = 1e-6  # less is none in float32

MOST_HEIGHTS = 63
"""So many points a profile may have."""

UNNAMED_DROPLETS = "radiation_heavy"
"""Whose σ(940)/σ(550) a visibility counts with where a scene names no droplets: the middle of four fogs."""

UNNAMED_RATIO_SIGMA = 0.014
"""Standard deviation of that ratio over the four fogs, which lie from 1.012 to 1.044; assumed."""


class HenyeyGreenstein(Document):
    """The phase function of Henyey & Greenstein; `g` is its mean cosine, 1 straight on.

    The default is that of heavy fog near 940 nm by Mie theory (0.84 to 0.87); assumed.
    """

    type: Literal["henyey_greenstein"]
    g: Annotated[float, Field(ge=-0.99, le=0.99)] = 0.85


class TabulatedPhase(Document):
    """A phase function as [angle, relative value] points, linear between them; 0 deg is straight on.

    `file` is a CSV with the header `angle_deg,value`; it becomes points when the scene is loaded. The angles
    go from exactly 0 to exactly 180 deg, in steps of any size.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    type: Literal["table"]
    points: Points

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        cls.check_keys(data)
        one_form(data, ("points", "file"))
        if data.get("file") is None:
            return data
        rows = read_curve(resolve_file(str(data["file"]), info), "angle_deg,value")
        others = {key: value for key, value in data.items() if key != "file"}
        return {**others, "points": [(f"{angle_deg!r} deg", value) for angle_deg, value in rows]}

    @field_validator("points", mode="before")
    @classmethod
    def _parse_points(cls, points: Any) -> Points:
        return parse_half_turn(points, "angles")

    @field_serializer("points")
    def _write_points(self, points: Points) -> list[list[Any]] | None:
        return write_points(points, ANGLE)


class MiePhase(Document):
    """The phase function of the fog's `droplets`, by Mie theory, forward peak and all.

    It stands in resolved scenes; who names droplets need not write it.
    """

    type: Literal["mie"]


PhaseDocument = Annotated[
    HenyeyGreenstein | TabulatedPhase | MiePhase,
    Field(discriminator="type"),
    typed("{type: henyey_greenstein, g: 0.85}", HenyeyGreenstein, TabulatedPhase, MiePhase),
]


class Fog(Document):
    """Fog: everywhere, below z = `top`, or in a box of `size` about `center`.

    `extinction` is σ_t at 940 nm in light lost per metre; 0 /m is clear air. Or `visibility`, the
    meteorologist's, 3.912/σ_t at 550 nm: it becomes the extinction at 940 nm when the scene is loaded, by the
    droplets' σ(940)/σ(550), without droplets by that of `radiation_heavy`, 1.0275 ± 0.014 (assumed).

    `profile` are [z, density] points, the density at heights over that of `extinction`: linear between them,
    below and above as at the ends; where that is 0, the fog ends there. Without it density is one.

    `droplets` say all else by Mie theory. Without them `albedo` is the share of what is lost that is
    scattered, and not absorbed, and `phase` where to.
    """

    example: ClassVar[str] = "{visibility: 50 m}"
    read_keys: ClassVar[tuple[str, ...]] = ("visibility",)

    extinction_per_m: Annotated[Extinction, Field(ge=0)]
    albedo: Annotated[Fraction, Field(ge=0, le=1)] = 0.9995
    phase: PhaseDocument = HenyeyGreenstein(type="henyey_greenstein")
    droplets: Droplets | None = None
    top_m: Length | None = None
    center_m: Position | None = None
    size_m: Size3 | None = None
    profile: Points | None = None

    @field_validator("profile", mode="before")
    @classmethod
    def _parse_profile(cls, points: Any) -> Any:
        return None if points is None else parse_points(points, LENGTH, "height", "['0.5 m', 1.0]")

    @field_serializer("profile")
    def _write_profile(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, LENGTH)

    @model_validator(mode="before")
    @classmethod
    def _read_visibility(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        cls.check_keys(data)
        one_form(data, ("extinction", "visibility"))
        optics: Optics | None = None
        if data.get("droplets") is not None:
            droplets = Droplets.model_validate(data["droplets"], context=info.context)
            optics = _optics(droplets)
            _only_droplets(data, optics)
            phase, albedo = {"type": "mie"}, 1.0 - optics.absorbed_share
            data = {**data, "droplets": droplets, "phase": phase, "albedo": albedo}
        others = {key: value for key, value in data.items() if key != "visibility"}
        if data.get("visibility") is None:
            return others
        try:
            visibility_m = parse_quantity(data["visibility"], VISIBILITY)
        except ValueError as error:
            raise ValueError(f"visibility: {error}") from None
        if visibility_m <= 0.0:
            raise ValueError(
                f"visibility: {shown(data['visibility'])} is not greater than 0; write one such as '50 m'"
            )
        per_m = _ratio(optics) * _VISIBILITY_TIMES_EXTINCTION / visibility_m
        if per_m > EXTINCTION.most:
            raise ValueError(
                f"visibility: {shown(data['visibility'])} is too short: its extinction is beyond "
                f"{EXTINCTION.most:g} 1/m; check number and unit"
            )
        return {**others, "extinction": format_quantity(per_m, EXTINCTION)}

    @model_validator(mode="after")
    def _mie_needs_droplets(self) -> Self:
        if isinstance(self.phase, MiePhase) and self.droplets is None:
            raise ValueError("phase: the type 'mie' needs 'droplets', such as droplets: advection_heavy")
        return self

    @model_validator(mode="after")
    def _profile_within_bounds(self) -> Self:
        if self.profile is None:
            return self
        if len(self.profile) > MOST_HEIGHTS:
            raise ValueError(
                f"profile: has {len(self.profile)} points; wanted {MOST_HEIGHTS} at most, linear between them"
            )
        densest = max(density for _, density in self.profile)
        if densest < _LEAST_DENSITY:
            raise ValueError(
                f"profile: is below {_LEAST_DENSITY:g} at every height; leave the fog out for clear air"
            )
        if self.densest_per_m() > EXTINCTION.most:
            raise ValueError(
                f"profile: {densest:g} times the extinction is beyond {EXTINCTION.most:g} 1/m; check both"
            )
        return self

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.center_m is None) != (self.size_m is None):
            raise ValueError("a fog bank needs both 'center' and 'size'")
        if self.top_m is not None and self.center_m is not None:
            raise ValueError(
                "wanted either 'top' (all below it) or 'center' and 'size' (a bank of fog), not both"
            )
        if self.size_m is not None and min(self.size_m) <= 0.0:
            raise ValueError("size: each extent must be greater than 0")
        return self

    @model_validator(mode="after")
    def _profile_within_region(self) -> Self:
        low_m, high_m = self.region_m()
        if self.profile is not None and low_m[2] >= high_m[2]:
            raise ValueError(
                f"profile: begins at {low_m[2]:g} m, and the fog ends at {high_m[2]:g} m; its heights "
                "are z in the world, as those of 'top' and 'center'"
            )
        return self

    def densest_per_m(self) -> float:
        """Return the extinction where the fog is densest."""
        return self.extinction_per_m * max((density for _, density in self.profile or ()), default=1.0)

    def region_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest corner of the box that the fog fills, shape (3,); ±inf where open."""
        low_m, high_m = np.full(3, -np.inf), np.full(3, np.inf)
        if self.top_m is not None:
            high_m[2] = self.top_m
        if self.center_m is not None and self.size_m is not None:
            center_m, half_m = np.array(self.center_m), 0.5 * np.array(self.size_m)
            low_m, high_m = center_m - half_m, center_m + half_m
        if self.profile is not None:  # a density of 0 at an end is one beyond it
            (lowest_m, below), (highest_m, above) = self.profile[0], self.profile[-1]
            low_m[2] = low_m[2] if below else max(low_m[2], lowest_m)
            high_m[2] = high_m[2] if above else min(high_m[2], highest_m)
        return low_m, high_m

    def asymmetry(self) -> float:
        """Return g, the mean cosine of scattered light."""
        if self.droplets is not None:
            return self.droplets.optics.asymmetry
        if isinstance(self.phase, TabulatedPhase):
            angle_rad, value = np.array(self.phase.points).T
            return mean_cosine(angle_rad, value)
        assert isinstance(self.phase, HenyeyGreenstein)  # the phase of droplets needs them
        return self.phase.g

    def facts(self) -> dict[str, Any]:
        """Return what the fog is at 940 nm, and at 550 nm where eyes see it, as a JSON object.

        `ratio_sigma` is null where droplets tell the ratio, their number where they are unknown.
        """
        optics = None if self.droplets is None else self.droplets.optics
        ratio, known = _ratio(optics), optics is not None
        visible_per_m = self.extinction_per_m / ratio
        number_per_m3 = None if optics is None else self.extinction_per_m / optics.extinction_m2
        return {
            "extinction_per_m": self.extinction_per_m,
            "profile": None if self.profile is None else [list(point) for point in self.profile],
            "visibility_m": _VISIBILITY_TIMES_EXTINCTION / visible_per_m if visible_per_m > 0.0 else None,
            "ratio_940_to_550": ratio,
            "ratio_sigma": None if known else UNNAMED_RATIO_SIGMA,
            "ratio_of": (optics.name or "the scene's droplets")
            if optics
            else f"{UNNAMED_DROPLETS} (assumed)",
            "albedo": self.albedo,
            "absorbed_share": optics.absorbed_share if optics else 1.0 - self.albedo,
            "asymmetry": self.asymmetry(),
            "phase": self.phase.type,
            "droplets_per_cm3": None if number_per_m3 is None else 1e-6 * number_per_m3,
            "volume_cm3_per_m3": None
            if number_per_m3 is None or optics is None
            else 1e6 * number_per_m3 * optics.volume_m3,
        }


def _optics(droplets: Droplets) -> Optics:
    try:
        return droplets.optics
    except InputError as error:
        raise ValueError(f"droplets: {error}") from None


def _only_droplets(data: Mapping[str, Any], optics: Optics) -> None:
    """Raise ValueError where a fog of droplets says otherwise what these tell; resolved ones say the same."""
    phase, albedo = data.get("phase"), data.get("albedo")
    kind = phase.get("type") if isinstance(phase, Mapping) else getattr(phase, "type", None)
    # Sums of another processor differ in their last digits.
    same = albedo is None or (
        isinstance(albedo, float) and math.isclose(albedo, 1.0 - optics.absorbed_share, rel_tol=1e-6)
    )
    if (phase is not None and kind != "mie") or not same:
        raise ValueError(
            "wanted either 'droplets', which tell albedo and phase, or 'albedo' and 'phase'; leave one out"
        )


def _ratio(optics: Optics | None) -> float:
    """Return σ(940)/σ(550)."""
    return (Droplets.model_validate(UNNAMED_DROPLETS).optics if optics is None else optics).ratio
