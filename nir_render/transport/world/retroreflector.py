"""The surface that sends light back to where it came from, as Mitsuba asks for it.

Of directions at angles θ_i and θ_o to the normal, α apart,

    f = ρ/π + R_A(α, β) min(1, cos θ_i cos θ_o / cos² β_last) / (cos θ_i cos θ_o),   β = max(θ_i, θ_o):

the luminous intensity R_A E⊥ A of CIE 54.2 over A cos θ_o and the illuminance E⊥ cos θ_i. It is the same with
both directions exchanged. In the coplanar geometry of ASTM E810, the observer between light and normal, β is
the entrance angle itself.

Directions of the lobe are drawn by tables of R_A at two entrance angles beside θ_i, evenly in each cell of
the versine of α and around the light: their density is known exactly.
"""

from functools import cache
from typing import Any

import numpy as np

from nir_render.scene.documents.matter.retroreflection import Lobe
from nir_render.transport.backend.variant import dr, mi


def retroreflector(lobe: Lobe, reflectance: float) -> Any:
    """Return the BSDF of a lobe over a Lambertian ground, for one side; vectorised variants alone."""
    return _model()(lobe, reflectance)


@cache
def _model() -> Any:
    """Return the class, which cannot be made before Mitsuba's variant is set."""

    class Retroreflector(mi.BSDF):  # type: ignore[misc]
        """What Mitsuba asks for; directions are in the surface's own axes."""

        def __init__(self, lobe: Lobe, reflectance: float) -> None:
            mi.BSDF.__init__(self, mi.Properties("retroreflector"))
            side = mi.BSDFFlags.FrontSide
            self.m_components = [
                mi.BSDFFlags.DiffuseReflection | side,
                mi.BSDFFlags.GlossyReflection | side,
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]
            rows, columns = lobe.values_cd_per_lx_m2.shape
            self._rows, self._cells = rows - 1, columns - 1
            self._end = float(lobe.end_rad)
            self._limit = float(np.cos(lobe.roll_off_rad) ** 2)
            self._ground = float(reflectance)
            versine = 2.0 * np.sin(0.5 * lobe.observation_rad) ** 2
            middle = 0.5 * (lobe.values_cd_per_lx_m2[:, 1:] + lobe.values_cd_per_lx_m2[:, :-1])
            mass = 2.0 * np.pi * middle * np.diff(versine)
            cumulative = np.concatenate([np.zeros((rows, 1)), np.cumsum(mass, axis=1)], axis=1)
            self._versine = mi.Float(versine.astype(np.float32))
            self._values = mi.Float(lobe.values_cd_per_lx_m2.astype(np.float32).ravel())
            self._back = mi.Float(cumulative[:, -1].astype(np.float32))
            self._cumulative = mi.Float((cumulative / cumulative[:, -1:]).astype(np.float32).ravel())
            dr.eval(self._versine, self._values, self._back, self._cumulative)

        def _place(self, cosine: Any) -> tuple[Any, Any]:
            """Return the row of the table below an entrance angle, and how far it lies to the next."""
            place = dr.acos(dr.clip(cosine, 0.0, 1.0)) * (self._rows / (0.5 * dr.pi))
            row = mi.UInt32(dr.minimum(dr.maximum(place, 0.0), self._rows - 1.0))
            return row, place - mi.Float(row)

        def _angle(self, versine: Any) -> Any:
            return 2.0 * dr.asin(dr.minimum(dr.safe_sqrt(0.5 * versine), 1.0))

        def _cell(self, versine: Any) -> tuple[Any, Any]:
            """Return the cell that holds an observation angle, and how far into it it lies."""
            angle = self._angle(versine)
            place = dr.sqrt(angle / self._end) * self._cells
            cell = mi.UInt32(dr.minimum(place, self._cells - 1.0))
            low = self._end * dr.square(mi.Float(cell) / self._cells)
            high = self._end * dr.square((mi.Float(cell) + 1.0) / self._cells)
            return cell, dr.clip((angle - low) / (high - low), 0.0, 1.0)

        def _lobe(self, wi: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """Return f cos θ_o of the lobe, and the density per sr with which it is drawn."""
            versine = 0.5 * dr.squared_norm(wo - wi)
            cell, share = self._cell(versine)
            within = active & (versine < 2.0 * np.sin(0.5 * self._end) ** 2)
            row, on = self._place(dr.minimum(wi.z, wo.z))
            stride = self._cells + 1
            first = row * stride + cell
            value = dr.lerp(
                dr.lerp(self._read(first, within), self._read(first + 1, within), share),
                dr.lerp(self._read(first + stride, within), self._read(first + stride + 1, within), share),
                on,
            )
            value = value * dr.minimum(1.0, wi.z * wo.z / self._limit) / wi.z
            own, on = self._place(wi.z)
            low = dr.gather(mi.Float, self._versine, cell, within)
            high = dr.gather(mi.Float, self._versine, cell + 1, within)
            mass = dr.lerp(self._share(own, cell, within), self._share(own + 1, cell, within), on)
            density = mass / (2.0 * dr.pi * (high - low))
            return dr.select(within, value, 0.0), dr.select(within, density, 0.0)

        def _read(self, place: Any, active: Any) -> Any:
            return dr.gather(mi.Float, self._values, place, active)

        def _share(self, row: Any, cell: Any, active: Any) -> Any:
            first = row * (self._cells + 1) + cell
            return dr.gather(mi.Float, self._cumulative, first + 1, active) - dr.gather(
                mi.Float, self._cumulative, first, active
            )

        def _chance(self, wi: Any, active: Any) -> Any:
            """Return how often the lobe is drawn rather than the ground: by what of light each sends on."""
            row, on = self._place(wi.z)
            back = dr.lerp(
                dr.gather(mi.Float, self._back, row, active),
                dr.gather(mi.Float, self._back, row + 1, active),
                on,
            )
            back = back * dr.minimum(1.0, dr.square(wi.z) / self._limit) / dr.maximum(wi.z, 1e-6)
            return back / (back + self._ground)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> tuple[Any, Any]:
            """Draw a direction: of the lobe, or of the ground."""
            wi = si.wi
            active = active & (wi.z > 0.0)
            chance = self._chance(wi, active)
            lobe = active & (sample1 < chance)
            # A number below the chance, stretched, says which of two rows: their shares are those of `_lobe`.
            row, on = self._place(wi.z)
            row = dr.select(sample1 < chance * on, row + 1, row)
            first = row * (self._cells + 1)
            cell = dr.binary_search(
                0,
                self._cells - 1,
                lambda k: dr.gather(mi.Float, self._cumulative, first + k + 1, lobe) <= sample2.x,
            )
            before = dr.gather(mi.Float, self._cumulative, first + cell, lobe)
            after = dr.gather(mi.Float, self._cumulative, first + cell + 1, lobe)
            within = dr.clip((sample2.x - before) / dr.maximum(after - before, 1e-12), 0.0, 1.0)
            low = dr.gather(mi.Float, self._versine, cell, lobe)
            high = dr.gather(mi.Float, self._versine, cell + 1, lobe)
            versine = dr.lerp(low, high, within)
            sine = dr.safe_sqrt(versine * (2.0 - versine))
            sin_turn, cos_turn = dr.sincos(2.0 * dr.pi * sample2.y)
            back = mi.Frame3f(wi).to_world(mi.Vector3f(sine * cos_turn, sine * sin_turn, 1.0 - versine))
            wo = dr.select(lobe, back, mi.warp.square_to_cosine_hemisphere(sample2))
            value, density = self.eval_pdf(ctx, si, wo, active)
            found = dr.zeros(mi.BSDFSample3f)
            found.wo = wo
            found.pdf = density
            found.eta = 1.0
            found.sampled_component = dr.select(lobe, mi.UInt32(1), mi.UInt32(0))
            found.sampled_type = dr.select(
                lobe, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            drawn = active & (density > 0.0)
            return found, dr.select(drawn, value / dr.select(drawn, density, 1.0), 0.0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """Return f cos θ_o of what is asked for, and the density of `sample` per sr."""
            wi = si.wi
            active = active & (wi.z > 0.0) & (wo.z > 0.0)
            lobe, lobe_density = self._lobe(wi, wo, active)
            ground, even = self._ground * wo.z / dr.pi, wo.z / dr.pi
            value = mi.Float(0.0)
            if ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0):
                value = value + ground
            if ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1):
                value = value + lobe
            density = dr.lerp(even, lobe_density, self._chance(wi, active))
            return mi.Spectrum(dr.select(active, value, 0.0)), dr.select(active, density, 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            """Return the first of `eval_pdf`."""
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            """Return the second of `eval_pdf`."""
            return self.eval_pdf(ctx, si, wo, active)[1]

        def to_string(self) -> str:
            """Return its name."""
            return "Retroreflector[]"

    return Retroreflector
