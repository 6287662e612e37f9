"""How docstrings and signatures are shown: indented blocks as they stand, types of arrays in short."""

import re
from typing import Any

from sphinx.application import Sphinx

_BEFORE_NAPOLEON = 400
_ARRAY = re.compile(r"~?numpy\.ndarray\[tuple\[~?typing\.Any, \.\.\.\], ~?numpy\.dtype\[~?numpy\.(\w+)\]\]")


def _show_as_it_stands(
    _app: Sphinx, _what: str, _name: str, _thing: Any, _options: Any, lines: list[str]
) -> None:
    """Put the mark of a literal block before indented blocks above the sections of a docstring, in place."""
    underlined = (at for at, line in enumerate(lines) if line.strip() and not line.strip("-"))
    end = next(underlined, len(lines))
    for at in range(end - 1, 1, -1):
        begins = lines[at].startswith("    ") and not lines[at - 1].strip()
        above = next((line for line in reversed(lines[:at]) if line.strip()), "")
        if begins and not above.startswith((" ", "- ", "* ")) and not above.endswith("::"):
            lines[at:at] = ["::", ""]


def _in_short(
    _app: Sphinx,
    _what: str,
    _name: str,
    _thing: Any,
    _options: Any,
    arguments: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Write the types of arrays as the code does, NDArray[float64]."""
    return _short(arguments), _short(returned)


def _short(text: str | None) -> str | None:
    return text and _ARRAY.sub(r"NDArray[\1]", text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Change docstrings as autodoc reads them."""
    app.connect("autodoc-process-docstring", _show_as_it_stands, priority=_BEFORE_NAPOLEON)
    app.connect("autodoc-process-signature", _in_short)
    return {"parallel_read_safe": True}
