"""The choice of LLVM: which library is tried when, and what is remembered."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from nir_render.transport.backend.llvm import Choice, choose
from nir_render.transport.backend.llvm.choice import cpu_name
from nir_render.transport.backend.llvm.probe import Answer

FORCED = "DRJIT_LIBLLVM_PATH"


class Prober:
    """Stands in for `probe`: knows which libraries work and notes which were asked for."""

    def __init__(self, *working: Path | None) -> None:
        self.working = working
        self.asked: list[Path | None] = []

    def __call__(self, library: Path | None) -> Answer:
        self.asked.append(library)
        name = "" if library is None else str(library)
        if library in self.working:
            return Answer(name, True, version="19.1.7", loaded=name or "own.so")
        return Answer(name, False, reason="aborted")


class Machine:
    """A machine with libraries of its own, whose choice is asked for again and again."""

    def __init__(self, folder: Path, versions: Sequence[int] = (19, 22)) -> None:
        self.folder = folder
        self.cache = folder / "cache" / "llvm.json"
        self.environ: dict[str, str] = {}
        self.cpu = "a processor"
        self.packages = "mitsuba 3.9.1, drjit 1.5.0"
        self.libraries = [self.add(version) for version in versions]

    def add(self, version: int) -> Path:
        library = self.folder / f"libLLVM.so.{version}.1"
        library.write_text(f"LLVM {version}")
        return library

    def choose(self, ask: Callable[[Path | None], Answer]) -> Choice:
        return choose(
            find=lambda: self.libraries,
            ask=ask,
            environ=self.environ,
            cache=self.cache,
            cpu=self.cpu,
            packages=self.packages,
        )


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


# The order of candidates


def test_own_choice_that_works_is_left_alone(machine: Machine) -> None:
    prober = Prober(None)
    choice = machine.choose(prober)
    assert choice == Choice(None, True, "19.1.7", "own.so", "Dr.Jit's own choice")
    assert prober.asked == [None]


def test_libraries_are_tried_in_their_order_after_the_own_choice_failed(machine: Machine) -> None:
    first, second = machine.libraries
    prober = Prober(second)
    choice = machine.choose(prober)
    assert (choice.library, choice.usable, choice.how) == (second, True, "found on this machine")
    assert prober.asked == [None, first, second]
    assert [(a.library, a.reason) for a in choice.tried] == [("", "aborted"), (str(first), "aborted")]


def test_nothing_works(machine: Machine) -> None:
    choice = machine.choose(Prober())
    assert not choice.usable
    assert choice.library is None
    assert len(choice.tried) == 3


def test_the_users_wish_comes_first_and_dr_jits_own_choice_is_not_asked(machine: Machine) -> None:
    first, second = machine.libraries
    machine.environ[FORCED] = str(second)
    prober = Prober(first, second, None)
    choice = machine.choose(prober)
    assert (choice.library, choice.how) == (second, f"named by {FORCED}")
    assert prober.asked == [second]


def test_a_wish_that_fails_is_tried_once_and_gives_way(machine: Machine) -> None:
    first, second = machine.libraries
    machine.environ[FORCED] = str(second)
    prober = Prober(first)
    assert machine.choose(prober).library == first
    assert prober.asked == [second, first]


def test_a_relative_wish_is_made_absolute(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(machine.folder)
    machine.environ[FORCED] = machine.libraries[0].name
    assert machine.choose(Prober(machine.libraries[0])).library == machine.libraries[0]


def test_a_bare_name_is_left_to_the_loader(machine: Machine) -> None:
    machine.environ[FORCED] = "libLLVM.so.99"
    assert machine.choose(Prober(Path("libLLVM.so.99"))).library == Path("libLLVM.so.99")


def test_without_mitsuba_nothing_is_probed(machine: Machine) -> None:
    machine.packages = ""
    prober = Prober(None)
    choice = machine.choose(prober)
    assert (choice.usable, choice.how) == (False, "Mitsuba is not installed")
    assert prober.asked == []


# What is remembered


def test_a_second_choice_probes_nothing_and_remembers_failures_too(machine: Machine) -> None:
    first = machine.choose(Prober(machine.libraries[1]))
    again = Prober()
    assert machine.choose(again) == first
    assert again.asked == []


@pytest.mark.parametrize("change", ["cpu", "packages"])
def test_another_processor_or_package_asks_all_anew(machine: Machine, change: str) -> None:
    machine.choose(Prober(machine.libraries[0]))
    setattr(machine, change, "another")
    prober = Prober(machine.libraries[0])
    machine.choose(prober)
    assert prober.asked == [None, machine.libraries[0]]


def test_a_library_that_was_replaced_is_asked_anew(machine: Machine) -> None:
    first, second = machine.libraries
    machine.choose(Prober(first))
    first.write_text("LLVM 19, a newer build")
    prober = Prober(second)
    assert machine.choose(prober).library == second
    assert prober.asked == [None, first, second]  # Dr.Jit might now pick the new file


def test_a_new_library_leaves_the_answers_of_the_others(machine: Machine) -> None:
    machine.choose(Prober())
    machine.libraries.append(machine.add(23))
    prober = Prober(machine.libraries[2])
    assert machine.choose(prober).library == machine.libraries[2]
    assert prober.asked == [None, machine.libraries[2]]


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"answers": []}', '{"answers": {"k": {"colour": 1}}}', "\x00\xff"]
)
def test_a_broken_memory_is_no_memory_and_is_mended(machine: Machine, content: str) -> None:
    machine.cache.parent.mkdir()
    machine.cache.write_text(content, encoding="latin-1")
    prober = Prober(None)
    machine.choose(prober)
    assert prober.asked == [None]
    assert machine.choose(again := Prober()).usable
    assert again.asked == []
    assert list(machine.cache.parent.iterdir()) == [machine.cache]  # nothing half-written is left


def test_a_memory_that_cannot_be_written_costs_only_the_probe(machine: Machine) -> None:
    machine.cache.parent.write_text("a file where the folder should be")
    assert machine.choose(Prober(None)).usable
    assert machine.choose(Prober(None)).usable


def test_an_answer_that_may_change_is_not_remembered(machine: Machine) -> None:
    killed = Answer("", False, reason="killed", lasting=False)
    machine.libraries = []
    assert not machine.choose(lambda _: killed).usable
    assert machine.choose(Prober(None)).usable


def test_cpu_name_tells_processors_apart_by_their_instruction_sets(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    text = "processor : 0\nmodel name : Acme 1\ncpu MHz : {}\nflags : fpu {}\n\nprocessor : 1\n"
    names = []
    for mhz, flag in (("1000", "avx2"), ("2000", "avx2"), ("1000", "avx512f")):
        cpuinfo.write_text(text.format(mhz, flag))
        names.append(cpu_name(cpuinfo))
    assert names[0] == names[1] != names[2]
    assert names[0].endswith("Acme 1 fpu avx2")


@pytest.mark.mitsuba
def test_a_real_choice_renders_the_closed_form(tmp_path: Path) -> None:
    """Whatever is chosen on this machine passes the probe; the probe holds it to 0.5 %."""
    pytest.importorskip("mitsuba")
    choice = choose(cache=tmp_path / "llvm.json")
    if not choice.usable:
        pytest.skip(f"no usable LLVM here: {[answer.reason for answer in choice.tried]}")
    assert int(choice.version.split(".")[0]) >= 15
    assert choose(ask=Prober(), cache=tmp_path / "llvm.json") == choice
