"""Models of what fog, drizzle, smoke and dust are made of: sizes of spheres, and their refractive index."""

from functools import cached_property
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nir_render.scattering import sizes
from nir_render.scattering.optics import Optics, Particles, optics_of
from nir_render.scene.documents.base import Document, Extinction, Length, typed
from nir_render.scene.documents.files import PresetDocument


class ModifiedGamma(Document):
    """Sizes n(r) ∝ r^power · exp(−slope · r), r the radius: how fogs are mostly given."""

    type: Literal["modified_gamma"]
    power: Annotated[float, Field(ge=0, le=50)]
    slope_per_m: Annotated[Extinction, Field(ge=1e3, le=1e9)]

    def sizes(self) -> sizes.Sizes:
        """Return the distribution."""
        return sizes.ModifiedGamma(self.power, self.slope_per_m)


class Lognormal(Document):
    """Sizes of which half, by number, lie below the radius `median`; `spread` is their geometric σ."""

    type: Literal["lognormal"]
    median_m: Annotated[Length, Field(ge=1e-9, le=1e-3)]
    spread: Annotated[float, Field(ge=1.02, le=2.5)]

    def sizes(self) -> sizes.Sizes:
        """Return the distribution."""
        return sizes.Lognormal(self.median_m, self.spread)


SizesDocument = Annotated[
    ModifiedGamma | Lognormal,
    Field(discriminator="type"),
    typed('{type: modified_gamma, power: 3, slope: "0.3 /um"}', ModifiedGamma, Lognormal),
]


class ComplexIndex(Document):
    """A refractive index n − ik, relative to air."""

    example: ClassVar[str] = "{n: 1.3264, k: 2.2e-6}"

    n: Annotated[float, Field(ge=1, le=5)]
    k: Annotated[float, Field(ge=0, le=10)]

    @property
    def value(self) -> complex:
        """N − ik."""
        return complex(self.n, -self.k)


class Droplets(PresetDocument):
    """Spheres in the air: their `sizes`, their refractive index at 940 nm, and `index_550` at 550 nm.

    Without an index they are water: n by Daimon and Masumura (Appl. Opt. 46, 3811, 2007) at 20 °C, k by
    Segelstein (thesis, University of Missouri, 1981). Beside the droplets, the fog says how many there are.
    """

    preset_folder: ClassVar[str] = "droplets"
    example: ClassVar[str] = '{sizes: {type: modified_gamma, power: 3, slope: "0.3 /um"}}'

    sizes: SizesDocument
    index: ComplexIndex = ComplexIndex(n=1.3264, k=2.19e-6)
    index_550: ComplexIndex = ComplexIndex(n=1.3347, k=2.46e-9)

    @cached_property
    def optics(self) -> Optics:
        """What they do to light."""
        return optics_of(Particles(self.sizes.sizes(), self.index.value, self.index_550.value))
