"""Pictures of frames: raw counts out of grey PNG, TIFF and JPEG files, and into 16-bit PNG.

Counts come out as they were stored, without scaling or gamma. JPEG is lossy: what that costs follows from the
steps that the file itself names.
"""

import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import Place

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_JPEG = b"\xff\xd8\xff"
_MEND = "Record raw counts as 8- or 16-bit grey PNG or TIFF"
_STEPS = 64  # of a block of a JPEG, 8 × 8 pixels


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture of one frame.

    Attributes
    ----------
    data_dn
        Counts, uint16, shape (rows, columns).
    bits
        Of a count, as the file stores it.
    lossy_sigma_dn
        Standard deviation of what lossy compression changed in a pixel; 0 without.
    """

    data_dn: NDArray[np.uint16]
    bits: int
    lossy_sigma_dn: float = 0.0


def read_picture(path: Path) -> Picture:
    """Read a grey picture: PNG of 8 or 16 bits, TIFF of 8 to 16, JPEG of 8.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or holds something else than one grey picture of whole counts.
    """
    place = Place(str(path))
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise place.error(
            f"the picture cannot be read ({reason})", "Put the PNG there, or remove it from frames.jsonl"
        ) from error
    if content.startswith(_PNG):
        return _read_png(content, place)
    if content[:4] in _TIFF:
        return _read_tiff(content, place)
    if content.startswith(_JPEG):
        return _read_jpeg(content, place)
    raise place.error("is no PNG, TIFF or JPEG", _MEND)


def lossy_sigma_dn(steps: Sequence[int]) -> float:
    """Return the standard deviation of what quantising the coefficients of a JPEG changes in a pixel.

    The transform of a block is orthonormal, so the mean square error of its pixels is that of its
    coefficients: q²/12 for one that is rounded to a multiple of q, and never more than q²/4. Rounding the
    pixels to whole counts adds 1/12.

    Parameters
    ----------
    steps
        The quantisation table, 64 steps q.

    Examples
    --------
    >>> round(lossy_sigma_dn([1] * 64), 3)
    0.408
    """
    return math.sqrt(sum(step * step for step in steps) / (12.0 * _STEPS) + 1.0 / 12.0)


def encode_png16(data_dn: NDArray[np.uint16]) -> bytes:
    """Encode counts as a 16-bit grey PNG, as they are: no scaling, no gamma.

    Raises
    ------
    ValueError
        If the counts are not uint16 of shape (rows, columns).
    """
    import cv2

    if data_dn.dtype != np.uint16 or data_dn.ndim != 2 or data_dn.size == 0:
        raise ValueError(
            f"raw counts are uint16 of shape (rows, columns), not {data_dn.dtype} of shape {data_dn.shape}"
        )
    done, buffer = cv2.imencode(".png", data_dn)
    if not done:
        raise RuntimeError("OpenCV could not encode the frame as PNG")
    return buffer.tobytes()


def _read_png(content: bytes, place: Place) -> Picture:
    bits = content[24] if len(content) > 24 else 0
    image = _decoded(content, "PNG", place)
    _check_grey(image, place)
    if bits < 8:
        raise place.error(f"holds {bits}-bit counts", _MEND)
    return Picture(image.astype(np.uint16), 8 * image.dtype.itemsize)


def _read_tiff(content: bytes, place: Place) -> Picture:
    try:
        tags, more = _tiff_tags(content)
    except (struct.error, IndexError) as error:
        raise place.error("is a damaged TIFF", _MEND) from error
    bits, signed_or_float = tags.get(258, 1), tags.get(339, 1) != 1
    if more:
        raise place.error("holds several pictures", "Write one TIFF for each frame")
    if tags.get(259, 1) in (6, 7):
        raise place.error(
            "is a TIFF compressed as JPEG", "Write it without loss: uncompressed, LZW or deflate"
        )
    if tags.get(262, 1) == 0:
        raise place.error("counts from white to black (MinIsWhite)", "Write it as MinIsBlack")
    if not 8 <= bits <= 16 or signed_or_float:
        kind = {2: "signed ", 3: "floating-point "}.get(tags.get(339, 1), "")
        raise place.error(f"holds {kind}numbers of {bits} bits", _MEND)
    image = _decoded(content, "TIFF", place)
    _check_grey(image, place)
    # OpenCV shifts packed counts of 10, 12 or 14 bits up to 16.
    shift = 16 - bits if image.dtype == np.uint16 else 0
    return Picture(np.asarray(image.astype(np.uint16) >> shift, dtype=np.uint16), bits)


def _tiff_tags(content: bytes) -> tuple[dict[int, int], bool]:
    """Return the first value of each tag of the first directory, and whether there is another one."""
    order = _TIFF[content[:4]]
    (start,) = struct.unpack_from(order + "I", content, 4)
    (count,) = struct.unpack_from(order + "H", content, start)
    tags = {}
    for place in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, values = struct.unpack_from(order + "HHI", content, place)
        where = place + 8
        size = {3: 2, 4: 4}.get(kind)
        if size is None:
            continue
        if size * values > 4:
            (where,) = struct.unpack_from(order + "I", content, where)
        tags[tag] = struct.unpack_from(order + {2: "H", 4: "I"}[size], content, where)[0]
    (following,) = struct.unpack_from(order + "I", content, start + 2 + 12 * count)
    return tags, following != 0


def _read_jpeg(content: bytes, place: Place) -> Picture:
    try:
        steps = _jpeg_steps(content)
    except (struct.error, IndexError, KeyError) as error:
        raise place.error("is a damaged JPEG", _MEND) from error
    image = _decoded(content, "JPEG", place)
    _check_grey(image, place)
    return Picture(image.astype(np.uint16), 8, lossy_sigma_dn(steps))


def _jpeg_steps(content: bytes) -> list[int]:
    """Return the quantisation table of the first component, which is all that a grey JPEG has."""
    tables: dict[int, list[int]] = {}
    used = None
    at = 2
    while at < len(content):
        marker, length = struct.unpack_from(">HH", content, at)
        body = content[at + 4 : at + 2 + length]
        if marker == 0xFFDB:
            while body:
                wide, name = body[0] >> 4, body[0] & 15
                size = _STEPS * (1 + wide)
                tables[name] = list(struct.unpack_from(f">{_STEPS}{'H' if wide else 'B'}", body, 1))
                body = body[1 + size :]
        elif 0xFFC0 <= marker <= 0xFFCF and marker not in (0xFFC4, 0xFFC8, 0xFFCC):
            used = body[8]  # behind precision, rows, columns, components; name and sampling of the first
        elif marker == 0xFFDA:
            break
        at += 2 + length
    return tables[used]  # type: ignore[index]


def _decoded(content: bytes, kind: str, place: Place) -> NDArray[np.generic]:
    import cv2

    with _quiet():
        try:
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:  # more pixels than it takes
            image = None
    if image is None:
        raise place.error(f"is a damaged {kind}, or too large", _MEND)
    return np.asarray(image)


def _check_grey(image: NDArray[np.generic], place: Place) -> None:
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise place.error(f"holds {image.dtype} with {channels} channel(s), not raw grey counts", _MEND)


@contextmanager
def _quiet() -> Iterator[None]:
    """Let OpenCV say nothing: it writes to standard error of every unknown tag and all that is damaged."""
    from cv2.utils import logging

    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)
