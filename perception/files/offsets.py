"""The fixed offsets of a camera's pixels: a picture beside its calibration, counts above 32768 at gain 1."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import Place
from perception.files.pictures import encode_png16, read_picture

_ZERO_DN = 32768


def encode_offsets(offset_dn: NDArray[np.int16]) -> bytes:
    """Return the PNG of offsets, shape (rows, columns)."""
    return encode_png16((offset_dn.astype(np.int32) + _ZERO_DN).astype(np.uint16))


def read_offsets(path: Path, shape: tuple[int, int]) -> NDArray[np.int16]:
    """Read the offsets of a camera of so many rows and columns.

    Raises
    ------
    RecordingError
        If the picture is missing, damaged, or of another size.
    """
    picture = read_picture(path)
    if picture.data_dn.shape != shape or picture.bits != 16:
        rows, columns = picture.data_dn.shape
        raise Place(str(path)).error(
            f"is {columns} × {rows} pixels of {picture.bits} bits, its camera has {shape[1]} × {shape[0]}",
            "Take the PNG of 16 bits that 'nir-render calibrate' wrote with the calibration, or both anew",
        )
    return (picture.data_dn.astype(np.int32) - _ZERO_DN).astype(np.int16)
