"""How LLVM is installed: the command for this machine, that nothing asks, and what is advised."""

from collections.abc import Sequence

import pytest

from nir_render.transport.backend.llvm.install import NO_APT, Apt, advice, apt_command, install

FORCED = "DRJIT_LIBLLVM_PATH"


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
