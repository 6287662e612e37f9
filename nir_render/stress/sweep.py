"""A campaign from beginning to end: jobs that are not done yet are done, then the table and the page."""

import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import yaml

from nir_render.errors import DiskFullError, InputError
from nir_render.report.wording import counted
from nir_render.run.folder import disk_error, locked, read_json, write_file, write_json, write_lines
from nir_render.run.manifest import versions
from nir_render.stress.campaign import Campaign
from nir_render.stress.jobs import Job
from nir_render.stress.store import Store
from nir_render.stress.summary import summary_of
from nir_render.stress.table import gathered, read_part, write_table
from nir_render.stress.workers.cluster import MARK, Scheduler
from nir_render.stress.workers.pool import PART_KIND, PARTS, Work, part_file, part_object, run_jobs
from nir_render.transport.backend.cores import cores, usual_workers
from nir_render.transport.backend.llvm.choice import cpu_name
from nir_render.transport.backend.variant import backend

MANIFEST = "campaign.json"
TABLE, PAGE, JOBS, PLANNED = "table.parquet", "report.html", "jobs.jsonl", "planned.json"
QUEUE_LOGS = ".queue"  # what workers say that a job queue has started
_LIGHT, _SCRATCH, _LOCK = "light", ".workers", ".lock"
_AT_ONCE = 16  # requests to object storage


Progress = Callable[[int, int], None]


class StoppedError(Exception):
    """A sweep was stopped before its end, by Ctrl-C; what is done stays done."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"stopped with {done} of {total} jobs done")
        self.done, self.total = done, total


@dataclass(frozen=True, eq=False)
class Sweep:
    """A campaign that has ended.

    `table` holds the rows of all jobs that are done; `failed` what went wrong with the others, by job's key;
    `reused` how many had been done before; `warnings` what the reader of its metrics should know.
    """

    campaign: Campaign
    jobs: tuple[Job, ...]
    table: pa.Table
    failed: Mapping[str, str]
    reused: int
    folder: Path
    warnings: tuple[str, ...]
    store: Store | None = None


def sweep(
    campaign: Campaign,
    jobs: Sequence[Job],
    folder: Path,
    *,
    workers: int | None,
    progress: Progress,
    light: Path | None = None,
    light_limit_bytes: int = 4 * 2**30,
    scheduler: Scheduler | None = None,
    store: Store | None = None,
) -> Sweep:
    """Do the jobs of a campaign that the folder does not hold yet, and gather all into its table.

    Parameters
    ----------
    jobs
        As `jobs.plan` gives them.
    folder
        New, empty, or that of a campaign of the same name: what is done there is not done again.
    workers
        How many processes work; without, as many as cores, at most 8. The cores are shared among them.
    light
        Where light is kept for other jobs and campaigns; in the folder by default.
    light_limit_bytes
        How large that may grow.
    scheduler
        One whose workers do the jobs instead; `workers` then has no say.
    store
        Object storage that holds what the folder does: what is done there is not done again, and each job is
        put there by the worker that has done it.

    Raises
    ------
    InputError
        The folder is taken, another process works in it, the disk is full, the storage refuses.
    StoppedError
        By Ctrl-C; what was done stays, and the same call goes on.
    """
    _claim(folder, campaign)
    with locked(folder / _LOCK, f"{folder}: another nir-render works on this campaign; wait for its end"):
        parts = folder / PARTS
        write_json(folder / PLANNED, {"format": 1, "jobs": [job.key for job in jobs]})
        if store is not None:
            _exchange(store, campaign, folder, jobs)
        missing = [job for job in jobs if read_part(part_file(parts, job)) is None]
        done, failed = len(jobs) - len(missing), dict[str, str]()
        progress(done, len(jobs))
        if missing:
            workers = min(usual_workers() if workers is None else workers, len(missing))
            # Links are kept: on another machine the same name may lead elsewhere.
            kept = (folder / _LIGHT if light is None else light).absolute()
            threads = max(cores() // workers, 1) if scheduler is None else scheduler.threads
            scene = replace(campaign.scene, folder=campaign.scene.folder.absolute())
            work = Work(
                scene,
                campaign.estimators,
                parts.absolute(),
                kept,
                light_limit_bytes,
                threads,
                cpu_name(),
                store=store,
            )
            try:
                with closing(run_jobs(work, missing, workers, folder / _SCRATCH, scheduler)) as ending:
                    for ended in ending:
                        if ended.error is not None:
                            failed[ended.job.key] = ended.error
                        elif store is not None and read_part(part_file(parts, ended.job)) is None:
                            store.fetch(part_object(ended.job), part_file(parts, ended.job))
                        done += 1
                        progress(done, len(jobs))
            except KeyboardInterrupt:
                raise StoppedError(done - len(failed), len(jobs)) from None
            except DiskFullError as full:
                raise InputError(
                    f"{full}; {done - len(failed)} of {len(jobs)} jobs are done; make room, and the same "
                    "command goes on"
                ) from None
        for place in (folder, parts, folder / _LIGHT):
            _remove_abandoned(place, ".*.partial-*")
        _remove_abandoned(parts, f"{MARK}*")
        try:
            result = _gather(campaign, jobs, folder, failed, len(jobs) - len(missing))
        except DiskFullError as full:
            raise InputError(f"{full}; make room, and the same command goes on") from None
        if store is not None:
            for name in (TABLE, JOBS, MANIFEST):
                store.put(folder / name, name)
        return replace(result, store=store)


def _exchange(store: Store, campaign: Campaign, folder: Path, jobs: Sequence[Job]) -> None:
    """Put what this machine has done before into object storage, and fetch what others have."""
    check_store(store, campaign)
    for name in (MANIFEST, PLANNED):
        store.put(folder / name, name)
    there = store.names(PARTS)

    def exchange(job: Job) -> None:
        file = part_file(folder / PARTS, job)
        whole = read_part(file) is not None
        if whole and file.name not in there:
            store.put(file, part_object(job))
        elif not whole and file.name in there:
            store.fetch(part_object(job), file)

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        list(pool.map(exchange, jobs))


def plan_record(
    campaign: Campaign, jobs: Sequence[Job], folder: Path, store: Store | None = None
) -> dict[str, Any]:
    """Return what a sweep has to do, as one JSON object: jobs, those that the folder holds, geometries.

    `refined` names the axes along which limits are found more exactly, which adds jobs as they are found.
    Files of jobs are counted, not read: one that is broken counts here, and is done again by the sweep.

    Errors as `sweep`.
    """
    held: set[str] = set()
    if store is not None:
        check_store(store, campaign)
        held = store.names(PARTS)
    elif folder.exists():
        check_folder(folder, campaign)
        held = {path.name for path in (folder / PARTS).glob("*")}
    done = sum(part_file(folder / PARTS, job).name in held for job in jobs)
    geometries = len({job.light for job in jobs})
    return {
        "campaign": campaign.name,
        "jobs": len(jobs),
        "done": done,
        "geometries": geometries,
        "refined": [axis.name for axis in campaign.axes if axis.refinement is not None],
    }


def status_record(campaign: Campaign, folder: Path, store: Store | None = None) -> dict[str, Any]:
    """Return how far the last sweep of a folder has come, as one JSON object, without planning anew.

    `jobs` are those that it planned, `done` those of them whose files are there; `others` are files of jobs
    that it did not plan: of the campaign before it was edited, or of another program.

    Raises
    ------
    InputError
        The folder is not this campaign's, or no sweep has begun there.
    """
    if store is None:
        check_folder(folder, campaign)
        begun = read_json(folder / PLANNED) if (folder / PLANNED).is_file() else None
        held = {path.name for path in (folder / PARTS).glob(f"*{PART_KIND}")}
    else:
        check_store(store, campaign)
        written = store.read(PLANNED)
        begun = None if written is None else json.loads(written)
        held = {name for name in store.names(PARTS) if name.endswith(PART_KIND)}
    if begun is None:
        raise InputError(
            f"{store.url if store else folder}: no sweep has begun there; without --status it begins"
        )
    held = {name for name in held if not name.startswith(".")}
    planned = {f"{key}{PART_KIND}" for key in begun["jobs"]}
    return {
        "campaign": campaign.name,
        "jobs": len(planned),
        "done": len(planned & held),
        "others": len(held - planned),
    }


def sweep_record(result: Sweep) -> dict[str, Any]:
    """Return what a sweep has done and found, as one JSON object."""
    return {
        "format": 1,
        "folder": str(result.folder),
        "jobs": len(result.jobs),
        "done_before": result.reused,
        "failed": len(result.failed),
        **summary_of(result.campaign, result.table),
    }


def check_folder(folder: Path, campaign: Campaign) -> None:
    """Raise InputError where a folder is there that is not this campaign's."""
    if folder.is_file():
        raise InputError(f"{folder}: is a file; give a folder for the campaign")
    # One that was killed as it began has left no more than these.
    begun = (_LOCK, QUEUE_LOGS, f".{MANIFEST}.partial-")
    if folder.is_dir() and not all(path.name.startswith(begun) for path in folder.iterdir()):
        if not (folder / MANIFEST).is_file():
            raise InputError(f"{folder}: holds files that are no campaign's; give a new folder")
        _check_name(str(folder), read_json(folder / MANIFEST), campaign)


def check_store(store: Store, campaign: Campaign) -> None:
    """Raise InputError where object storage holds what is not this campaign's."""
    written = store.read(MANIFEST)
    if written is not None:
        _check_name(store.url, json.loads(written), campaign)
    elif store.names():
        raise InputError(f"{store.url}: holds objects that are no campaign's; give a new place")


def _check_name(place: str, facts: Any, campaign: Campaign) -> None:
    name = facts.get("name") if isinstance(facts, dict) else None
    if name != campaign.name:
        raise InputError(f"{place}: holds the campaign {name!r}, not {campaign.name!r}; give another folder")


def _claim(folder: Path, campaign: Campaign) -> None:
    """Make the folder of a campaign, or take the one that is there."""
    check_folder(folder, campaign)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # First of all files, so that a folder is known for what it is whenever this is killed.
        if not (folder / MANIFEST).is_file():
            write_json(folder / MANIFEST, {"format": 1, "name": campaign.name})
        (folder / PARTS).mkdir(exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from None


def _remove_abandoned(folder: Path, names: str) -> None:
    """Remove what killed programs have left: files that they did not come to rename, or to remove."""
    for path in folder.glob(names):
        path.unlink(missing_ok=True)


def command(campaign: Campaign, job: Job) -> str:
    """Return the command that renders a job's scene as a run of its own, to look at its frames."""
    settings = {**campaign.settings, **job.settings}
    seed = settings.pop("seed")
    words = ["nir-render", "run", campaign.scene.path, "-o", f"outputs/{job.key[:8]}", "--seed", str(seed)]
    for path, value in settings.items():
        text = (
            value if isinstance(value, str) else yaml.safe_dump(value, default_flow_style=True, width=10**6)
        )
        words += ["--set", f"{path}={text.removesuffix('...' + chr(10)).strip()}"]
    return shlex.join(words)


def _gather(
    campaign: Campaign, jobs: Sequence[Job], folder: Path, failed: Mapping[str, str], reused: int
) -> Sweep:
    lines: list[dict[str, Any]] = []
    tables: list[pa.Table] = []
    done: list[Job] = []
    failed = dict(failed)
    for job in jobs:
        part = None if job.key in failed else read_part(part_file(folder / PARTS, job))
        if part is None:
            failed.setdefault(job.key, "its file is gone")
            continue
        rows, frames_sha256 = part
        done.append(job)
        tables.append(rows)
        labels = dict(zip((axis.name for axis in campaign.axes), job.point.labels, strict=True))
        lines.append(
            {
                "format": 1,
                "job": job.key,
                "seed": job.seed,
                "axes": labels,
                "frames_sha256": frames_sha256,
                "command": command(campaign, job),
            }
        )
    if not tables:
        raise InputError(f"{campaign.path}: no job could be done: {next(iter(failed.values()))}")
    table = gathered(done, tables, campaign.axes)
    write_table(folder / TABLE, table)
    write_lines(folder / JOBS, lines)
    facts = {
        "campaign": campaign.path,
        "versions": versions(),
        "variant": backend().variant,
        "jobs": len(jobs),
        "failed": [{"job": key, "error": error} for key, error in failed.items()],
    }
    write_json(folder / MANIFEST, {"format": 1, "name": campaign.name, **facts})
    return Sweep(campaign, tuple(jobs), table, failed, reused, folder, tuple(_noise_warnings(table)))


def _noise_warnings(table: pa.Table) -> Iterator[str]:
    """Yield a warning where render noise is above the target, in what could pass for the sensor's."""
    share, target = (table[name].to_numpy() for name in ("render_noise_share", "render_noise_target"))
    above = share > target  # false where there is no target
    if above.any():
        jobs = len(set(table["job"].filter(pa.array(above)).to_pylist()))
        yield (
            f"render noise is above its target in {counted(jobs, 'job')}: up to {share[above].max():.3g} of "
            "the sensor's variance (column render_noise_share); more samples, fixed by "
            "render.indirect.samples, bring it down"
        )


def write_report(result: Sweep) -> Path:
    """Write the page of a sweep beside its table, in object storage too; returns its path."""
    from nir_render.stress.page.page import campaign_html

    facts = read_json(result.folder / MANIFEST)
    commands = {job.key: command(result.campaign, job) for job in result.jobs}
    shown = {key: value for key, value in facts.items() if key not in ("format", "name")}
    facts = {**shown, "commands": commands, "warnings": result.warnings}
    page = result.folder / PAGE
    write_file(page, campaign_html(result.campaign, result.table, facts).encode())
    if result.store is not None:
        result.store.put(page, PAGE)
    return page
