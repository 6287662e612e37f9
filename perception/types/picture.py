"""Frames as pictures for human eyes."""

import numpy as np
from numpy.typing import NDArray


def tone_map(
    data_dn: NDArray[np.uint16] | NDArray[np.float32],
    black_level_dn: float,
    full_scale_dn: float,
    softening: float = 0.01,
) -> NDArray[np.uint8]:
    """Map counts to 8 bits by an asinh curve, so that noise, faint and bright flares all show.

    Parameters
    ----------
    data_dn
        Counts, shape (rows, columns).
    black_level_dn
        The count that becomes black.
    full_scale_dn
        The count that becomes white.
    softening
        Share of the range below which the curve is linear.

    Returns
    -------
    Grey values, uint8, same shape.
    """
    signal = np.clip(
        (data_dn.astype(np.float64) - black_level_dn) / (full_scale_dn - black_level_dn), 0.0, 1.0
    )
    curve = np.arcsinh(signal / softening) / np.arcsinh(1.0 / softening)
    return np.asarray(np.rint(255.0 * curve), dtype=np.uint8)


def frame_png(data_dn: NDArray[np.uint16], black_level_dn: float) -> bytes:
    """Encode counts as an 8-bit PNG, tone-mapped up to their own brightest pixel.

    Parameters
    ----------
    data_dn
        Counts, shape (rows, columns).
    black_level_dn
        The count that becomes black.
    """
    import cv2

    full_scale_dn = max(float(data_dn.max()), black_level_dn + 1.0)
    done, buffer = cv2.imencode(".png", tone_map(data_dn, black_level_dn, full_scale_dn))
    if not done:
        raise RuntimeError("OpenCV could not encode the counts as PNG")
    return buffer.tobytes()
