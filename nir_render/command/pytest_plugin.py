"""pytest's door to regression suites: a fixture that fails a test where a suite has drifted.

Every run of pytest loads this where nir_render is installed, so it imports nothing of its own until it is
used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from nir_render.regress.findings import Check


class Suites:
    """Regression suites of a repository; folders count from where pytest's configuration is (`rootdir`)."""

    def __init__(self, root: Path, pages: Path) -> None:
        self._root, self._pages = root, pages

    def check(self, suite: str | Path, refs: str | Path | None = None, *, seed: int | None = None) -> "Check":
        """Hold a suite against its references; fail the test where something drifted, and say what.

        Parameters
        ----------
        suite
            A folder of scene files.
        refs
            The folder of references; without, `references` in the suite's folder.
        seed
            Of the light: another draw of the render's noise.

        Returns
        -------
        What was found, where nothing drifted.
        """
        from nir_render import regress
        from nir_render.errors import InputError
        from nir_render.regress.page import check_page
        from nir_render.run.folder import write_file

        folder = self._root / suite
        problems: tuple[str, ...] = ()
        try:
            result = regress.check(folder, None if refs is None else self._root / refs, seed=seed)
        except InputError as error:
            problems = error.problems
        if problems:  # not while the error is handled: pytest would show it twice
            pytest.fail("\n".join(problems), pytrace=False)
        if not result.holds:
            page = self._page(folder)
            page.parent.mkdir(parents=True, exist_ok=True)
            write_file(page, check_page(result).encode())
            pytest.fail(_drift_text(result, str(suite), page), pytrace=False)
        return result

    def _page(self, folder: Path) -> Path:
        """Return where the page of a suite goes: each folder has its own."""
        whole, root = folder.resolve(), self._root.resolve()
        inside = whole.is_relative_to(root) and whole != root
        within = whole.relative_to(root if inside else whole.anchor)
        return self._pages / within.parent / f"{within.name}.html"


@pytest.fixture(scope="session")
def regress(pytestconfig: pytest.Config) -> Suites:
    """Give regression suites: `regress.check("suite")` in a test."""
    # The cache may be switched off; its folder is still where no one commits anything.
    try:
        cache = pytestconfig.getini("cache_dir")
    except ValueError:  # with `-p no:cacheprovider` nobody knows of it
        cache = ".pytest_cache"
    return Suites(pytestconfig.rootpath, pytestconfig.rootpath / cache / "nir_render")


def _drift_text(result: "Check", suite: str, page: Path) -> str:
    """Say what of a suite has drifted, a line each, where it is shown, and how it would be accepted."""
    lines = [f"{suite} has drifted from its references:"]
    for scene in result.scenes:
        failed = [finding for finding in scene.findings if finding.verdict == "fail"]
        lines += [f"  {scene.name}: {one.stage}: {one.what}: {one.seen}" for one in failed]
        lines += [f"  {scene.name}: changed: {change}" for change in scene.changes if failed]
    lines += [f"  not as of the references: {change}" for change in result.versions]
    lines.append(f"open {page}")
    lines.append(f'if it is meant: nir-render regress update {suite} --reason "why"')
    return "\n".join(lines)
