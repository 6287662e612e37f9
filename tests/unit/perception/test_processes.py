"""Frames side by side in processes: what they find is what one finds by itself, and nothing hangs or is left."""

from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.shared_memory import SharedMemory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import perception
from perception import Calibration, DetectorProcesses, Pipeline, RawFrame
from perception.processes import line, memory
from perception.processes.memory import Memory, taken
from tests.unit.perception.simulation import calibration, expected_e, expose, random

NAMES = ("r1.front", "r1.back", "r1.left")
CAMERAS: dict[str, Calibration] = {name: replace(calibration(), camera=name) for name in NAMES}
PLACES = [(200.3, 150.6, 2.0), (420.8, 310.2, 4.0), (900.4, 505.7, 3.0)]


def _frames(number: int) -> list[RawFrame]:
    """Return a set of three frames; one sees nothing."""
    frames = []
    for index, (name, known) in enumerate(CAMERAS.items()):
        mean_e = expected_e(known, PLACES[: 2 * index], 3e-4, 3.0)
        frame = expose(mean_e, known, random(51, number, index), 3e-4)
        frames.append(replace(frame, camera=name, time_s=number / 30.0, index=number))
    return frames


def _told(found: list[perception.Detections]) -> list[object]:
    return [(one.reason, one.truncated, [repr(flare) for flare in one]) for one in found]


def test_processes_find_what_one_finds_and_leave_nothing() -> None:
    sets = [_frames(number) for number in range(3)]
    with DetectorProcesses(CAMERAS, count=2) as detectors:
        found = [detectors.detect_frames(frames) for frames in sets]
        pieces = list(detectors._memory._all)
        assert detectors.detect_frames([]) == []
        pipeline, alone = Pipeline(CAMERAS, detector=detectors.detect_frames), Pipeline(CAMERAS)
        for frames in sets:
            one, other = (each.push(frames) for each in (pipeline, alone))
            assert repr(one.measurements.measurements) == repr(other.measurements.measurements)
    for frames, several in zip(sets, found, strict=True):
        assert [len(one) for one in several] == [0, 2, 3]
        assert _told(several) == _told(perception.detect_frames(frames, CAMERAS))
    assert len(pieces) == 3  # of a set of three frames all are in memory at once
    for name in pieces:
        with pytest.raises(FileNotFoundError):
            SharedMemory(name)
    with pytest.raises(RuntimeError, match="were ended"):
        detectors.detect_frames(sets[0])


def test_sets_are_read_ahead() -> None:
    """The same is told of each, whatever is done with it meanwhile, and who stops early leaves nothing behind."""
    sets = [_frames(0), [], *(_frames(number) for number in range(1, 4))]
    handed_over: list[int] = []

    def counted() -> Iterator[list[RawFrame]]:
        for number, frames in enumerate(sets):
            handed_over.append(number)
            yield frames

    with DetectorProcesses(CAMERAS, count=2) as detectors:
        alone = [detectors.detect_frames(frames) for frames in sets]
        for number, (frames, found) in enumerate(detectors.detect_sets(counted())):
            assert all(one is other for one, other in zip(frames, sets[number], strict=True))
            assert _told(found) == _told(alone[number])
            assert handed_over == list(range(min(number + 2, len(sets))))
            assert len(detectors._memory._all) <= 6  # of two sets
        assert list(detectors.detect_sets([])) == []
        reading = detectors.detect_sets(sets)
        next(reading)
        with pytest.raises(RuntimeError, match="at work with the next"):
            detectors.detect_frames(sets[0])
        reading.close()
        assert _told(detectors.detect_frames(sets[0])) == _told(alone[0])
        reading = detectors.detect_sets([sets[0], [replace(sets[0][0], camera="r9.up")]])
        assert _told(next(reading)[1]) == _told(alone[0])
        with pytest.raises(ValueError, match=r"no calibration for r9\.up"):
            next(reading)
        # A camera that writes into the same memory again changes nothing of what was handed over.
        buffers = [frame.data_dn.copy() for frame in sets[0]]

        def rewritten() -> Iterator[list[RawFrame]]:
            for frames in (sets[2], sets[3]):
                for buffer, frame in zip(buffers, frames, strict=True):
                    np.copyto(buffer, frame.data_dn)
                yield [replace(frame, data_dn=own) for frame, own in zip(frames, buffers, strict=True)]

        for number, (_, found) in enumerate(detectors.detect_sets(rewritten())):
            assert _told(found) == _told(alone[2 + number])
        # Nor does a list that is filled anew with each set.
        same: list[RawFrame] = []

        def refilled() -> Iterator[list[RawFrame]]:
            for frames in (sets[2], sets[3][:1]):
                same[:] = frames
                yield same

        for number, (frames, found) in enumerate(detectors.detect_sets(refilled())):
            assert [frame.index for frame in frames] == [number + 1] * len(found)
            assert _told(found) == _told(alone[2 + number])[: len(found)]
        wrong = [replace(sets[0][0], data_dn=sets[0][0].data_dn[:5])]
        reading = detectors.detect_sets([sets[0], wrong, sets[0]])
        assert _told(next(reading)[1]) == _told(alone[0])
        with pytest.raises(ValueError):
            next(reading)
        assert _told(detectors.detect_frames(sets[0])) == _told(alone[0])
        reading = detectors.detect_sets(sets)
        next(reading)
        detectors.close()
        with pytest.raises(RuntimeError, match="were ended"):
            next(reading)


def test_sets_before_a_fault_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the sets themselves end by a fault, or memory has no room; then others are read."""

    def broken() -> Iterator[list[RawFrame]]:
        yield _frames(0)
        yield _frames(1)
        raise OSError("the recording ends here")

    with DetectorProcesses(CAMERAS, "paper", count=2) as detectors:
        reading = detectors.detect_sets(broken())
        assert [frames[0].index for frames, _ in (next(reading), next(reading))] == [0, 1]
        with pytest.raises(OSError, match="ends here"):
            next(reading)
        larger = [replace(_frames(2)[0], data_dn=np.zeros((3000, 3000), dtype=np.uint16))]
        with monkeypatch.context() as patched:
            patched.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=17_999_999))
            reading = detectors.detect_sets([_frames(0), larger])
            next(reading)
            if memory.SHARED.is_dir():
                with pytest.raises(OSError, match=r"room for 17999999 bytes, a frame needs 18000000"):
                    next(reading)
        assert len(detectors.detect_frames(_frames(1))) == 3


def test_a_frame_whose_memory_is_gone_is_told_as_that() -> None:
    with DetectorProcesses(CAMERAS, "paper", count=1) as detectors:
        place = detectors._memory.place

        def gone(frame: RawFrame) -> memory.Handed | None:
            handed = place(frame)
            assert handed is not None
            return handed[0], replace(handed[1], memory="perception_gone")

        detectors._line._memory.place = gone  # type: ignore[method-assign]
        with pytest.raises(RuntimeError, match="FileNotFoundError"):
            detectors.detect_frames(_frames(0)[:1])
        assert detectors._workers[0].process.is_alive()


def test_what_is_wrong_with_a_frame_is_told_and_the_next_is_read() -> None:
    frames = _frames(0)
    with DetectorProcesses(CAMERAS, count=1) as detectors:
        with pytest.raises(ValueError, match=r"no calibration for r9\.up"):
            detectors.detect_frames([replace(frames[0], camera="r9.up")])
        of_wrong: tuple[Any, ...] = (
            frames[0].data_dn[:5],
            np.empty((0, 0), np.uint16),
            frames[0].data_dn.astype(object),
            np.ones((2, 2)),
        )
        for wrong in of_wrong:
            broken = replace(frames[1], data_dn=wrong)
            with pytest.raises(ValueError) as here:
                perception.detect(broken, CAMERAS[broken.camera])
            with pytest.raises(ValueError) as there:
                detectors.detect_frames([frames[0], broken])
            assert str(there.value) == str(here.value)
        turned = replace(frames[2], data_dn=np.asfortranarray(frames[2].data_dn))
        assert len(detectors.detect_frames([turned])[0]) == 3
    with pytest.raises(ValueError, match="is not known here"):
        DetectorProcesses(CAMERAS, "robbust")
    with pytest.raises(ValueError, match="give 1 or more"):
        DetectorProcesses(CAMERAS, count=0)


def test_an_answer_that_nobody_waited_for_is_no_other_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while frames are away: all is ended, so that no later call takes their flares for its own."""
    with DetectorProcesses(CAMERAS, "paper", count=2) as detectors:

        def interrupted(_: object, timeout: float | None) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(line, "connection", SimpleNamespace(wait=interrupted))
        with pytest.raises(KeyboardInterrupt):
            detectors.detect_frames(_frames(0))
        monkeypatch.undo()
        with pytest.raises(RuntimeError, match="were ended"):
            detectors.detect_frames(_frames(0))


def test_a_process_that_is_killed_ends_all_and_says_so() -> None:
    with DetectorProcesses(CAMERAS, "paper", count=2) as detectors:
        process = detectors._workers[1].process
        process.kill()
        process.join()
        with pytest.raises(RuntimeError, match=r"\(status .+\) has ended, and the others with it"):
            detectors.detect_frames(_frames(0))
        with pytest.raises(RuntimeError, match="were ended"):
            detectors.detect_frames(_frames(0))


def test_larger_frames_take_the_place_of_smaller_ones() -> None:
    """Memory that is too small is given back, and many frames need no more of it than few."""
    with DetectorProcesses(CAMERAS, "paper", count=1) as detectors:
        small = [replace(frame, data_dn=frame.data_dn[:5]) for frame in _frames(0)]
        with pytest.raises(ValueError):
            detectors.detect_frames(small)
        before = list(detectors._memory._all)
        assert before
        found = detectors.detect_frames(_frames(1) * 4)
        assert _told(found[:3]) == _told(found[9:])
        pieces = detectors._memory._all.values()
        assert len(pieces) <= 3
        assert all(piece.size >= _frames(1)[0].data_dn.nbytes for piece in pieces)
        for name in before:
            with pytest.raises(FileNotFoundError):
                SharedMemory(name)


def test_a_process_forgets_memory_that_is_gone() -> None:
    frame, held = _frames(1)[1], dict[str, SharedMemory]()
    shared = Memory()
    try:
        small = replace(frame, data_dn=frame.data_dn[:9].copy())
        for each in (small, small, frame):
            handed = shared.place(each)
            assert handed is not None
            assert np.array_equal(taken(handed, held).data_dn, each.data_dn)
            shared.reuse(handed)
        assert held.keys() == shared._all.keys()
        assert len(held) == 1
    finally:
        for one in held.values():
            one.close()
        shared.close()
