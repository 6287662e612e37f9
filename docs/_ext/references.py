"""The pages that are made from the program itself: keys of scene files and campaigns, and the command.

They are written into `reference/` before the site is read, so that they cannot tell of another version.
"""

from pathlib import Path

import command_pages
import key_pages
from sphinx.application import Sphinx

FOLDER = "reference"


def _write(app: Sphinx) -> None:
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(exist_ok=True)
    pages = {
        "scene_keys.md": key_pages.scene_page(),
        "campaign_keys.md": key_pages.campaign_page(),
        "command.md": command_pages.page(),
    }
    for name, text in pages.items():
        path = folder / name
        # What is unchanged is not read again.
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages when the builder starts."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True}
