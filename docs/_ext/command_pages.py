"""The reference of the command, read off the program that parses it."""

from collections.abc import Iterator
from typing import Any

import typer

from nir_render.command.main import app

_TOP = """# The command

`nir-render COMMAND --help` says the same on the terminal. Exit status: 0 done, 1 the work failed or a check
did not hold, 2 the input was wrong. Every long job shows its progress; with `--json` one JSON object goes to
standard output and nothing else does.

"""
# What an option without a word of its own takes.
_WORDS = {"int": "N", "float": "X", "str": "TEXT", "Path": "PATH"}


def page() -> str:
    """Return the page, Markdown: a section for each command with its arguments and options."""
    return _TOP + "\n".join(_sections(typer.main.get_command(app), "nir-render", 2))


# Typer's own commands or click's, by its version: both have these attributes, and no class in common.
def _sections(group: Any, path: str, level: int) -> Iterator[str]:
    for name, command in group.commands.items():
        if command.hidden:
            continue
        whole = f"{path} {name}"
        yield f"{'#' * level} `{whole}`\n\n{_text(command.help)}\n"
        if hasattr(command, "commands"):
            yield from _sections(command, whole, level + 1)
        else:
            yield _usage(command, whole)


def _usage(command: Any, path: str) -> str:
    parameters = [one for one in command.params if not getattr(one, "hidden", False) and one.name != "help"]
    arguments = [one for one in parameters if not one.opts[0].startswith("-")]
    words = [path, *(_argument(one) for one in arguments)]
    options = [one for one in parameters if one not in arguments]
    if options:
        words.append("[OPTIONS]")
    lines = [f"```text\n{' '.join(words)}\n```\n"]
    if parameters:
        lines += [":::{list-table}", ":class: options", ""]
    for one in arguments:
        lines += [f"* - `{_argument(one)}`", f"  - {_text(one.help)}"]
    for one in options:
        lines += [f"* - {_option(one)}", f"  - {_text(one.help)}{_default(one)}"]
    if parameters:
        lines.append(":::\n")
    return "\n".join(lines)


def _argument(parameter: Any) -> str:
    word = parameter.metavar or parameter.name.upper()
    dots = "…" if parameter.nargs != 1 else ""
    return f"{word}{dots}" if parameter.required else f"[{word}{dots}]"


def _option(parameter: Any) -> str:
    names = ", ".join(f"`{name}`" for name in [*parameter.opts, *parameter.secondary_opts])
    if parameter.is_flag:
        return names
    described = getattr(parameter, "type_descriptor", None)
    kind = described.annotation.__name__ if described is not None else parameter.type.name
    return f"{names} {parameter.metavar or _WORDS.get(kind, kind.upper())}"


def _default(parameter: Any) -> str:
    shown = parameter.default not in (None, (), [], False)
    return f" Default: {parameter.default}." if shown and not parameter.is_flag else ""


def _text(text: str | None) -> str:
    return " ".join((text or "").split())
