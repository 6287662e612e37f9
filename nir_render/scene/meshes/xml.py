"""XML as a tree of elements that know their lines, and the numbers in it."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from nir_render.scene.meshes.mesh import Array

_MOST_DEEP = 32
_LARGEST = 1e9
_CAMEL = re.compile(r"(?<=[a-z0-9])([A-Z])")


@dataclass(frozen=True, eq=False)
class Element:
    """An element of XML, where its text begins, and in which file's folders its names are looked for."""

    tag: str
    attributes: dict[str, str]
    line: int
    folders: tuple[Path, ...] = ()
    children: list["Element"] = field(default_factory=list)

    def named(self, name: str) -> "Element | None":
        """Return the child that gives a property, if there is one."""
        return next((one for one in self.children if snake(one.attributes.get("name", "")) == name), None)

    def wrong(self, text: str) -> ValueError:
        """Return an error that tells the line."""
        return ValueError(f"line {self.line}: {text}")


def tree_of(data: bytes) -> Element:
    """Return the root of XML."""
    parser = expat.ParserCreate()
    open_elements: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(open_elements) == _MOST_DEEP:
            raise ValueError(
                f"line {parser.CurrentLineNumber}: elements lie {_MOST_DEEP} deep; export the scene again"
            )
        element = Element(tag, attributes, parser.CurrentLineNumber)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_tag: str) -> None:
        open_elements.pop()

    def entity(*_declared: object) -> None:
        raise ValueError(f"line {parser.CurrentLineNumber}: declares an entity; write out what it stands for")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ValueError(
            f"line {error.lineno}: this is no XML: {expat.ErrorString(error.code)}; export the scene again"
        ) from None
    except LookupError as error:
        raise ValueError(f"line 1: {error}; save it as UTF-8") from None
    return roots[0]


def snake(name: str) -> str:
    """Return a name in camel case, as older versions write it, as newer ones do: toWorld is to_world."""
    return _CAMEL.sub(r"_\1", name).lower()


def vector_of(element: Element, default: float = 0.0) -> Array:
    """Return a vector, as x, y and z or as `value`, one number for all three or three."""
    own = element.attributes
    if "value" in own:
        numbers = numbers_of(element, own["value"])
        if numbers.size not in (1, 3):
            raise element.wrong(f"{own['value']!r} is no vector; write x, y and z")
        return np.broadcast_to(numbers, 3).astype(np.float64)
    return np.concatenate([numbers_of(element, own.get(axis, repr(default))) for axis in "xyz"])


def numbers_of(element: Element, text: str) -> Array:
    """Return the numbers of a text, shape (n,)."""
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        raise element.wrong(f"{text[:60]!r} is no number; write one") from None
    if not numbers.size or not (np.abs(numbers) <= _LARGEST).all():
        raise element.wrong(f"{text[:60]!r} is no number; write one of at most {_LARGEST:g}")
    return numbers
