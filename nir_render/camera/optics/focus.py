"""Focus: the disc into which a thin lens blurs a point that it is not focused on."""

import math

from nir_render.scene.documents.camera import Camera

FOCUSED_AT_K = 298.15
"""The temperature at which the image plane lies on the sensor: 25 °C."""


def blur_circle_px(camera: Camera, distance_m: float, temperature_k: float = FOCUSED_AT_K) -> float:
    """Return the diameter of the defocus disc, in pixels, of what is at a distance along the axis.

    A point at distance d is imaged at v = f d / (d − f) behind a thin lens, and the sensor stands at
    s = f d_f / (d_f − f) − Δ, Δ by how much heat moves the image. The cone from a pupil of f/N cuts it in

        c = (f/N) · |v − s| / v,   at Δ = 0   c = (f/N) · f |d − d_f| / (d (d_f − f)).

    A lens without `focus_distance` is in focus everywhere.

    Parameters
    ----------
    distance_m
        Above the focal length; infinite for the sun.
    temperature_k
        Of lens and sensor.
    """
    lens = camera.lens
    if lens.focus_distance_m is None:
        return 0.0
    focal_m = lens.focal_length_m
    image_m = focal_m / (1.0 - focal_m / distance_m)
    sensor_m = focal_m / (1.0 - focal_m / lens.focus_distance_m)
    moved_m = lens.thermal_focus_shift_m_per_k * (temperature_k - FOCUSED_AT_K)
    circle_m = focal_m / lens.f_number * abs(image_m + moved_m - sensor_m) / image_m
    return math.fabs(circle_m) / camera.sensor.pixel_pitch_m
