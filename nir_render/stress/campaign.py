"""A campaign document: which scene is swept along which axes, and what is to hold there."""

import difflib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, field_validator

from nir_render.errors import InputError, shown
from nir_render.scene.documents.base import Document, document_key
from nir_render.scene.documents.files import exists
from nir_render.scene.load import load_scene
from nir_render.scene.problems import Places, explain
from nir_render.scene.scene import Scene
from nir_render.scene.text.yaml_text import read_yaml
from nir_render.stress.design.axes import Axis, AxisDocument, DottedPath
from nir_render.stress.design.points import SampleDocument, number_of_points
from nir_render.stress.metrics import METRICS, Bound, known_metric, parse_bound

MOST_JOBS = 100_000
_MOST_CHECKED = 200  # values of axes, each of which makes a scene
_LONGEST_NAME = 400  # of an estimator, with its file and folder
_DEFAULT_METRICS = ("range_rmse", "recall", "ranged", "false_alarms")


@dataclass(frozen=True, eq=False)
class Campaign:
    """A campaign, read and checked, but for its combinations of values.

    `sample` is None where all combinations of the axes' values are run.
    `scene` is the base scene with the campaign's own changes; `settings` are these, by dotted path.
    `metrics` are names of `METRICS`; those with a bound are among them. `path` names the file in errors.
    """

    name: str
    description: str
    scene: Scene
    settings: Mapping[str, Any]
    axes: tuple[Axis, ...]
    sample: SampleDocument | None
    seeds: tuple[int, ...]
    estimators: tuple[str, ...]
    metrics: tuple[str, ...]
    bounds: tuple[Bound, ...]
    path: str


class CampaignDocument(Document):
    """A campaign as written.

    `scene` is a file beside the campaign, `set` what is changed in it throughout. Every combination of the
    axes' values, or every point of `sample`, is rendered with every seed: a list, or how many, counted
    from 1.
    """

    format: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. -]{0,99}$")]
    description: str = ""
    scene: str
    settings: Annotated[dict[DottedPath, Any], Field(alias="set")] = {}
    axes: Annotated[dict[DottedPath, AxisDocument], Field(min_length=1)]
    sample: SampleDocument | None = None
    seeds: Annotated[int, Field(ge=1, le=MOST_JOBS)] | Annotated[tuple[int, ...], Field(min_length=1)] = (1,)
    estimators: Annotated[tuple[str, ...], Field(min_length=1)] = ("paper", "robust")
    figures: Annotated[tuple[str, ...], Field(min_length=1)] = _DEFAULT_METRICS
    bounds: dict[DottedPath, Any] = {}

    read_keys: ClassVar[tuple[str, ...]] = ("set",)

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: int | tuple[int, ...]) -> int | tuple[int, ...]:
        if isinstance(seeds, tuple) and (min(seeds) < 0 or len(set(seeds)) != len(seeds)):
            raise ValueError("wanted different whole numbers from 0 up, or how many seeds to take")
        return seeds

    @field_validator("figures")
    @classmethod
    def _metrics_known(cls, figures: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(known_metric(name) for name in figures))


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign file and its scene.

    Raises
    ------
    InputError
        A line per problem. What only a combination of values does wrong is found by `jobs.plan`.
    """
    file = Path(path)
    if not exists(file):
        raise InputError(f"{file}: there is no such campaign file; check its name and folder")
    try:
        raw = read_yaml(file)
    except ValueError as error:
        raise InputError(*str(error).split("\n")) from None
    if isinstance(raw, Mapping) and "robots" in raw and "axes" not in raw:
        raise InputError(f"{file}: is a scene; a campaign names one ('scene: …') and 'axes' to change in it")
    try:
        document = CampaignDocument.model_validate(raw)
    except ValidationError as error:
        raise InputError(*explain(error, raw, str(file))) from None
    places = Places(str(file))
    problems: list[str] = []
    axes, bounds = [], []
    for name, written in document.axes.items():
        try:
            axes.append(written.axis(name) if document.sample is None else written.sampled(name))
        except ValueError as error:
            problems.append(places.tell(("axes", name), ("axes", name), str(error)))
    for name, value in document.bounds.items():
        try:
            bounds.append(parse_bound(name, value))
        except ValueError as error:
            problems.append(places.tell(("bounds", name), ("bounds", name), str(error)))
    problems += [f"{file}: {problem}" for problem in _clashes(axes, document.settings)]
    estimators = tuple(dict.fromkeys(_beside(file, name) for name in document.estimators))
    place = ("estimators",)
    problems += [places.tell(place, place, problem) for problem in _not_estimators(estimators)]
    seeds = range(1, document.seeds + 1) if isinstance(document.seeds, int) else document.seeds
    number = number_of_points(axes, document.sample) * len(seeds)
    if not problems and number > MOST_JOBS:
        points = " × ".join(str(len(axis.values)) for axis in axes) + " values"
        if document.sample is not None:
            points = f"{document.sample.count} points"
        problems.append(
            f"{file}: {points} and {len(seeds)} seeds are {number} jobs; at most {MOST_JOBS} are taken at "
            "once: split the campaign"
        )
    if not document.bounds:
        problems += [
            places.tell(("axes", axis.name), ("axes", axis.name), "'refine' finds limits: give 'bounds' too")
            for axis in axes
            if axis.refinement is not None
        ]
    if document.sample is not None and all(axis.edges is None for axis in axes):
        problems.append(f"{file}: sample: no axis is a range: there is nothing to draw from; leave it out")
    if problems:
        raise InputError(*problems)
    scene = _base_scene(file, document, places)
    _check_axes(places, scene, axes)
    return Campaign(
        document.name,
        document.description,
        scene,
        document.settings,
        tuple(axes),
        document.sample,
        tuple(seeds),
        estimators,
        tuple(name for name in METRICS if name in document.figures or name in document.bounds),
        tuple(bounds),
        str(file),
    )


def campaign_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of what a person writes; an axis may be values alone."""
    from perception import ESTIMATORS  # the stack loads where it is asked for: scenes are validated without

    schema = CampaignDocument.model_json_schema(by_alias=True)
    definitions, properties = schema["$defs"], schema["properties"]
    values = {"type": "array", "minItems": 1, "description": "the values; the axis's name is the dotted path"}
    definitions["AxisDocument"] = {"title": "Axis", "anyOf": [values, definitions["AxisDocument"]]}
    metrics = {name: {"description": metric.explained} for name, metric in METRICS.items()}
    properties["bounds"] = {
        "type": "object",
        "properties": {name: {**own, "type": ["string", "number"]} for name, own in metrics.items()},
        "additionalProperties": False,
    }
    properties["figures"]["items"] = {"enum": list(METRICS)}
    properties["estimators"]["items"] = {"type": "string", "examples": [*ESTIMATORS, "file.py:function"]}
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "nir_render campaign"
    return schema


def is_campaign(path: Path) -> bool:
    """Tell whether a file is meant as a campaign: it has axes."""
    try:
        raw = read_yaml(path)
    except (OSError, ValueError):
        return False
    return isinstance(raw, Mapping) and "axes" in raw


def _base_scene(file: Path, document: CampaignDocument, places: Places) -> Scene:
    try:
        return load_scene(os.path.normpath(file.parent / document.scene), document.settings)
    except InputError as error:
        told = (places.tell(("scene",), ("scene",), _bare(problem)) for problem in error.problems)
        raise InputError(*told) from None


def _check_axes(places: Places, scene: Scene, axes: list[Axis]) -> None:
    """Refuse an axis whose path is no part of the scene, or a value that is none for it.

    Of very many values some are tried, first and last among them: what else is wrong `jobs.plan` finds.
    """
    nowhere = [
        places.tell(("axes", axis.name), ("axes", axis.name), problem)
        for axis in axes
        for path in axis.paths
        for problem in _nowhere(scene.document, path)
    ]
    if nowhere:
        raise InputError(*nowhere)
    for axis in axes:
        # Two axes may only make sense together.
        others = {
            path: value for other in axes if other is not axis for path, value in other.settings(0).items()
        }
        problems: list[str] = []
        for index in _spread(len(axis.labels), _MOST_CHECKED // len(axes)):
            label = axis.labels[index] if len(axis.labels[index]) <= 100 else shown(axis.labels[index])
            alone = _problems(scene, axis.settings(index))
            if alone and _problems(scene, {**others, **axis.settings(index)}):
                place = ("axes", axis.name)
                problems += [places.tell(place, place, f"{label}: {_bare(problem)}") for problem in alone]
        if problems:
            raise InputError(*problems)


def _spread(count: int, most: int) -> list[int]:
    """Return indices below `count`, all or at most `most` of them, evenly from the first to the last."""
    tried = min(count, max(most, 2))
    return [round(number * (count - 1) / max(tried - 1, 1)) for number in range(tried)]


def _nowhere(document: Document, path: str) -> Iterator[str]:
    """Yield what is wrong with a path to a thing that the scene has not.

    A whole new material under a misspelt name would make a scene that is right, and an axis that changes
    nothing.
    """
    node: Any = document
    way = path.split(".")
    for depth, key in enumerate(way):
        if isinstance(node, Document):
            names = {document_key(name): name for name in type(node).model_fields}
            if key not in names:  # of such keys the model itself tells
                return
            node = getattr(node, names[key])
        elif isinstance(node, Mapping):
            if key not in node:
                near = difflib.get_close_matches(key, node, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(node) or 'none'}"
                yield (
                    f"there is no {shown(key)} in {'.'.join(way[:depth])}; {hint} "
                    "(what is new is written in the scene, or under 'set')"
                )
                return
            node = node[key]
        else:
            return


def _problems(scene: Scene, settings: Mapping[str, Any]) -> Sequence[str]:
    try:
        scene.with_(settings)
    except InputError as error:
        return error.problems
    return ()


def _clashes(axes: list[Axis], settings: Mapping[str, Any]) -> list[str]:
    """Return what is set twice: by two axes, by an axis and `set`; and the seed, which has its own key."""
    problems = []
    owner: dict[str, str] = dict.fromkeys(settings, "'set'")
    for axis in axes:
        for path in axis.paths:
            if path in owner:
                problems.append(f"axes.{axis.name}: {path} is set by {owner[path]} too")
            owner[path] = f"axes.{axis.name}"
    problems += [f"{owner['seed']} sets the seed: write it under 'seeds'"] if "seed" in owner else []
    problems += [
        f"{owner[key]} sets {key!r}, which changes no picture" for key in ("name", "format") if key in owner
    ]
    return problems


def _beside(file: Path, estimator: str) -> str:
    """Return an estimator's name; one's own, `file.py:function`, counts from the campaign's folder.

    Its path is absolute: workers may have another working directory.
    """
    from perception.command_estimator import is_command

    own = ".py" in estimator and not is_command(estimator)
    return str((file.parent / estimator).absolute()) if own else estimator


def _not_estimators(names: Sequence[str]) -> list[str]:
    """Return what is wrong with estimators: unknown ones, files that cannot be loaded, two of one name."""
    from nir_render.run.perceive import estimators_in_process

    longest = max(names, key=len)
    if len(longest) > _LONGEST_NAME:
        return [f"{shown(longest)} is too long for an estimator; give one such as robust or file.py:function"]
    try:
        estimators_in_process(names)
    except InputError as error:
        return [problem.removeprefix("--estimator ") for problem in error.problems]
    return []


def _bare(problem: str) -> str:
    """Return a scene's problem without the words for the command line's option."""
    return problem.removeprefix("--set ").replace(" with --set", "")
