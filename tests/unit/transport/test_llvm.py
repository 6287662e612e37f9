"""The choice of LLVM: which library is tried when, what is remembered, and what a probe may answer."""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from nir_render.transport.llvm import Choice, choose
from nir_render.transport.llvm.choice import cache_file, cpu_name
from nir_render.transport.llvm.install import NO_APT, Apt, advice, apt_command, install
from nir_render.transport.llvm.libraries import find_libraries, usual_folders
from nir_render.transport.llvm.probe import Answer, probe

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


@pytest.mark.parametrize(
    ("system", "environ", "expected"),
    [
        ("linux", {"XDG_CACHE_HOME": "/x"}, Path("/x/nir_render/llvm.json")),
        ("linux", {"XDG_CACHE_HOME": "relative"}, Path("/home/u/.cache/nir_render/llvm.json")),
        ("linux", {}, Path("/home/u/.cache/nir_render/llvm.json")),
        ("darwin", {"XDG_CACHE_HOME": "/x"}, Path("/home/u/Library/Caches/nir_render/llvm.json")),
        ("win32", {"LOCALAPPDATA": "/local"}, Path("/local/nir_render/llvm.json")),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="the paths are written as POSIX has them")
def test_cache_file(
    system: str, environ: dict[str, str], expected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/u")
    assert cache_file(environ, system) == expected


def test_cpu_name_tells_processors_apart_by_their_instruction_sets(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    text = "processor : 0\nmodel name : Acme 1\ncpu MHz : {}\nflags : fpu {}\n\nprocessor : 1\n"
    names = []
    for mhz, flag in (("1000", "avx2"), ("2000", "avx2"), ("1000", "avx512f")):
        cpuinfo.write_text(text.format(mhz, flag))
        names.append(cpu_name(cpuinfo))
    assert names[0] == names[1] != names[2]
    assert names[0].endswith("Acme 1 fpu avx2")


# Where libraries lie


def test_libraries_19_first_then_newest_each_once(tmp_path: Path) -> None:
    """Names as distributions and Homebrew give them; a link, a static part and other files do not count."""
    inside = {
        "lib": ("libLLVM-14.so.1", "libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM.so.20.1", "libLLVM-9.so"),
        "llvm@21/lib": ("libLLVM.dylib",),
        "Cellar/llvm/22.1.0/lib": ("libLLVM.dylib",),
        "bin": ("LLVM-C.dll",),
    }
    for folder, names in inside.items():
        (tmp_path / folder).mkdir(parents=True)
        for name in (*names, "libLLVMSupport.a", "libLLVM-C.txt"):
            (tmp_path / folder / name).touch()
    (tmp_path / "lib" / "libLLVM.so").symlink_to("libLLVM.so.20.1")
    in_loader_cache = tmp_path / "elsewhere" / "libLLVM-17.so.1"
    in_loader_cache.parent.mkdir()
    in_loader_cache.touch()
    loader_cache = tmp_path / "ld.so.cache"
    listed = [in_loader_cache, tmp_path / "lib" / "libLLVM.so.18.1", tmp_path / "gone" / "libLLVM-16.so.1"]
    loader_cache.write_bytes(b"head\0" + b"\0".join(str(n).encode() for n in listed) + b"\0libLLVM.so\0")

    patterns = [f"{tmp_path}/{folder}" for folder in ("lib", "llvm*/lib", "Cellar/llvm/*/lib", "bin", "none")]
    found = find_libraries(folders=patterns, loader_cache=loader_cache)

    assert [path.relative_to(tmp_path).as_posix() for path in found] == [
        "lib/libLLVM.so.19.1",
        "Cellar/llvm/22.1.0/lib/libLLVM.dylib",
        "llvm@21/lib/libLLVM.dylib",
        "lib/libLLVM.so.20.1",
        "lib/libLLVM.so.18.1",
        "elsewhere/libLLVM-17.so.1",
        "lib/libLLVM-14.so.1",
        "lib/libLLVM-9.so",
        "bin/LLVM-C.dll",
    ]


def test_the_loaders_search_path_is_searched(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    environ = {"LD_LIBRARY_PATH": f"/nowhere:{tmp_path}"}
    assert (tmp_path / "libLLVM.so.19.1") in find_libraries(environ=environ, system="linux")


@pytest.mark.parametrize(
    ("system", "part"),
    [("linux", "/usr/lib/llvm*/lib"), ("darwin", "/opt/homebrew/opt/llvm*/lib"), ("win32", "P/LLVM/bin")],
)
def test_usual_folders_of_each_system(system: str, part: str) -> None:
    assert part in usual_folders({"PROGRAMFILES": "P", "PATH": "a;b"}, system)


# The probe


def say(text: str) -> list[str]:
    return [sys.executable, "-c", text]


def result(**changes: object) -> list[str]:
    fields = {"deviation": 0.001, "version": "19.1.7", "loaded": "/l.so"} | changes
    return say(f"import json; print('noise'); print({json.dumps(fields)!r})")


def test_a_probe_that_renders_rightly() -> None:
    answer = probe(Path("/l.so"), command=result())
    assert answer == Answer("/l.so", True, version="19.1.7", loaded="/l.so")


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (result(deviation=0.006), "wrong radiance, off by 0.006"),
        (result(deviation=float("nan")), "wrong radiance, off by nan"),
        (say("print('not JSON')"), "no result"),
        (say("print('[1]')"), "no result"),
        (say("pass"), "no result"),
        (say("import sys; sys.exit('could not be loaded')"), "could not be loaded"),
        (say("import time; time.sleep(60)"), "no answer within 0.5 s"),
    ],
)
def test_a_probe_that_fails_says_why(command: list[str], reason: str) -> None:
    limit_s = 0.5 if "sleep" in command[-1] else 60.0
    answer = probe(None, command=command, time_limit_s=limit_s)
    assert not answer.usable
    assert reason in answer.reason
    assert answer.lasting


@pytest.mark.skipif(sys.platform == "win32", reason="signals end processes only on POSIX")
def test_an_abort_is_an_answer_and_a_kill_is_not() -> None:
    script = "\n".join(
        [
            "import os, sys",
            "line = 'LLVM ERROR: Cannot select: 0x5581c3b7d9f0: f32 = fminimum 0x5581c3b9ea10'",
            "print(line, 'In function: f', sep=chr(10), file=sys.stderr, flush=True)",
            "os.kill(os.getpid(), {})",
        ]
    )
    aborted = probe(None, command=say(script.format(6)))
    assert aborted.reason == "the process ended by SIGABRT: LLVM ERROR: Cannot select: f32 = fminimum"
    assert aborted.lasting
    killed = probe(None, command=say(script.format(9)))
    assert not killed.usable
    assert not killed.lasting


def test_a_probe_that_cannot_be_started_is_no_lasting_answer(tmp_path: Path) -> None:
    answer = probe(None, command=[str(tmp_path / "no such program")])
    assert "could not be started" in answer.reason
    assert not answer.lasting


@pytest.mark.parametrize(("library", "expected"), [(None, "None"), (Path("/l.so"), "/l.so")])
def test_the_probe_sees_only_the_library_that_it_was_asked_for(library: Path | None, expected: str) -> None:
    command = say(f"import os, sys; sys.exit(str(os.environ.get('{FORCED}')) + ' ' + os.environ['HOME'])")
    answer = probe(library, environ={FORCED: "/users.so", "HOME": "/home/u"}, command=command)
    assert answer.reason.split(" ")[0] == expected
    assert "/home/u" not in answer.reason  # where Dr.Jit keeps kernels that another LLVM has compiled


@pytest.mark.mitsuba
def test_a_real_probe_of_nonsense_fails_with_a_reason(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    nonsense = tmp_path / "libLLVM.so.19.1"
    nonsense.write_text("not a library")
    answer = probe(nonsense)
    assert not answer.usable
    assert answer.reason


@pytest.mark.mitsuba
def test_a_real_choice_renders_the_closed_form(tmp_path: Path) -> None:
    """Whatever is chosen on this machine passes the probe; the probe holds it to 0.5 %."""
    pytest.importorskip("mitsuba")
    choice = choose(cache=tmp_path / "llvm.json")
    if not choice.usable:
        pytest.skip(f"no usable LLVM here: {[answer.reason for answer in choice.tried]}")
    assert int(choice.version.split(".")[0]) >= 15
    assert choose(ask=Prober(), cache=tmp_path / "llvm.json") == choice


# Installation


@pytest.mark.parametrize(
    ("tools", "is_root", "sudo_status", "expected"),
    [
        ({"apt-get"}, True, 1, Apt("apt-get update && apt-get install -y libllvm19", ())),
        (
            {"apt-get", "sudo"},
            False,
            0,
            Apt("sudo apt-get update && sudo apt-get install -y libllvm19", ("sudo", "-n")),
        ),
        (
            {"apt-get", "sudo"},
            False,
            1,
            Apt("sudo apt-get update && sudo apt-get install -y libllvm19", None),
        ),
        ({"apt-get"}, False, 0, Apt("sudo apt-get update && sudo apt-get install -y libllvm19", None)),
        ({"sudo"}, True, 0, Apt("", None)),
    ],
    ids=["root", "passwordless sudo", "sudo with password", "no sudo", "no apt"],
)
def test_apt_command(tools: set[str], is_root: bool, sudo_status: int, expected: Apt) -> None:
    ran: list[Sequence[str]] = []

    def run(command: Sequence[str]) -> tuple[int, str]:
        ran.append(command)
        return sudo_status, ""

    assert apt_command(which=lambda t: t if t in tools else None, is_root=is_root, run=run) == expected
    assert all(command == ["sudo", "-n", "true"] for command in ran)


@pytest.mark.parametrize("prefix", [(), ("sudo", "-n")])
def test_install_updates_first_and_never_asks(prefix: tuple[str, ...]) -> None:
    ran: list[Sequence[str]] = []

    def run(command: Sequence[str]) -> tuple[int, str]:
        ran.append(command)
        return (100, "one source is away") if "update" in command else (0, "")

    assert install(Apt("…", prefix), run=run) == ""
    update, package = ran
    assert "update" in update
    assert "libllvm19" in package
    assert "-y" in package
    for command in ran:
        assert tuple(command[: len(prefix)]) == prefix
        assert "DEBIAN_FRONTEND=noninteractive" in command


def test_install_says_why_it_failed() -> None:
    problem = install(Apt("…", ()), run=lambda _: (100, "Reading…\nE: Unable to locate package libllvm19\n"))
    assert problem == "E: Unable to locate package libllvm19"


def test_install_is_refused_where_apt_would_ask() -> None:
    with pytest.raises(ValueError, match="by hand: sudo apt-get"):
        install(Apt("sudo apt-get install x", None), run=lambda _: pytest.fail("nothing may run"))


@pytest.mark.parametrize(
    ("apt", "tools", "expected"),
    [
        (Apt("sudo apt-get x", None), {"brew"}, "sudo apt-get x"),
        (NO_APT, {"brew"}, "brew install llvm@19"),
        (NO_APT, {"dnf"}, "sudo dnf install llvm19-libs"),
        (NO_APT, set(), f"install LLVM 19 or newer and set {FORCED} to the path of its library"),
    ],
)
def test_advice(apt: Apt, tools: set[str], expected: str) -> None:
    assert advice(apt, which=lambda tool: tool if tool in tools else None) == expected
