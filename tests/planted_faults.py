"""Faults of the code, for who looks for them: the same scene and random numbers, another light."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from nir_render.scene.scene import Scene
from nir_render.transport import render
from nir_render.transport.cache_key import Site, geometry_key


@contextmanager
def random_numbers_of(clean: Scene) -> Iterator[None]:
    """Render whatever scene with the random numbers of another, which follow from what stands where."""

    def key(site: Site) -> str:
        return geometry_key(Site(clean.at(site.snapshot.time_s), site.name))

    with patch.object(render, "geometry_key", key):
        yield
