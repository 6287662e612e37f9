"""Counts come out of pictures as they were stored, whatever holds them; what is lossy says what that costs."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perception import RecordingError, encode_png16, read_picture
from perception.files.pictures import lossy_sigma_dn

RNG = np.random.default_rng(3)


def _encoded(kind: str, counts: NDArray[Any], *options: int) -> bytes:
    done, buffer = cv2.imencode(kind, counts, list(options))
    assert done
    return bytes(buffer.tobytes())


def _tiff(
    counts: NDArray[np.uint16], bits: int, changes: dict[int, int] | None = None, more: int = 0
) -> bytes:
    """An uncompressed TIFF by hand, counts packed to so many bits; tags by number, each one number."""
    rows, columns = counts.shape
    written = [f"{int(count):0{bits}b}" for count in counts.ravel()]
    text = "".join(
        row + "0" * (-len(row) % 8)
        for row in ("".join(written[i : i + columns]) for i in range(0, len(written), columns))
    )
    data = bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))
    if bits == 16:
        data = counts.astype("<u2").tobytes()
    tags = {
        256: columns, 257: rows, 258: bits, 259: 1, 262: 1, 273: 0, 277: 1, 278: rows, 279: len(data), 339: 1,
        **(changes or {}),
    }  # fmt: skip
    tags[273] = 14 + 12 * len(tags)
    entries = b"".join(
        struct.pack("<HHII", tag, 4 if tag in (273, 279) else 3, 1, value)
        for tag, value in sorted(tags.items())
    )
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", more) + data


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kind", [".png", ".tiff"])
def test_what_is_written_is_read(tmp_path: Path, kind: str, bits: int) -> None:
    counts = RNG.integers(0, 2**bits, (13, 17)).astype(np.uint8 if bits == 8 else np.uint16)
    (tmp_path / "a").write_bytes(_encoded(kind, counts))
    picture = read_picture(tmp_path / "a")
    assert picture.data_dn.dtype == np.uint16
    assert (picture.bits, picture.lossy_sigma_dn) == (bits, 0.0)
    assert np.array_equal(picture.data_dn, counts)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_packed_tiffs_are_not_scaled(tmp_path: Path, bits: int) -> None:
    counts = RNG.integers(0, 2**bits, (6, 8)).astype(np.uint16)
    counts[0, 0], counts[0, 1] = 1, 2**bits - 1
    (tmp_path / "a.tif").write_bytes(_tiff(counts, bits))
    picture = read_picture(tmp_path / "a.tif")
    assert picture.bits == bits
    assert np.array_equal(picture.data_dn, counts)


def test_a_camera_s_own_tags_are_passed_over_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    counts = RNG.integers(0, 4096, (6, 8)).astype(np.uint16)
    (tmp_path / "a.tif").write_bytes(_tiff(counts, 16, {65000: 5}))
    assert np.array_equal(read_picture(tmp_path / "a.tif").data_dn, counts)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("quality", [30, 75, 90, 95, 100])
def test_a_jpeg_is_off_by_what_its_steps_say(tmp_path: Path, quality: int) -> None:
    """Noise of 40 counts, wide against the steps: the error is that of uniform rounding, to 5 % of its σ."""
    counts = RNG.normal(128.0, 40.0, (256, 256)).clip(0, 255).astype(np.uint8)
    (tmp_path / "a.jpg").write_bytes(_encoded(".jpg", counts, cv2.IMWRITE_JPEG_QUALITY, quality))
    picture = read_picture(tmp_path / "a.jpg")
    off_dn = picture.data_dn.astype(float) - counts
    rms_dn = float(np.sqrt(np.mean(off_dn**2)))
    assert picture.bits == 8
    assert rms_dn < 1.05 * picture.lossy_sigma_dn
    if (
        quality in (90, 95)
    ):  # below, clipping at 0 and 255 and coefficients that vanish make it better than that, at 100 whole counts do
        assert rms_dn > 0.9 * picture.lossy_sigma_dn


@pytest.mark.parametrize("quality", [30, 75, 95])
def test_a_jpeg_of_faint_things_keeps_the_bound(tmp_path: Path, quality: int) -> None:
    """A faint flare on dark noise: coefficients vanish. A coefficient is off by q/2 at most: √3 of the σ."""
    v, u = np.mgrid[-32:32, -32:32]
    counts = RNG.normal(6.0, 1.5, (64, 64)) + 12.0 * np.exp(-0.5 * (u**2 + v**2) / 1.5)
    counts = counts.clip(0, 255).round().astype(np.uint8)
    (tmp_path / "a.jpg").write_bytes(_encoded(".jpg", counts, cv2.IMWRITE_JPEG_QUALITY, quality))
    picture = read_picture(tmp_path / "a.jpg")
    off_dn = picture.data_dn.astype(float) - counts
    assert float(np.sqrt(np.mean(off_dn**2))) < np.sqrt(3.0) * picture.lossy_sigma_dn


def test_steps_of_a_jpeg() -> None:
    """64 steps of 12 DN: σ² = 12 + 1/12."""
    assert lossy_sigma_dn([12] * 64) == pytest.approx(np.sqrt(12.0 + 1.0 / 12.0))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is no PNG, TIFF or JPEG"),
        (b"II*\0", "damaged TIFF"),
        (b"\xff\xd8\xff\xe0\x00", "damaged JPEG"),
        (_tiff(np.ones((4, 4), np.uint16), 16)[:-9], "damaged TIFF"),
        (_tiff(np.ones((4, 4), np.uint16), 16, more=8), "several pictures"),
        (_tiff(np.ones((4, 4), np.uint16), 16, {262: 0}), "from white to black"),
        (_tiff(np.ones((4, 4), np.uint16), 16, {339: 2}), "signed numbers of 16 bits"),
        (_tiff(np.ones((4, 4), np.uint16), 16, {259: 7}), "compressed as JPEG"),
        (_tiff(np.ones((4, 8), np.uint16), 4), "numbers of 4 bits"),
        (_encoded(".tiff", np.ones((4, 4), np.float32)), "floating-point numbers of 32 bits"),
        (_encoded(".png", np.ones((4, 4, 3), np.uint8)), "uint8 with 3 channel"),
        (_encoded(".jpg", np.ones((8, 8, 3), np.uint8)), "uint8 with 3 channel"),
        (_encoded(".png", np.ones((8, 8), np.uint8), cv2.IMWRITE_PNG_BILEVEL, 1), "1-bit counts"),
        (encode_png16(RNG.integers(0, 4096, (40, 40)).astype(np.uint16))[:900], "damaged PNG"),
    ],
)
def test_what_is_no_raw_picture_is_refused(
    tmp_path: Path, content: bytes, said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"a\.png: .*{said}"):
        read_picture(tmp_path / "a.png")
    assert capfd.readouterr().err == ""
