"""The store of lights, with lights made by hand: same bits, nothing half there, the limit kept."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import DirectTable, Indirect, InputError, Light, LightCache
from nir_render.light.enlarge import Enlargement
from nir_render.light.light import Edges
from nir_render.light.npz import bytes_of
from tests.paths import ROOT

KEY, OTHER, THIRD = "a" * 64, "b" * 64, "c" * 64


def _light(camera: str = "r1.front", fill: float = 0.1, *, indirect: bool = True) -> Light:
    random = np.random.default_rng(1)
    table = DirectTable(
        group=np.array([0, 1]), facet=np.array([-1, 2]), direction=random.normal(size=(2, 3)), distance_m=np.array([2.0 / 3.0, np.inf]),
        angular_radius_rad=np.array([1e-3, 2e-3]), seen=random.random((2, 64)) < 0.5, visible_fraction=np.array([0.5, 1.0]),
        irradiance_per_w=random.random((2, 1)), visibility_rays=64,
    )  # fmt: skip
    how = Enlargement(
        rows=8, columns=8, pixels=np.array([3], dtype=np.int32), first=np.array([0, 1], dtype=np.int32), block=np.array([2], dtype=np.int32),
        weight=np.array([0.5], dtype=np.float32), patch=np.array([7], dtype=np.int32),
    )  # fmt: skip
    arrays = [np.full((2, 1, 4, 4), value, dtype=np.float32) for value in (fill, fill**2)]
    edges = Edges(how, arrays[0][:, :, 0, :1], arrays[1][:, :, 0, :1])
    counts = np.array([[8, 16, 8, 8]] * 4, dtype=np.int32)
    part = Indirect(arrays[0], arrays[1], 2, 8, counts, edges) if indirect else None
    return Light(camera, 0.1 + 0.2, 2**63 + 1, ("r1.top", "sun"), (940e-9,), table, part, ("shapes.mirror",))


def _assert_same_bits(one: object, other: object) -> None:
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray)
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            _assert_same_bits(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


@pytest.mark.parametrize("indirect", [True, False])
def test_a_light_comes_back_from_disk_as_the_same_bits(indirect: bool, tmp_path: Path) -> None:
    light = _light(indirect=indirect)
    LightCache(tmp_path).put(KEY, light)
    another = LightCache(tmp_path)
    found = another.get(KEY)
    assert found is not None
    _assert_same_bits(found, light)
    assert another.get(OTHER) is None
    assert (another.reused, another.missed) == (1, 1)


def test_in_memory_it_is_the_light_itself() -> None:
    cache, light = LightCache(), _light()
    cache.put(KEY, light)
    assert cache.get(KEY) is light


@pytest.mark.parametrize("damage", ["cut short", "a flipped bit", "empty", "another file", "another class"])
def test_a_damaged_file_is_a_miss_and_is_written_anew(damage: str, tmp_path: Path) -> None:
    light = _light()
    LightCache(tmp_path).put(KEY, light)
    (path,) = tmp_path.iterdir()
    data = bytearray(path.read_bytes())
    if damage == "cut short":
        data = data[: len(data) // 2]
    elif damage == "a flipped bit":
        data[data.index(np.float32(0.1).tobytes() * 4) + 5] ^= 1
    elif damage == "empty":
        data = bytearray()
    elif damage == "another file":
        np.savez(path, header=np.zeros(3))
        data = bytearray(path.read_bytes())
    else:
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = arrays.pop("header").tobytes().replace(b'"Light"', b'"Shade"')
        np.savez(path, header=np.frombuffer(header, dtype=np.uint8), **arrays)
        data = bytearray(path.read_bytes())
    path.write_bytes(data)
    cache = LightCache(tmp_path)
    assert cache.get(KEY) is None
    cache.put(KEY, light)
    assert LightCache(tmp_path).get(KEY) is not None


_KILLED = """
import os, signal, sys
import numpy as np
from nir_render.transport import cache
from tests.unit.transport.test_cache import KEY, _light
def half(file, **arrays):
    file.write(b"PK half an archive")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
np.savez = half
cache.LightCache(sys.argv[1]).put(KEY, _light())
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_killed_writer_leaves_no_half_light_and_its_rest_goes(tmp_path: Path) -> None:
    root = ROOT
    done = subprocess.run([sys.executable, "-c", _KILLED, str(tmp_path)], cwd=root, check=False)
    assert done.returncode == -signal.SIGKILL
    (rest,) = tmp_path.iterdir()
    cache = LightCache(tmp_path)
    assert cache.get(KEY) is None
    cache.put(OTHER, _light())
    assert rest.exists()  # it may be another process's, still writing
    os.utime(rest, (time.time() - 7200.0,) * 2)
    cache.put(THIRD, _light())
    assert not rest.exists()
    assert sorted(path.name[:64] for path in tmp_path.iterdir()) == [OTHER, THIRD]


def test_the_folder_keeps_its_limit_and_the_least_recently_used_goes(tmp_path: Path) -> None:
    LightCache(tmp_path).put(KEY, _light())
    (path,) = tmp_path.iterdir()
    size = path.stat().st_size
    cache = LightCache(tmp_path, limit_bytes=2 * size + size // 2, memory_limit_bytes=0)
    cache.put(OTHER, _light("r1.left"))
    for age, name in enumerate((OTHER, KEY)):  # KEY longer ago
        os.utime(tmp_path / f"{name}.light.npz", (1000.0 - age,) * 2)
    assert LightCache(tmp_path).get(KEY) is not None  # now it is OTHER
    cache.put(THIRD, _light("r1.back"))
    assert sorted(path.name[0] for path in tmp_path.iterdir()) == ["a", "c"]
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2.5 * size


def test_a_light_above_the_limit_is_not_written_and_that_is_said_once(tmp_path: Path) -> None:
    light = _light()
    cache = LightCache(tmp_path, limit_bytes=bytes_of(light) - 1)
    with pytest.warns(UserWarning, match=r"larger than the limit of .* GiB and is not kept there"):
        cache.put(KEY, light)
    cache.put(OTHER, light)  # a warning would be an error
    assert list(tmp_path.iterdir()) == []
    assert cache.get(KEY) is light


def test_memory_keeps_its_limit_but_the_last_light_of_each_camera() -> None:
    cache = LightCache(memory_limit_bytes=int(2.5 * bytes_of(_light())))
    for key, camera in (("1", "r1.front"), ("2", "r1.left"), ("3", "r1.front"), ("4", "r1.front")):
        cache.put(key, _light(camera))
    assert [key for key in "1234" if cache.get(key) is not None] == ["2", "4"]


def test_files_of_others_stay(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x" * 1000)
    cache = LightCache(tmp_path, limit_bytes=bytes_of(_light()))
    cache.put(KEY, _light())
    cache.put(OTHER, _light())
    assert (tmp_path / "thesis.tex").exists()


def test_a_full_disk_is_no_reason_to_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    said: list[str] = []
    cache = LightCache(tmp_path, say=said.append)
    cache.put(KEY, _light())
    cache.put(OTHER, _light())
    assert list(tmp_path.iterdir()) == []
    assert cache.get(KEY) is not None
    assert len(said) == 1
    assert "cannot be written (No space left on device)" in said[0]


def test_a_folder_of_another_user_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who does not own a file cannot set its time, and may not be able to write beside it either."""
    light = _light()
    LightCache(tmp_path).put(KEY, light)

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "utime", refused)
    assert LightCache(tmp_path).get(KEY) is not None
    monkeypatch.setattr(tempfile, "TemporaryFile", refused)
    monkeypatch.setattr(np, "savez", refused)
    said: list[str] = []
    cache = LightCache(tmp_path, say=said.append)
    assert len(said) == 1  # when it is opened, before anything is rendered
    assert "cannot be written (Operation not permitted)" in said[0]
    found = cache.get(KEY)
    assert found is not None
    _assert_same_bits(found, light)
    cache.put(OTHER, light)
    assert len(said) == 1


def test_a_folder_that_goes_during_a_run_is_no_reason_to_stop(tmp_path: Path) -> None:
    said: list[str] = []
    cache = LightCache(tmp_path / "lights", say=said.append)
    shutil.rmtree(tmp_path / "lights")
    cache.put(KEY, _light())
    assert cache.get(KEY) is not None
    assert cache.get(OTHER) is None
    assert len(said) == 1


def test_any_flipped_bit_is_a_miss_or_changes_nothing(tmp_path: Path) -> None:
    """Flips in the archive's tables name zip methods, encryption, sizes and offsets that are not there."""
    light = _light()
    LightCache(tmp_path).put(KEY, light)
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    random = np.random.default_rng(0)
    misses = 0
    for place in random.choice(8 * len(data), 1500, replace=False):
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        found = LightCache(tmp_path).get(KEY)
        misses += found is None
        if found is not None:
            _assert_same_bits(found, light)
    assert misses > 500


def test_a_seed_out_of_an_array_is_written_too(tmp_path: Path) -> None:
    out_of_an_array: Any = {"seed": np.int64(3), "time_s": np.float32(0.5)}
    light = dataclasses.replace(_light(), **out_of_an_array)
    LightCache(tmp_path).put(KEY, light)
    found = LightCache(tmp_path).get(KEY)
    assert found is not None
    assert (found.seed, found.time_s) == (3, 0.5)


def test_a_folder_that_cannot_be_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be a light cache"):
        LightCache(tmp_path / "file")
    with pytest.raises(InputError, match="wanted bytes, 0 or more"):
        LightCache(tmp_path, limit_bytes=-1)
