"""Fingerprints of what computes: hashes of source files, versions of packages."""

import hashlib
import importlib.metadata
from collections.abc import Iterable
from pathlib import Path


def code_hash(*rooted: tuple[Path, Iterable[Path]]) -> str:
    """Return the SHA-256 of source files, 64 hexadecimal digits.

    Parameters
    ----------
    rooted
        A folder and files in it, in the order in which they count: each file counts by its name as seen from
        the folder, and by what it holds.
    """
    hashed = hashlib.sha256()
    for root, files in rooted:
        for file in files:
            hashed.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return hashed.hexdigest()


def matching(root: Path, patterns: Iterable[str]) -> tuple[Path, list[Path]]:
    """Return a folder, and the files below it that match any of some patterns, as `code_hash` takes them."""
    return root, sorted(file for pattern in patterns for file in root.glob(pattern))


def package_versions(*packages: str) -> dict[str, str]:
    """Return the versions of installed packages, by name; "not installed" of others.

    OpenCV is one of these where it comes under another of its names.
    """
    return {package: _version(package) for package in packages}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
