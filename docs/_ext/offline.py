"""The site opens without a network: no page loads anything from elsewhere, though links may lead there."""

import re
from html.parser import HTMLParser
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

_LOADS = {"src", "srcset", "poster", "data", "action", "background", "xlink:href"}
_REMOTE = re.compile(r"\s*(?:https?:)?//", re.IGNORECASE)
_REMOTE_IN_STYLE = re.compile(r"(?:url\(\s*['\"]?|@import\s+['\"]?)((?:https?:)?//[^)'\"\s]*)", re.IGNORECASE)
_REMOTE_IN_SCRIPT = re.compile(r"(?:fetch|import|importScripts)\(\s*['\"`]((?:https?:)?//[^'\"`]*)")


class _Loads(HTMLParser):
    """Collect what a page loads from another machine when it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.remote: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            loads = name in _LOADS or (name == "href" and tag in {"link", "image", "use"})
            if loads and value and _REMOTE.match(value):
                self.remote.append(value)
            if name == "style" and value:
                self.remote += _REMOTE_IN_STYLE.findall(value)


def remote_loads(folder: Path) -> list[str]:
    """Return, as `file: address`, all that a site's pages, styles and scripts load from elsewhere."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix not in {".html", ".css", ".svg", ".js"}:
            continue
        text = path.read_text(encoding="utf-8")
        remote = (_REMOTE_IN_SCRIPT if path.suffix == ".js" else _REMOTE_IN_STYLE).findall(text)
        if path.suffix in {".html", ".svg"}:
            page = _Loads()
            page.feed(text)
            remote += page.remote
        found += [f"{path.relative_to(folder)}: {address}" for address in remote]
    return found


def _check(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html" and (found := remote_loads(Path(app.outdir))):
        raise ExtensionError("the site loads from the network:\n" + "\n".join(found))


def setup(app: Sphinx) -> dict[str, bool]:
    """Check the site when it is built."""
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True}
