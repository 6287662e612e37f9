"""Workers that begin anew after so many jobs: nothing lost, nothing done twice, the same whoever does it."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from nir_render.stress.campaign import load_campaign
from nir_render.stress.jobs import plan
from nir_render.stress.workers.pool import Work, part_file, run_jobs
from nir_render.transport.backend.llvm.choice import cpu_name
from tests.system.test_stress import campaign

pytestmark = [pytest.mark.mitsuba, pytest.mark.verify]

JOBS, FRAMES = 8, 2
# Says who has seen which exposure: a line for each frame.
NOTING = """
import os

def noting(frame, calibration):
    with open(os.environ["NOTES"], "a") as notes:
        notes.write(f"{os.getpid()} {frame.exposure_s}\\n")
    return []
"""


def test_workers_that_begin_anew_lose_nothing_and_do_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight jobs, two to a process: by one worker, with its four processes, and by eight; the same files."""
    file = campaign(tmp_path, ranges=1, exposures=JOBS)
    (tmp_path / "mine.py").write_text(NOTING)
    document = yaml.safe_load(file.read_text()) | {"estimators": ["mine.py:noting", "paper"]}
    file.write_text(yaml.safe_dump(document))
    read = load_campaign(file)
    jobs = plan(read)
    # Each for itself: no job waits for another's light.
    jobs = [replace(job, light=f"{job.key} {job.light.partition(' ')[2]}") for job in jobs]
    contents = {}
    for workers in (1, 8):
        notes, parts = tmp_path / f"notes{workers}", tmp_path / f"parts{workers}"
        monkeypatch.setenv("NOTES", str(notes))
        parts.mkdir()
        work = Work(read.scene, read.estimators, parts, tmp_path / f"light{workers}", 2**30, 1, cpu_name(), 2)
        ended = list(run_jobs(work, jobs, workers, tmp_path / "scratch"))
        assert {one.error for one in ended} == {None}
        assert Counter(one.job.key for one in ended) == Counter(job.key for job in jobs)
        seen = [line.split() for line in notes.read_text().splitlines()]
        assert set(Counter(exposure for _, exposure in seen).values()) == {FRAMES}
        assert len({exposure for _, exposure in seen}) == JOBS
        per_process = Counter(process for process, _ in seen).values()
        assert max(per_process) <= 2 * FRAMES
        if workers == 1:
            assert list(per_process) == [2 * FRAMES] * (JOBS // 2)
        contents[workers] = [part_file(parts, job).read_bytes() for job in jobs]
    assert contents[1] == contents[8]
