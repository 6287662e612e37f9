"""Grey pictures as numbers: PNG of 8 or 16 bit without colours; what is damaged is refused.

OpenCV fills what a cut file lacks with grey and says nothing, so each piece's checksum is looked at first.
"""

import struct
import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MOST_BYTES = 256 * 2**20
_MOST_PIXELS = 2**26
_KINDS = {2: "RGB colours", 3: "a palette of colours", 4: "transparency", 6: "RGB colours and transparency"}
_REMEDY = "export it again, as grey PNG of 8 or 16 bit"


def read_grey(file: str | Path) -> NDArray[np.float64]:
    """Return a picture's values from 0, black, to 1, white, as they are stored: shape (rows, columns).

    Raises
    ------
    ValueError
        It is no such file, is damaged, too large, or has colours; it says what is wrong.
    """
    path = Path(file)
    try:
        state = path.stat()
        if state.st_size > _MOST_BYTES:
            most = _MOST_BYTES >> 20
            raise ValueError(
                f"{path}: has {state.st_size >> 20} MiB, at most {most} are read; make it smaller"
            )
        return _read(str(path), state.st_mtime_ns, state.st_size)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}; check it") from None


@lru_cache(maxsize=16)
def _read(file: str, _changed_ns: int, _size: int) -> NDArray[np.float64]:
    data = Path(file).read_bytes()
    try:
        bits = _checked(data)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    import cv2

    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 2:
        raise ValueError(f"{file}: cannot be read as a grey picture; {_REMEDY}")
    grey: NDArray[np.float64] = values.astype(np.float64) / (2**bits - 1)
    grey.setflags(write=False)
    return grey


def _checked(data: bytes) -> int:
    """Return the bits of a value; raise ValueError where this is no whole grey PNG."""
    if not data.startswith(_SIGNATURE):
        raise ValueError(f"this is no PNG file; {_REMEDY}")
    at, kinds, bits, packed = len(_SIGNATURE), [], 0, b""
    width = height = 0
    while at < len(data):
        if len(data) - at < 12:
            raise ValueError(f"ends in the middle; {_REMEDY}")
        (length,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        end = at + 12 + length
        if end > len(data):
            raise ValueError(f"ends in the middle; {_REMEDY}")
        if struct.unpack_from(">I", data, end - 4)[0] != zlib.crc32(kind + body):
            raise ValueError(
                f"its piece {kind!r} at byte {at} is damaged: the checksum is another; {_REMEDY}"
            )
        if kind == b"IHDR" and length == 13:
            width, height, bits, colours = struct.unpack_from(">IIBB", body)
            if colours != 0:
                raise ValueError(
                    f"holds {_KINDS.get(colours, 'unknown colours')}, which mean nothing at 940 nm; "
                    "wanted a grey PNG of reflectance in the band"
                )
            if bits not in (8, 16):
                raise ValueError(f"has {bits} bit a pixel; wanted a grey PNG of 8 or 16 bit")
            if not 0 < width * height <= _MOST_PIXELS:
                raise ValueError(
                    f"has {width} × {height} pixels; wanted at least one and at most {_MOST_PIXELS}"
                )
        packed += body if kind == b"IDAT" else b""
        kinds.append(kind)
        at = end
    if not kinds or kinds[0] != b"IHDR" or kinds[-1] != b"IEND" or b"tRNS" in kinds or not width:
        raise ValueError(f"its pieces are not those of a grey PNG; {_REMEDY}")
    unpacked = zlib.decompressobj()
    wanted = height * (1 + width * bits // 8)  # with a byte at each row's beginning
    try:
        most = unpacked.decompress(packed, 2 * wanted + 1024)
    except zlib.error:
        raise ValueError(f"its pixels cannot be unpacked; {_REMEDY}") from None
    if len(most) < wanted:
        raise ValueError(f"holds {len(most)} of the {wanted} bytes of its pixels; {_REMEDY}")
    return bits
