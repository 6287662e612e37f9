import numpy as np
import pytest
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.robust.search.blobs import Blob, components, split_at_peaks
from perception.robust.search.hills import prominent, summit


def hill(*tops: tuple[float, float, float], width: int = 30) -> NDArray[np.float32]:
    rows, columns = np.indices((20, width))
    tops_apart = [h * np.exp(-0.5 * ((rows - v) ** 2 + (columns - u) ** 2)) for u, v, h in tops]
    return np.asarray(np.sum(tops_apart, axis=0), dtype=np.float32)


def whole(image: NDArray[np.float32]) -> Blob:
    return Blob(PixelBox(100, 200, *image.shape), np.asarray(image > 1.0), image)


def test_components_touch_at_corners_and_obey_the_area() -> None:
    mask = np.zeros((10, 12), dtype=bool)
    mask[2, 3] = mask[3, 4] = mask[4, 5] = True
    mask[8, 9:11] = True
    first, second = components(mask)
    assert first.box == PixelBox(2, 3, 3, 3)
    assert first.area_px == 3
    assert second.box == PixelBox(8, 9, 1, 2)
    assert [blob.area_px for blob in components(mask, 3)] == [3]
    assert components(np.zeros((4, 4), dtype=bool)) == []


def test_rows_of_a_frame_two_pixels_wide_do_not_touch_across_its_edges() -> None:
    mask = np.array([[False, True], [False, False], [True, False], [True, True]])
    assert [blob.box for blob in components(mask)] == [PixelBox(0, 1, 1, 1), PixelBox(2, 0, 2, 2)]


def test_the_peak_is_one_of_the_blob() -> None:
    """In a dark trough what stands out may still lie below the background."""
    image = np.array([[-40.0, 0.0], [0.0, -50.0]], dtype=np.float32)
    assert Blob(PixelBox(0, 0, 2, 2), image < 0.0, image).peak_e == -40.0


def test_two_hills_are_parted() -> None:
    image = hill((8.0, 10.0, 1000.0), (13.0, 10.0, 400.0))
    one, two = split_at_peaks(whole(image), np.sqrt(image + 1))
    assert one.box.left <= 208 < one.box.left + one.box.width
    assert two.box.left <= 213 < two.box.left + two.box.width
    assert one.area_px + two.area_px == whole(image).area_px


def test_a_dip_within_the_noise_parts_nothing() -> None:
    image = hill((8.0, 10.0, 1000.0), (13.0, 10.0, 400.0))
    assert len(split_at_peaks(whole(image), np.full(image.shape, 100.0, np.float32))) == 1


def test_a_plateau_with_ripples_is_one() -> None:
    rows, columns = np.indices((20, 30))
    image = np.float32(1000.0) * ((rows - 10) ** 2 + (columns - 15) ** 2 < 50) + 10 * (
        (rows + columns) % 3
    ).astype(np.float32)
    blob = Blob(PixelBox(0, 0, 20, 30), np.asarray(image > 500.0), image)
    assert split_at_peaks(blob, np.sqrt(image + 1)) == [blob]


def test_a_flare_is_cut_off_the_hill_that_it_stands_on() -> None:
    """A glow of 20 along a whole strip, dim at its end, and a flare of 100 in it; both alone stay whole."""
    across = 20.0 * np.exp(-0.5 * ((np.arange(20.0) - 10.0) / 4.0) ** 2)
    strip = np.asarray(across[:, None] * np.linspace(1.2, 0.8, 60), dtype=np.float32)
    image = strip + hill((40.0, 10.0, 100.0), width=60)
    clips = np.zeros((20, 60), dtype=bool)
    cut = summit(whole(image), clips, 5)
    assert (cut.box.height, cut.box.width) == (5, 6)
    assert cut.pixels[10 - (cut.box.top - 100), 40 - (cut.box.left - 200)]
    # It exceeds all that lies 5 to 9 px beside its half maximum, the brightest of it on the ridge to the left.
    level_e = float(image[10, 33])
    assert cut.area_px == np.count_nonzero(image[5:16, 34:47] > level_e)
    for one in (strip, hill((40.0, 10.0, 100.0), width=60), strip + hill((5.0, 10.0, 4.0), width=60)):
        blob = whole(one)
        assert summit(blob, clips, 5) is blob
    clips[10, 40] = True
    blob = whole(image)
    assert summit(blob, clips, 5) is blob
    clips[10, 40], clips[10, 10] = False, True  # elsewhere on the hill
    assert summit(blob, clips, 5) is not blob


@pytest.mark.parametrize("level", [0.0, -1.0])
def test_what_is_darker_than_the_background_is_no_hill(level: float) -> None:
    image = np.full((20, 30), level, dtype=np.float32)
    blob = Blob(PixelBox(0, 0, 20, 30), np.ones((20, 30), dtype=bool), image)
    assert summit(blob, np.zeros((20, 30), dtype=bool), 5) is blob


def test_flares_are_cut_off_a_rim_brighter_than_half_of_them() -> None:
    """A ridge of 90, and on it flares of 60 and 50; `summit` leaves it whole.

    Expected: each flare once, at its place, no pixel twice; nothing on the ridge alone, on a rectangle (whose
    corners have bright neighbours), on a disc as wide as the reach, or where noise may make a maximum.
    """
    rows, columns = np.indices((60, 200), dtype=np.float64)
    ridge = 90.0 * np.exp(-0.5 * ((rows - 30.0 - 0.2 * (columns - 100.0)) / 3.0) ** 2)
    flares = [(60, 22, 60.0), (140, 38, 50.0)]
    image = ridge + sum(h * np.exp(-0.25 * ((rows - v) ** 2 + (columns - u) ** 2)) for u, v, h in flares)
    noise, shape = np.full(image.shape, 2.0, np.float32), (960, 1280)
    blob = whole(image.astype(np.float32))
    assert summit(blob, np.zeros(image.shape, dtype=bool), 4) is blob
    cut = prominent(blob, blob, noise, 4, shape)
    peaks = [divmod(int(np.argmax(one.filtered_e)), one.box.width) for one in cut]
    at = [
        (one.box.left - 200 + column, one.box.top - 100 + row)
        for one, (row, column) in zip(cut, peaks, strict=True)
    ]
    assert at == [(u, v) for u, v, _ in flares]
    assert all(one.area_px < 40 for one in cut)
    assert len({place for one in cut for place in one.places(1280).tolist()}) == sum(b.area_px for b in cut)
    rectangle = np.where((abs(rows - 30) < 12) & (abs(columns - 100) < 30), 100.0, 0.0)
    disc = np.where(np.hypot(rows - 30, columns - 100) < 5.5, 100.0, 0.0)
    for nothing in (ridge, rectangle, disc):
        alone = whole(np.asarray(nothing, dtype=np.float32))
        assert prominent(alone, alone, noise, 4, shape) == []
    assert prominent(blob, blob, 10.0 * noise, 4, shape) == []


def test_what_stands_near_the_frame_s_edge_is_left_on_its_rim() -> None:
    """Beyond the edge of the frame a rim ends as a flare does."""
    rows, columns = np.indices((60, 200), dtype=np.float64)
    image = 90.0 * np.exp(-0.5 * ((rows - 30.0) / 3.0) ** 2)
    image += 60.0 * np.exp(-0.25 * ((rows - 30.0) ** 2 + (columns - 3.0) ** 2))
    blob = Blob(PixelBox(100, 0, 60, 200), image > 1.0, image.astype(np.float32))
    noise = np.full(image.shape, 2.0, np.float32)
    assert prominent(blob, blob, noise, 4, (960, 1280)) == []
    inner = Blob(PixelBox(100, 5, 60, 200), blob.pixels, blob.filtered_e)
    assert len(prominent(inner, inner, noise, 4, (960, 1280))) == 1
