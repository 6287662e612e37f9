"""Documents as careless people and broken tools write them: what each of thousands of mutations is told.

Each document is a scene or campaign of `scenes/`, changed in one to three places, or one whose mesh, curve, picture
or pattern is damaged, by a generator that is keyed by (seed, index): `python -m tests.fuzz --count 10000 --seed 1` prints one JSON object. A document is right, or
refused with problems that name the place and a remedy in our own words, in less than 5 s of CPU time.
"""

import argparse
import json
import random
import re
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from nir_render import InputError, load_scene
from nir_render.stress.campaign import is_campaign, load_campaign
from tests.damaged_files import good_files, write_damaged
from tests.paths import SCENES

MOST_SECONDS = 5.0
MOST_CHARACTERS = 2000
_FILES_EACH = 4  # every fourth document is right, and names a file that is not
# As quick as there are here: only the mutations read and write with them.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
# What only libraries say.
RAW = re.compile(
    r"Input should|validation error|pydantic|Traceback|constrained-|tuple\[|Value error|Assertion|while scanning|"
    r"while parsing|while constructing|expected <|yaml\.|Field required|Extra inputs|\[type=|Rotation|0x[0-9a-f]{6}|"
    r"<class|KeyProblem|invalid literal|could not convert|unable to parse|must be real|NoneType|subscriptable|"
    r"datetime|[Ee]rrno|inhomogeneous|numpy|np\.|has no attribute|unhashable|Decimal|codec|regex|pattern '"
)
REMEDY = re.compile(
    r"such as|wanted|did you mean|[Kk]nown|write|take |give|leave|use |put |check|must |choose|lower|shorten|raise |"
    r"move|this key is missing|should be|define|set |wants|at least|at most|see |look|indent|lengthen|[Ee]xport |unwrap |simplify |"
    r"sort "
)
UNITS = ("m", "mm", "nm", "s", "ms", "Hz", "deg", "rad", "W", "K", "e", "DN", "DN/e", "e/s", "px", "bit", "%", "/m", "",
         "kg", "parsnip", "W/m^2/nm", "m/K", "°", "µm", "lm", "m^99", "m/", "((", "2 m")  # fmt: skip
NUMBERS = ("0", "-1", "1", "1e300", "-1e300", "1e-300", "nan", "inf", "-inf", "1e999", "3.7", "1e9", "1e7", "1e-9", "007",
           "1_000", "0x10", "12345678901234567890", "9" * 400, "9" * 5000, "1/3", ".5", "5.", "+2", "--2")  # fmt: skip
# Plain scalars, as they stand in the file.
TRAPS = ("1:30:00", "1:30:00.5", "no", "yes", "on", "off", "~", "null", "010", "0b1", "1e3", ".nan", ".inf", "2020-01-01",
         "2020-13-45", "2020-01-01 10:00:00", "=", "<<", "!!int abc", "!!float x", "!!bool maybe", "!!binary aa", "!foo 1",
         "!!set {a}", "!!python/object:os.system x", "*nowhere", "&a [*a]", "&b {c: *b}", "[", "{", "'", '"', "@x", "`x`",
         "%x", "|", ">", "? a", "- -", "a: b: c", '"\\q"', "\t1", "#", "[1, 2", "{a: 1", "!!null x", "&x", "**")  # fmt: skip
TEXTS = ("", " ", "x", "front", "infra_swarm", "black", "🙂", "ä" * 300, "a" * 300, "a" * 100_000, "../" * 2000, "a/b", "\0",
         "\u202e", "A.b", "r1.front", "mine.yaml", "a" * 300 + ".yaml", "no.csv", "x" * 300 + ".csv", "..", "/", ".",
         "arena.yaml", "plane", "hg", "my_estimator.py:none", "file.py:", "{}", "[1, 2, 3] m", "[a, b, c] m", "[] m",
         "[1e300, 0, 0] m", "[1, 2] m", "[nan, 0, 0] m", "5 % of temporal variance", "0 % of temporal variance")  # fmt: skip


@dataclass
class Summary:
    """What came out."""

    documents: int = 0
    valid: int = 0
    refused: int = 0
    problems: int = 0
    with_line: int = 0
    slowest_s: float = 0.0
    slowest: int = -1
    failures: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


def fuzz(
    seed: int, indices: range, folder: Path, tell: Callable[[Summary], None] = lambda _: None
) -> Summary:
    """Read mutated documents of a seed, in a folder for them; `tell` hears of each hundred."""
    for scene in SCENES.rglob("*"):
        if scene.is_file():
            target = folder / scene.relative_to(SCENES)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(scene, target)
    sources = sorted(path.relative_to(folder) for path in folder.rglob("*.yaml"))
    files = folder / "files"
    files.mkdir(exist_ok=True)
    good = good_files()
    summary = Summary()
    started = time.perf_counter()
    for index in indices:
        draw = random.Random(f"{seed}:{index}")
        if index % _FILES_EACH == _FILES_EACH - 1:
            _judge_file(files, good, draw, index, summary)
            if index % 100 == 99:
                tell(summary)
            continue
        source = sources[draw.randrange(len(sources))]
        path = (folder / source).with_name("mutant.yaml")
        path.write_text(
            mutated((folder / source).read_text(encoding="utf-8"), draw), encoding="utf-8", newline=""
        )
        try:
            _judge(path, index, index % 10 == 0, summary)
        except Exception:
            summary.failures.append(
                {"index": index, "source": str(source), "what": traceback.format_exc()[-1500:]}
            )
        if index % 100 == 99:
            tell(summary)
        path.unlink()
    summary.seconds = time.perf_counter() - started
    return summary


def _judge_file(
    folder: Path, good: Mapping[str, bytes], draw: random.Random, index: int, summary: Summary
) -> None:
    """Read a scene whose file is damaged: what is told names the field and the file too."""
    path, name = write_damaged(folder, good, draw)
    try:
        problems = _judge(path, index, False, summary)
    except Exception:
        summary.failures.append({"index": index, "source": name, "what": traceback.format_exc()[-1500:]})
        return
    for problem in problems:
        said = problem.removeprefix(str(path))
        if not re.search(r"(materials\.m|shapes\.(body|wall)|robots\.r2\.rig\.sources\.top)", said):
            summary.failures.append({"index": index, "what": f"names no field: {said}"[:1500]})
        if name not in said and not re.search(r"[\d.]+ nm is above 1", said):  # a curve has become points
            summary.failures.append({"index": index, "what": f"names no file: {said}"[:1500]})


def _judge(path: Path, index: int, again: bool, summary: Summary) -> tuple[str, ...]:
    """Read a document, and hold what is told of it against what is wanted; return that."""

    def fail(what: str) -> None:
        summary.failures.append({"index": index, "what": what[:1500]})

    summary.documents += 1
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scene = None
            if path.parent.name == "campaigns" and is_campaign(path):
                load_campaign(path)
            else:
                scene = load_scene(path)
        problems: tuple[str, ...] = ()
        summary.valid += 1
    except InputError as error:
        problems = error.problems
        summary.refused += 1
    seconds = time.process_time() - started
    if seconds > summary.slowest_s:
        summary.slowest_s, summary.slowest = seconds, index
    if seconds > MOST_SECONDS:
        fail(f"took {seconds:.1f} s")
    summary.problems += len(problems)
    for problem in problems:
        summary.with_line += bool(re.match(re.escape(str(path)) + r"(:|, line )\d+: ", problem))
        said = problem.removeprefix(str(path))
        if said == problem:
            fail(f"names no file: {problem}")
        if raw := RAW.search(said):
            fail(f"says {raw[0]!r} in a library's words: {said}")
        if not REMEDY.search(said):
            fail(f"names no remedy: {said}")
        if len(problem) > MOST_CHARACTERS:
            fail(f"is {len(problem)} characters long: {said}")
    if again and scene is not None and not problems:
        path.write_text(scene.resolved_yaml(), encoding="utf-8")
        # Robots that were scattered are written where they stand, and not how they came there.
        if load_scene(path).document != scene.document.model_copy(update={"scatter": None}):
            fail("the resolved document is another scene")
    return problems


def mutated(text: str, draw: random.Random) -> str:
    """Return a document's text, changed in one to three places."""
    for _ in range(draw.choice((1, 1, 2, 3))):
        change = draw.choice((*_IN_TREE * 3, *_IN_TEXT))
        if change in _IN_TEXT:
            text = change(text, draw)
            continue
        if (
            "&" in text or "[[[[[[" in text or "{a: {a: {a: {a: " in text
        ):  # our own reader alone can bear them
            continue
        try:
            tree = yaml.load(text, _Loader)
        except (yaml.YAMLError, ValueError, KeyError, RecursionError):
            continue
        if not isinstance(tree, dict):
            continue
        raw: dict[str, str] = {}
        change(tree, draw, raw)
        text = yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)
        for mark, written in raw.items():
            text = text.replace(mark, written)
    return text


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each holder of a value, and its key or index there."""
    items = (
        list(node.items())
        if isinstance(node, dict)
        else list(enumerate(node))
        if isinstance(node, list)
        else []
    )
    for key, value in items:
        yield node, key
        yield from _places(value)


def _place(tree: Any, draw: random.Random) -> tuple[Any, Any]:
    places = list(_places(tree))
    return places[draw.randrange(len(places))] if places else ({"a": 1}, "a")


def _replace(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Write another value: of another kind, in another unit, huge, tiny, none, a trap of YAML's."""
    holder, key = _place(tree, draw)
    old = holder[key]
    mark = f"MARK{draw.randrange(10**9)}"
    match draw.randrange(9):
        case 0:
            holder[key] = mark
            raw[mark] = draw.choice(TRAPS)
        case 1:
            holder[key] = f"{draw.choice(NUMBERS)} {draw.choice(UNITS)}"
        case 2:
            holder[key] = mark
            raw[mark] = draw.choice(NUMBERS)
        case 3:
            holder[key] = draw.choice(TEXTS)
        case 4:
            holder[key] = draw.choice(
                ([], {}, [old], {"a": old}, None, True, [old, old], [[[old]]], [None], [False])
            )
        case 5 if isinstance(old, str):
            number = re.sub(r"[-+\d.]+", lambda _: draw.choice(NUMBERS), old, count=draw.choice((1, 1, 5)))
            holder[key] = number
        case 6 if isinstance(old, str) and " " in old:
            holder[key] = f"{old.rpartition(' ')[0]} {draw.choice(UNITS)}"
        case 7 if isinstance(old, int | float):
            holder[key] = draw.choice((-old, old * 1000, 10**12, 1e300, 1e-300, str(old), old + 0.5, 10**30))
        case _:
            other, other_key = _place(tree, draw)
            holder[key] = other[other_key] if isinstance(other[other_key], str | int | float) else "x"


def _rename(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Misspell a key."""
    holder, key = _place(tree, draw)
    if not isinstance(holder, dict):
        return
    at = draw.randrange(len(key) + 1) if key else 0
    new = draw.choice((key[:at] + key[at + 1 :], key[:at] + "x" + key[at:], key.upper(), "rgb", "", "a" * 100_000, "ü",
                       f"MARK{draw.randrange(10**9)}"))  # fmt: skip
    if new.startswith("MARK"):
        raw[new] = draw.choice(
            ("1", "no", "null", "1.5", "2020-01-01", "? [a]", "!!str 1", "*a", "''", "[a, b]")
        )
    holder[new] = holder.pop(key)


def _drop(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Forget a value."""
    holder, key = _place(tree, draw)
    del holder[key]


def _add(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Add a key, known somewhere or nowhere, or an item."""
    holder, _ = _place(tree, draw)
    other, key = _place(tree, draw)
    if isinstance(holder, list):
        holder.append(other[key] if isinstance(other[key], str | int | float) else "x")
    elif isinstance(key, str):
        holder[draw.choice((key, f"{key}2", "preset", "file", "type", "include", "points"))] = draw.choice(
            ("x", 1, None, "x.yaml", ["x"], {"points": [["1 deg", 1]]}, "infra_swarm", "a" * 300 + ".yaml")
        )


def _swap(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Exchange two values."""
    holder, key = _place(tree, draw)
    other, other_key = _place(tree, draw)
    first, second = holder[key], other[other_key]
    if json.dumps(first, default=str) in json.dumps(second, default=str) or isinstance(first, dict | list):
        return
    if isinstance(second, dict | list):
        return
    holder[key], other[other_key] = second, first


def _much(tree: Any, draw: random.Random, raw: dict[str, str]) -> None:
    """Ask for much: frames, samples, pixels, values, distances, times."""
    match draw.randrange(6):
        case 0:
            tree["clock"] = {"frames": draw.choice((10**6, 10**9, 10**30)), "frame_rate": "30 Hz"}
        case 1:
            tree["clock"] = {"frames": 1000, "frame_rate": draw.choice(("1e-300 Hz", "1e12 Hz", "1e300 Hz"))}
        case 2:
            tree["axes"] = {
                "a": {"path": "seed", "from": 1, "to": draw.choice((1000, "1e300")), "count": 1000}
            }
        case 3:
            tree["seeds"] = draw.choice((10**6, [1, "x"], {"a": 1}, [1] * 1000, "all"))
        case 4:
            holder, key = _place(tree, draw)
            holder[key] = ["x"] * draw.choice((1000, 60_000))
        case _:
            mark = f"MARK{draw.randrange(10**9)}"
            holder, key = _place(tree, draw)
            holder[key] = mark
            depth = draw.choice((10, 40, 400, 5000))
            raw[mark] = draw.choice(
                ("[" * depth + "]" * depth, "{a: " * depth + "1" + "}" * depth, "[" * depth)
            )


def _bomb(text: str, draw: random.Random) -> str:
    """Write aliases of aliases, or one that holds itself."""
    levels = draw.choice((3, 9))
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, levels)]
    merges = ["b0: &b0 {x: 1}", *(f"b{n}: &b{n} {{<<: [*b{n - 1}, *b{n - 1}]}}" for n in range(1, 30))]
    own = ["z: &z [*z]", "z: &z {b: *z}", "z: &z {<<: *z}", "name: *a", "robots: &r {a: *r}"]
    return text + "\n" + "\n".join(draw.choice((lines, merges, [draw.choice(own)]))) + "\n"


def _cut(text: str, draw: random.Random) -> str:
    """End too early."""
    return text[: draw.randrange(len(text) + 1)]


def _slip(text: str, draw: random.Random) -> str:
    """Insert, or leave out, a few characters."""
    at = draw.randrange(len(text) + 1)
    characters = draw.choice(("", "\t", ":", "'", '"', "[", "]", "{", "}", "#", "&", "*", "!", "|", "\n", "\r", "\x07", "\u2028", "- ",
                              "  ", ",", "%", "@", "\ufeff", "🙂", "---\n", "...\n", "\\", "<<: 1\n"))  # fmt: skip
    return text[:at] + characters + text[at + draw.choice((0, 0, 1, 5)) :]


def _repeat(text: str, draw: random.Random) -> str:
    """Write a line twice, or lines in another order."""
    lines = text.splitlines(keepends=True) or ["\n"]
    at = draw.randrange(len(lines))
    lines.insert(draw.choice((at, draw.randrange(len(lines) + 1))), lines[at])
    return "".join(lines)


Change = Callable[..., Any]
_IN_TREE: tuple[Change, ...] = (_replace, _replace, _replace, _rename, _drop, _add, _swap, _much)
_IN_TEXT: tuple[Change, ...] = (_bomb, _cut, _slip, _repeat)


def _tell(summary: Summary) -> None:
    """Say on standard error how far it is, and the newest failure."""
    newest = summary.failures[-1]["what"][-200:] if summary.failures else ""
    sys.stderr.write(f"{summary.documents} documents, {len(summary.failures)} failures {newest!r}\n")


def main() -> None:
    """Run as a script: print one JSON object; exit with 1 where a document fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the index of the first document")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        indices = range(given.first, given.first + given.count)
        summary = fuzz(given.seed, indices, Path(folder), _tell)
    kinds = Counter(failure["what"][:60] for failure in summary.failures)
    sys.stdout.write(json.dumps({**vars(summary), "seed": given.seed, "kinds": dict(kinds)}, indent=1) + "\n")
    sys.exit(1 if summary.failures else 0)


if __name__ == "__main__":
    main()
