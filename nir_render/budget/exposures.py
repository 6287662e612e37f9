"""What a camera exposes with: its own exposure, each of a bracket, or what it would choose by itself."""

from dataclasses import dataclass

from nir_render.camera.sensor.read_out import saturation_dn
from nir_render.camera.timing.exposure_control import Setting, own_setting, setting_for
from nir_render.scene.documents.camera import Camera


@dataclass(frozen=True)
class Exposure:
    """One way in which a camera exposes; `fixed` is None where it chooses by the brightest pixel."""

    name: str
    fixed: Setting | None

    def setting(self, camera: Camera, brightest_e_per_s: float) -> Setting:
        """Return exposure and gain where the brightest pixel collects so many electrons per second."""
        if self.fixed is not None:
            return self.fixed
        assert camera.auto_exposure is not None
        return setting_for(camera, camera.auto_exposure, brightest_e_per_s)

    def shortest(self, camera: Camera) -> Setting:
        """Return the setting that clips last."""
        if self.fixed is not None:
            return self.fixed
        assert camera.auto_exposure is not None
        return Setting(camera.auto_exposure.shortest_s, camera.gain)


def exposures_of(camera: Camera) -> tuple[Exposure, ...]:
    """Return the ways in which a camera exposes: one, or those of its bracket."""
    if camera.auto_exposure is not None:
        return (Exposure("automatic", None),)
    settings = [own_setting(camera, index) for index in range(len(camera.bracket or (1.0,)))]
    by_name = {f"{1e3 * setting.exposure_s:.4g} ms": setting for setting in settings}
    return tuple(Exposure(name, setting) for name, setting in by_name.items())


def clip_e(camera: Camera, gain: float) -> float:
    """Return the electrons, as read, from which on a pixel counts as clipped."""
    sensor = camera.sensor
    return (saturation_dn(sensor, gain) - sensor.black_level_dn) / (sensor.system_gain_dn_per_e * gain)


def read_e(camera: Camera, charge_e: float) -> float:
    """Return the electrons that are read of a pixel's charge: what its well holds, along its bend if any."""
    return camera.sensor.read_e(min(charge_e, camera.sensor.well_e))
