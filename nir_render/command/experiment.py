"""The command of closed loops: experiment, the paper's own over seeds."""

import math
import signal
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nir_render.command.options import Json, Output, Settings, read_scene
from nir_render.errors import InputError

if TYPE_CHECKING:
    from nir_render.experiments.communication.loop import Communication
    from nir_render.experiments.flocking.loop import Flocking
    from nir_render.scene.scene import Scene


class Experiment(StrEnum):
    """The paper's experiments that there are."""

    CALIBRATION = "calibration"
    DIFFUSER = "diffuser"
    FLOCKING = "flocking"
    COMMUNICATION = "communication"
    SWARM = "swarm"
    LIMITS = "limits"


class Threat(StrEnum):
    """Of the limits: what the paper's conclusion leaves open."""

    MULTIPATH = "multipath"
    SUN = "sun"
    FOG = "fog"
    CROWDING = "crowding"


class Law(StrEnum):
    """By which robots steer."""

    ROBUST = "robust"
    PAPER = "paper"


class Bodies(StrEnum):
    """Of a swarm's robots."""

    MASTS = "masts"
    COLUMNS = "columns"


class Level(StrEnum):
    """By what they see."""

    FRAMES = "frames"
    MEASUREMENTS = "measurements"
    TRUTH = "truth"


def experiment(
    name: Annotated[
        Experiment,
        typer.Argument(
            metavar="NAME",
            help="Which: calibration, diffuser, flocking, communication, swarm or limits.",
        ),
    ],
    output: Output = None,
    law: Annotated[
        Law, typer.Option("--law", help="Flocking: how robots steer, robust or as the paper says.")
    ] = Law.ROBUST,
    level: Annotated[
        Level | None,
        typer.Option(
            "--level",
            help="What they see by: frames (hours), measurements drawn at their bound (minutes), or truth; "
            "by default frames for swarm, else measurements.",
        ),
    ] = None,
    stack: Annotated[
        Law, typer.Option("--stack", help="With frames: the perception stack, robust or paper.")
    ] = Law.ROBUST,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds", min=1, help="How many runs, by seeds from 0 on: 20, of swarm 1 each, of limits 1 to 5."
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            metavar="S",
            help="How long each lasts: flocking 120 s, communication 65 s, swarm 60 s.",
        ),
    ] = None,
    robots: Annotated[
        int | None,
        typer.Option(
            "--robots",
            min=3,
            help="How many, who leads or looks among them: communication 3 to 7, swarm up to 3072 (30).",
        ),
    ] = None,
    density: Annotated[
        list[float] | None,
        typer.Option("--density", metavar="N", help="Swarm: robots per m²; again for more. 0.5, 1 and 2."),
    ] = None,
    bodies: Annotated[
        Bodies | None,
        typer.Option("--bodies", help="Swarm: masts, which hide nothing, or columns, which do; or both."),
    ] = None,
    only: Annotated[
        list[Threat] | None,
        typer.Option("--only", help="Limits: this threat; again for more. All by default."),
    ] = None,
    keep_frames: Annotated[
        str | None,
        typer.Option(
            "--keep-frames",
            metavar="every:N",
            help="With frames: keep those of every Nth look; none by default.",
        ),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            "--scene", metavar="SCENE", help="Another arena; its first robot leads, the others follow."
        ),
    ] = None,
    settings: Settings = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes; by default as many as cores, at most 8."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Run an experiment: ranges, a source that turns, robots that move by what they see; limits of it all."""
    from nir_render.command.terminal.console import print_json
    from nir_render.experiments.communication.loop import Communication
    from nir_render.experiments.flocking.loop import Flocking
    from nir_render.experiments.flocking.outcome import ARENA
    from nir_render.experiments.standing.rail import RAIL
    from nir_render.experiments.standing.turntable import TURNTABLE
    from nir_render.experiments.swarm.hall import HALL

    least_s = 0.1 if name is Experiment.SWARM else 1.0
    if seconds is not None and not (math.isfinite(seconds) and seconds >= least_s):
        raise InputError(f"--seconds {seconds:g}: wanted {least_s:g} s or more, such as 60")
    if name is Experiment.COMMUNICATION and not 3 <= (robots or 3) <= 7:
        raise InputError(f"--robots {robots}: communication wants 3 to 7, the leader among them")
    folder = output if output is not None else Path("outputs") / name.value
    if name is Experiment.LIMITS:
        if scene is not None or settings:
            raise InputError(
                "--scene, --set: limits have scenes of their own; nir-render stress sweeps others"
            )
        _limits(only, seeds, folder, workers, as_json)
        return
    by = level or (Level.FRAMES if name is Experiment.SWARM else Level.MEASUREMENTS)
    every = _kept_every(keep_frames, by)
    arenas = {Experiment.CALIBRATION: RAIL, Experiment.DIFFUSER: TURNTABLE, Experiment.SWARM: HALL}
    arena = arenas.get(name, ARENA)
    seeds = seeds or (1 if name is Experiment.SWARM else 20)
    world = read_scene(arena if scene is None else scene, settings, None)
    if name is Experiment.CALIBRATION:
        said, page, record = _calibration(world, seeds, folder, workers)
    elif name is Experiment.DIFFUSER:
        said, page, record = _diffuser(world, seeds, folder, workers)
    elif name is Experiment.SWARM:
        if by is Level.TRUTH:
            raise InputError("--level truth: a swarm is seen by frames or by measurements")
        wanted = (robots or 30, tuple(density or ()), bodies, by)
        said, page, record = _swarm(world, wanted, seconds or 60.0, seeds, folder, workers)
    elif name is Experiment.FLOCKING:
        flocking = Flocking(
            law=law.value, level=by.value, stack=stack.value, lasts_s=seconds or 120.0, keep_frames=every
        )
        said, page, record = _flocking(world, flocking, seeds, folder, workers)
    else:
        communication = Communication(
            robots=robots or 3,
            level=by.value,
            stack=stack.value,
            lasts_s=seconds or 65.0,
            keep_frames=every,
        )
        said, page, record = _communication(world, communication, seeds, folder, workers)
    if as_json:
        print_json({**record, "page": str(page)})
        return
    typer.echo(said)
    typer.echo(f"open {page}")


def _limits(
    only: list[Threat] | None, seeds: int | None, folder: Path, workers: int | None, as_json: bool
) -> None:
    from nir_render.command.terminal.console import note, print_json, warn
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.limits.outcome import outcome_of
    from nir_render.experiments.limits.page import sentence, write_outcome
    from nir_render.experiments.limits.studies import STUDIES
    from nir_render.report.wording import counted
    from nir_render.stress.sweep import StoppedError

    studies = [study for study in STUDIES if not only or study.threat in only]
    try:
        outcome = outcome_of(studies, seeds, folder, workers, progress_bar)
    except StoppedError as stopped:
        note(f"{stopped} of this campaign; the same command goes on")
        raise typer.Exit(128 + signal.SIGINT) from None
    page = write_outcome(outcome, folder)
    if as_json:
        print_json({**outcome.record(), "page": str(page)})
    else:
        typer.echo(sentence(outcome))
        typer.echo(f"open {page}")
    if outcome.failed:
        warn(f"{counted(outcome.failed, 'job')} failed; the same command tries these again")
        raise typer.Exit(1)


def _kept_every(text: str | None, level: Level) -> int:
    """Return every how many looks frames are kept; 0 for none."""
    if text is None:
        return 0
    number = text.removeprefix("every:")
    if not (text.startswith("every:") and number.isdecimal() and int(number) > 0):
        raise InputError(f"--keep-frames {text}: wanted every:N, such as every:50")
    if level is not Level.FRAMES:
        raise InputError(f"--keep-frames: there are no frames by {level.value}; add --level frames")
    return int(number)


def _calibration(
    world: "Scene", seeds: int, folder: Path, workers: int | None
) -> tuple[str, Path, dict[str, Any]]:
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.standing.rail import Rail
    from nir_render.experiments.standing.rail_outcome import outcome_of
    from nir_render.experiments.standing.rail_page import sentence, write_outcome
    from nir_render.transport.backend.cores import usual_workers

    with progress_bar("calibration") as progress:
        outcome = outcome_of(world, Rail(), range(seeds), folder, workers or usual_workers(), progress)
    return sentence(outcome), write_outcome(outcome, folder), outcome.record()


def _diffuser(
    world: "Scene", seeds: int, folder: Path, workers: int | None
) -> tuple[str, Path, dict[str, Any]]:
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.standing.turntable import Turntable
    from nir_render.experiments.standing.turntable_page import outcome_of, sentence, write_outcome
    from nir_render.transport.backend.cores import usual_workers

    with progress_bar("diffuser") as progress:
        outcome = outcome_of(world, Turntable(), range(seeds), folder, workers or usual_workers(), progress)
    return sentence(outcome), write_outcome(outcome, folder), outcome.record()


def _swarm(
    world: "Scene",
    wanted: tuple[int, tuple[float, ...], Bodies | None, Level],
    seconds: float,
    seeds: int,
    folder: Path,
    workers: int | None,
) -> tuple[str, Path, dict[str, Any]]:
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.swarm.identity import MOST
    from nir_render.experiments.swarm.loop import Swarm
    from nir_render.experiments.swarm.outcome import conditions_of, outcome_of
    from nir_render.experiments.swarm.page import sentence, write_outcome
    from nir_render.transport.backend.cores import usual_workers

    robots, densities, bodies, level = wanted
    if robots > MOST:
        raise InputError(f"--robots {robots}: two words tell {MOST} apart")
    if any(not (math.isfinite(one) and 0.01 <= one <= 4.0) for one in densities):
        raise InputError("--density: wanted 0.01 to 4 robots per m²; they stand 0.3 m apart at least")
    plans = conditions_of(Swarm(level=level.value, robots=robots, lasts_s=seconds), densities, bodies)
    with progress_bar("swarm") as progress:
        outcome = outcome_of(world, plans, range(seeds), folder, workers or usual_workers(), progress)
    return sentence(outcome), write_outcome(outcome, folder), outcome.record()


def _flocking(
    world: "Scene", plan: "Flocking", seeds: int, folder: Path, workers: int | None
) -> tuple[str, Path, dict[str, Any]]:
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.flocking.outcome import outcome_of
    from nir_render.experiments.flocking.page import sentence, write_outcome
    from nir_render.transport.backend.cores import usual_workers

    with progress_bar("flocking") as progress:
        outcome = outcome_of(world, plan, range(seeds), folder, workers or usual_workers(), progress)
    return sentence(outcome), write_outcome(outcome, folder), outcome.record()


def _communication(
    world: "Scene", plan: "Communication", seeds: int, folder: Path, workers: int | None
) -> tuple[str, Path, dict[str, Any]]:
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.experiments.communication.outcome import outcome_of
    from nir_render.experiments.communication.page import sentence, write_outcome
    from nir_render.transport.backend.cores import usual_workers

    if len(world.document.robots) < plan.robots:
        raise InputError(
            f"{world.path}: has {len(world.document.robots)} robots; --robots wants {plan.robots}"
        )
    with progress_bar("communication") as progress:
        outcome = outcome_of(world, plan, range(seeds), folder, workers or usual_workers(), progress)
    return sentence(outcome), write_outcome(outcome, folder), outcome.record()
