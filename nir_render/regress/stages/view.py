"""Where the pixels of an indirect image look, against the calibration of the reference.

Noise hides a shift of an image that has few edges; the rays that it is rendered by have none. They are looked
for in the image by perception's own lens, in the place and pose that the reference's calibration tells.
"""

import numpy as np

from nir_render.regress.findings import Finding
from nir_render.scene.scene import Scene
from perception import Calibration
from perception.model.lens import project, unproject

_SHIFT_PX = 1e-4  # a pose has passed through a quaternion on disk, and lenses are inverted by steps
_PLACE_M = 1e-9


def compare_view(scene: Scene, time_s: float, calibration: Calibration, label: str) -> Finding:
    """Compare the rays at the corners of a camera's pixels with where its calibration sees these corners."""
    from nir_render.transport.indirect.groups import rays_of

    what = f"{label}where pixels look"
    snapshot = scene.at(time_s)
    placed = snapshot.camera(calibration.camera)
    body = snapshot.robots[calibration.camera.split(".")[0]].pose
    rays = rays_of(placed.camera, placed.pose)
    rows, columns = (count - 1 for count in rays.corners.shape[:2])
    if (rows, columns) != (calibration.height_px, calibration.width_px):
        return Finding("transport", what, "fail", "the sensor has another size")
    place_m = (rays.origin_m - body.position_m) @ body.rotation
    off_m = float(np.abs(place_m - calibration.position_body_m).max())
    v_px, u_px = np.mgrid[0 : rows + 1, 0 : columns + 1] - 0.5
    wanted_px = np.stack([u_px.ravel(), v_px.ravel()], axis=1)
    directions = rays.corners.reshape(-1, 3) @ body.rotation @ calibration.rotation_body_camera
    # Corners beyond the image circle of a fisheye have rays of their own.
    within = np.isfinite(unproject(wanted_px, calibration)).all(axis=1)
    shift_px = project(directions[within], calibration) - wanted_px[within]
    finite = np.isfinite(shift_px).all()
    largest_px = float(np.hypot(*shift_px.T).max()) if finite else np.inf
    seen = "equal but for rounding"
    if off_m > _PLACE_M:
        seen = f"the lens is off by {1e3 * off_m:.3g} mm"
    elif largest_px > _SHIFT_PX:
        seen = f"off by {largest_px:.3g} px at most" if finite else "some look where nothing is seen"
    fails = off_m > _PLACE_M or largest_px > _SHIFT_PX
    return Finding("transport", what, "fail" if fails else "pass", seen, f"{_SHIFT_PX:.0e} px")
