"""What a probe of a library may answer: it renders rightly, fails, aborts, is killed, or never starts."""

import json
import sys
from pathlib import Path

import pytest

from nir_render.transport.backend.llvm.probe import Answer, probe

FORCED = "DRJIT_LIBLLVM_PATH"


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
