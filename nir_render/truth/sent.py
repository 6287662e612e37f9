"""The record of what a source sent: a line of `sent.jsonl`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from nir_render.errors import InputError, shown


@dataclass(frozen=True)
class SentTruth:
    """One packet that a source sent: from its first start bit to the end of its last stop bit."""

    robot: str
    source: str
    start_s: float
    end_s: float
    word: int
    command: str

    def record(self) -> dict[str, Any]:
        """Return the line of `sent.jsonl`."""
        return {"format": 1, **asdict(self)}


_KINDS: dict[str, tuple[type, ...]] = {
    "robot": (str,), "source": (str,), "start_s": (int, float), "end_s": (int, float), "word": (int,),
    "command": (str,),
}  # fmt: skip


def parse_sent(record: Mapping[str, Any]) -> SentTruth:
    """Return what a line of `sent.jsonl` says; fields that it does not know are passed over.

    Raises
    ------
    InputError
        All fields that are missing or of another kind than they should be.
    """
    if not isinstance(record, Mapping):
        raise InputError(f"wanted an object with fields such as 'robot' and 'word', not {shown(record)}")
    problems = []
    for field in fields(SentTruth):
        value = record.get(field.name)
        if not isinstance(value, _KINDS[field.name]) or isinstance(value, bool):
            problems.append(f"{field.name} is {shown(value)}; wanted {_KINDS[field.name][-1].__name__}")
    if problems:
        raise InputError(*problems)
    return SentTruth(**{field.name: record[field.name] for field in fields(SentTruth)})
