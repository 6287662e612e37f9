"""Object storage that a campaign is kept in, `-o s3://bucket/place`: its folder's files, under their names.

An object is there whole or not at all, as one request puts it. So each file is put when it stands
whole on this machine's disk, and what is there can be gone on with from any other.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run.folder import write_file

_BETWEEN = "://"


def is_url(text: str) -> bool:
    """Tell whether a text names object storage and no folder."""
    return _BETWEEN in text


@dataclass(frozen=True)
class Store:
    """A place in object storage, by its URL; what fsspec knows of, such as s3://, gs:// or az://.

    Methods raise InputError, with the URL and what the storage says, where it cannot be reached or refuses.
    """

    url: str

    def names(self, folder: str = "") -> set[str]:
        """Return the names of the objects that lie in the place itself, or in a folder of it."""
        system, place = _opened(self.url)
        try:
            found = system.ls(f"{place}/{folder}".rstrip("/"), detail=False)
        except FileNotFoundError as error:
            self._check_bucket(system, place, error)
            return set()
        except Exception as error:
            raise self._error(error) from None
        return {str(one).rstrip("/").rpartition("/")[2] for one in found}

    def read(self, name: str) -> bytes | None:
        """Return what an object holds, None where it is not there."""
        system, place = _opened(self.url)
        try:
            data: bytes = system.cat_file(f"{place}/{name}")
        except FileNotFoundError:
            return None
        except Exception as error:
            raise self._error(error) from None
        return data

    def put(self, file: Path, name: str) -> None:
        """Put a file that stands on the disk, in the place of what is called so."""
        system, place = _opened(self.url)
        try:
            system.pipe_file(f"{place}/{name}", file.read_bytes())
        except Exception as error:
            raise self._error(error) from None

    def fetch(self, name: str, file: Path) -> None:
        """Write an object to a file, aside, synced and renamed; nothing where it is not there."""
        data = self.read(name)
        if data is not None:
            write_file(file, data)

    def _check_bucket(self, system: Any, place: str, error: Exception) -> None:
        """Raise where it is the bucket that is not there; a place in it need not be."""
        try:
            there = system.exists(place.partition("/")[0])
        except Exception as other:
            raise self._error(other) from None
        if not there:
            raise self._error(error)

    def _error(self, error: Exception) -> InputError:
        said = " ".join(str(error).split()) or type(error).__name__
        return InputError(
            f"{self.url}: {said}; check the bucket's name, the network, and the credentials that fsspec finds"
        )


@cache
def _opened(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the place in it."""
    import fsspec

    try:
        # Others put objects meanwhile: no listing is kept.
        system, place = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        missing = "s3fs is not installed; pip install 'nir_render[s3]'"
        raise InputError(f"{url}: {missing if url.startswith('s3') else error}") from None
    except ValueError as error:
        raise InputError(f"{url}: {error}") from None
    return system, str(place).rstrip("/")
