"""A flare as it is measured: its place, flux and range, and how well they are known."""

import math
from dataclasses import dataclass, replace

from perception.model.fog import may_be_in_fog
from perception.robust.hiding.covered import hidden_log_range
from perception.robust.overlap.deblend import RESIDUAL_SIGMAS
from perception.robust.search.blobs import Blob
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution

CLIPPED_RANGE_SIGMA = 0.125
"""A clipped flare counts as recovered if its fit claims its range to better than this, relatively."""


@dataclass(frozen=True)
class MeasuredFlare:
    """Place, flux and range of a flare; NaN where no claim is made. `background_e` is per pixel.

    `flux_noise_e` is the part of the σ of its flux that its light brings, not that it may be another's.
    `log_range_of_model` is the part of the relative σ of its range that its own misfit brings.
    `log_range_doubt` is the part of the relative σ of its range that comes of what sources hide, of each
    other and of the background, and of its being two perhaps; `log_range_doubt_common` that of the background
    alone. `lone` is its fit, where that is of one flare.
    """

    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_e: float
    flux_sigma_e: float
    flux_noise_e: float
    background_e: float
    range_m: float
    range_sigma_m: float
    range_sigma_common_m: float = math.nan
    range_by_size_m: float = math.nan
    range_by_size_sigma_m: float = math.nan
    log_range_of_model: float = 0.0
    log_range_doubt: float = 0.0
    log_range_doubt_common: float = 0.0
    saturated: bool = False
    misfit: bool = False
    is_doubtful: bool = False
    may_be_more: bool = False
    on_texture: bool = False
    on_edges: bool = False
    lone: Solution | None = None

    @property
    def alone(self) -> Solution | None:
        """Its fit, where nothing else is seen beside it and nothing clips."""
        one = self.lone
        return one if one is not None and one.window.is_even and not self.saturated else None

    @property
    def stands_out(self) -> bool:
        """Whether its flux exceeds the background right beside it by 4 σ.

        A clipped one always does, but for one that does not look like a source and whose flux is unknown.
        What only the coarse background made look bright, such as the border of a shadow, does not. On
        texture, which need not be as normal as the fit takes it to be, it must exceed 8 σ; on edges, which
        never are, where something is left beside it, and where it does not look like a source, 10 σ.
        """
        least = 10.0 if self.misfit or self.on_edges else 8.0 if self.on_texture else 4.0
        if self.saturated:
            return not (self.misfit and self.flux_noise_e > self.flux_e)
        return self.flux_e > 0.0 and not self.flux_e < least * self.flux_noise_e

    def doubted(self, log_range: float) -> "MeasuredFlare":
        """Return it with at least so much doubt about its range, which all of a frame share."""
        more = math.sqrt(max(log_range**2 - self.log_range_of_model**2, 0.0))
        range_sigma_m = math.hypot(self.range_sigma_m, more * self.range_m)
        common_m = math.hypot(self.range_sigma_common_m, log_range * self.range_m)
        is_bound = math.isnan(range_sigma_m) and self.saturated
        return replace(
            self,
            range_m=self.range_m * (1.0 + log_range) if is_bound else self.range_m,
            flux_sigma_e=math.hypot(self.flux_sigma_e, 2.0 * more * self.flux_e),
            range_sigma_m=range_sigma_m,
            range_sigma_common_m=min(common_m, range_sigma_m),
        )


def measured_flare(
    solution: Solution, index: int, blob: Blob, misfit: bool, prepared: PreparedFrame
) -> MeasuredFlare:
    """Turn one flare of a solution into a measurement, its sigmas wider where the fit is bad."""
    left = solution.left_over
    widening = math.sqrt(max(left.chi2 / max(left.pixels, 1), 1.0)) if misfit else 1.0
    u_px, v_px = float(solution.u_px[index]), float(solution.v_px[index])
    flux_e = float(solution.flux_e[index])
    # What is wrong with the model says nothing of whether a flare stands out.
    flux_sigma_e = math.hypot(
        float(solution.flux_sigma_e[index]) * widening, float(solution.log_flux_of_model[index]) * flux_e
    )
    hidden = hidden_log_range(solution, index)
    doubt = math.hypot(hidden / math.sqrt(3.0), solution.log_range_of_two)
    of_model = float(solution.log_range_of_model[index])
    of_fit = math.hypot(float(solution.log_range_sigma[index]) * widening, of_model)
    of_one = math.hypot(of_fit, hidden / math.sqrt(3.0))
    of_background = float(solution.log_range_hidden[index])
    # The flux is unbiased, so noise alone makes d too large on average, as in `range_from_flux`.
    range_m = math.nan
    if solution.ranged[index]:
        relative = min(float(solution.flux_sigma_e[index]) * widening / flux_e, 1.0)
        range_m = math.exp(float(solution.log_range[index])) / (1.0 + 0.375 * relative**2)
    saturated = bool((blob.pixels & prepared.clipped_in(blob.box)).any())
    told_sigma = of_one  # that it may be two does not make a clipped one a bound
    if may_be_in_fog(prepared.calibration):
        # The range that this fit states is loosely tied to the flux, which tells it in fog.
        told_sigma = math.hypot(0.5 * flux_sigma_e / flux_e, hidden / math.sqrt(3.0))
    on_edge = solution.window.features is not None
    bound_only = saturated and not told_sigma < CLIPPED_RANGE_SIGMA
    return MeasuredFlare(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=math.nan if bound_only else float(solution.u_sigma_px[index]) * widening,
        v_sigma_px=math.nan if bound_only else float(solution.v_sigma_px[index]) * widening,
        flux_e=flux_e,
        flux_sigma_e=flux_sigma_e,
        flux_noise_e=float(solution.flux_noise_e[index]) * widening,
        background_e=solution.background_e,
        range_m=range_m,
        range_sigma_m=math.nan if bound_only else range_m * math.hypot(of_one, solution.log_range_of_two),
        range_sigma_common_m=math.nan if bound_only else range_m * float(solution.log_range_common[index]),
        log_range_of_model=of_model,
        log_range_doubt=math.hypot(of_background * widening, doubt),
        log_range_doubt_common=of_background,
        saturated=saturated,
        misfit=misfit,
        is_doubtful=solution.is_doubtful or hidden > of_one,
        may_be_more=solution.may_be_more,
        on_texture=solution.window.structure_e > 0.0,
        on_edges=solution.window.on_edges or on_edge or left.peak_sigmas > RESIDUAL_SIGMAS,
        lone=solution if solution.count == 1 else None,
    )
