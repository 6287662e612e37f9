"""The command of many runs: stress, over axes of a scene."""

import contextlib
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import (
    Json,
    LightFolder,
    LightLimit,
    light_limit_bytes,
)
from nir_render.errors import InputError

if TYPE_CHECKING:
    from nir_render.stress.campaign import Campaign
    from nir_render.stress.jobs import Job
    from nir_render.stress.store import Store
    from nir_render.stress.sweep import Sweep


def stress(
    file: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="A campaign file (YAML).")],
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Where it goes; outputs/NAME by default. Object storage, s3://BUCKET/PLACE, has it too.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes to work in; by default as many as cores, at most 8."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Have the workers of a Dask scheduler do it: tcp://host:8786.",
        ),
    ] = None,
    cluster: Annotated[
        Path | None,
        typer.Option(
            "--cluster",
            metavar="FILE",
            help="Have the job queue of a cluster start workers: which, and how many, by a file (YAML).",
        ),
    ] = None,
    light_folder: LightFolder = None,
    light_gib: LightLimit = 4.0,
    only_plan: Annotated[
        bool, typer.Option("--plan", help="Only check the campaign, and say how many jobs it has.")
    ] = False,
    status: Annotated[
        bool, typer.Option("--status", help="Only say how many of the jobs that were begun are done.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Sweep a scene along axes, and show where estimators fail; goes on where it was stopped."""
    from nir_render.command.terminal.console import note
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.report.wording import counted
    from nir_render.stress.campaign import load_campaign
    from nir_render.stress.jobs import plan
    from nir_render.stress.refine import sweep_refined
    from nir_render.stress.store import Store, is_url
    from nir_render.stress.sweep import QUEUE_LOGS, StoppedError, check_folder
    from nir_render.stress.workers.cluster import Scheduler
    from nir_render.stress.workers.queue import load_queue, queued

    if sum(where is not None for where in (scheduler, workers, cluster)) > 1:
        raise InputError(
            "--workers, --scheduler, --cluster: each says whose workers do it; leave out all but one of them"
        )
    queue = None if cluster is None else load_queue(cluster)
    campaign = load_campaign(file)
    limit_bytes = light_limit_bytes(light_gib)
    store = Store(output) if output is not None and is_url(output) else None
    folder = Path("outputs") / campaign.name if output is None or store is not None else Path(output)
    if status:
        _show_status(campaign, folder, store, as_json)
        return
    with progress_bar("check") as progress:
        jobs = plan(campaign, progress)
    if only_plan:
        _show_plan(campaign, jobs, folder, store, as_json)
        return
    try:
        with contextlib.ExitStack() as stack:
            others = None if scheduler is None else Scheduler(scheduler)
            if cluster is not None and queue is not None:
                check_folder(folder, campaign)
                note(f"{queue.system}: {counted(queue.jobs, 'job')} asked for; the first to start begins")
                others = stack.enter_context(queued(cluster, queue, folder / QUEUE_LOGS))
            result = sweep_refined(
                campaign,
                jobs,
                folder,
                workers=workers,
                bar=progress_bar,
                light=light_folder,
                light_limit_bytes=limit_bytes,
                scheduler=others,
                store=store,
            )
    except StoppedError as stopped:
        note(f"{stopped}; the same command goes on: {shlex.join(['nir-render', *sys.argv[1:]])}")
        raise typer.Exit(128 + signal.SIGINT) from None
    _show(result, as_json)
    if result.failed:
        raise typer.Exit(1)


def _show_plan(
    campaign: "Campaign", jobs: "list[Job]", folder: Path, store: "Store | None", as_json: bool
) -> None:
    from nir_render.command.terminal.console import print_json
    from nir_render.stress.sweep import plan_record

    record = plan_record(campaign, jobs, folder, store)
    if as_json:
        print_json(record)
    else:
        typer.echo(
            f"{campaign.name}: {record['jobs']} jobs in {record['geometries']} geometries; "
            f"{record['done']} are done in {store.url if store else folder}"
        )
        if record["refined"]:
            typer.echo(f"limits along {', '.join(record['refined'])} are refined: that adds jobs")


def _show_status(campaign: "Campaign", folder: Path, store: "Store | None", as_json: bool) -> None:
    from nir_render.command.terminal.console import print_json
    from nir_render.stress.sweep import status_record

    record = status_record(campaign, folder, store)
    if as_json:
        print_json(record)
        return
    place = store.url if store else folder
    typer.echo(f"{campaign.name}: {record['done']} of {record['jobs']} jobs are done in {place}")
    if record["others"]:
        typer.echo(f"{record['others']} more are of the campaign or the program as it was before")


def _show(result: "Sweep", as_json: bool) -> None:
    from nir_render.command.terminal.console import note, print_error, print_json, warn
    from nir_render.stress.page.words import reach_lines
    from nir_render.stress.sweep import sweep_record, write_report

    for text in result.warnings:
        warn(text)
    page = write_report(result)
    if as_json:
        print_json(sweep_record(result))
    else:
        for line in reach_lines(result.campaign, result.table):
            typer.echo(line)
        typer.echo(f"open {page}")
    for key, text in result.failed.items():
        print_error(text, label=f"job {key[:8]} failed")
    if result.failed:
        note("the same command tries these again")
