"""What a job queue is asked for, in its own words, and what of a file about it is refused."""

from pathlib import Path

import pytest
import yaml

from nir_render.errors import InputError
from nir_render.stress.workers.queue import QueueDocument, _arguments, load_queue, queued

dask_jobqueue = pytest.importorskip("dask_jobqueue")

ASKED = {"format": 1, "system": "slurm", "jobs": 4, "workers": 8, "memory": "16 GiB", "walltime": "2 h"}
SCRIPTS = {
    "slurm": ("-p night", "-A mine", "--cpus-per-task=8", "--mem=16G", "-t 02:00:00"),
    "pbs": ("-q night", "-A mine", "select=1:ncpus=8:mem=16GB", "walltime=02:00:00"),
    "lsf": ("-q night", '-P "mine"', "-n 8", "-M 17180", "-W 02:00"),
}


@pytest.mark.parametrize("system", SCRIPTS)
def test_a_queue_is_asked_in_its_own_words(system: str, tmp_path: Path) -> None:
    """Eight processes of one thread and 2 GiB each, that leave 60 s before the queue ends their job, ± a tenth."""
    document = QueueDocument.model_validate({**ASKED, "system": system, "queue": "night", "account": "mine"})
    asked = _arguments(document, tmp_path)
    for of_cluster in ("silence_logs", "scheduler_options"):
        del asked[of_cluster]
    if system == "lsf":
        asked["lsf_units"] = "mb"  # else bsub's own settings are read, which are not here
    kind = {"slurm": dask_jobqueue.slurm.SLURMJob, "pbs": dask_jobqueue.pbs.PBSJob,
            "lsf": dask_jobqueue.lsf.LSFJob}[system]  # fmt: skip
    script = kind(scheduler="tcp://here:1", name="w", **asked).job_script()
    for words in SCRIPTS[system]:
        assert words in script
    assert "--nthreads 1 --memory-limit 2.00GiB --nworkers 8" in script
    assert "--lifetime 6491s --lifetime-stagger 649s" in script  # 6 491 + 649 = 7 200 - 60
    assert str(tmp_path) in script


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"memory": "much"}, "'much' is no size of memory; write one such as 16 GiB"),
        ({"walltime": "1 min"}, "take 120 s or more"),
        ({"walltime": "2 m"}, "is a length; wanted a time"),
        ({"system": "sge"}, "system"),
        ({"job": 3}, "did you mean 'jobs'"),
        ({"settings": {"cores": 3}}, "'settings' holds 'cores', which a key of its own says"),
    ],
)
def test_what_makes_no_queue_is_refused(changes: dict[str, object], said: str, tmp_path: Path) -> None:
    file = tmp_path / "queue.yaml"
    file.write_text(yaml.safe_dump({**ASKED, **changes}))
    with pytest.raises(InputError) as refused:
        load_queue(file)
    assert str(file) in str(refused.value)
    assert said in str(refused.value)


def test_where_there_is_no_queue_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    document = QueueDocument.model_validate(ASKED)
    with (
        pytest.raises(InputError, match="there is no sbatch here"),
        queued(tmp_path / "q", document, tmp_path),
    ):
        pass
