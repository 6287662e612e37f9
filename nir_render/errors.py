"""The errors that a user can mend: each says what is wrong, where, and how to mend it."""

import reprlib

_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 90
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxdict = 8
_BRIEF.maxlevel = 3


def shown(value: object) -> str:
    """Return what was written, in quotes where it is text, for a message: of long values both ends.

    >>> shown("940 nm")
    "'940 nm'"
    """
    return _BRIEF.repr(value)


class InputError(ValueError):
    """The input is wrong; the command exits with 2.

    `problems` holds one line per thing to mend.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class DiskFullError(InputError):
    """There is no room for a file; what else would be written would find none either."""
