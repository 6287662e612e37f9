"""Models of clocks: when the scene takes frames, and how a camera's own clock departs from that."""

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from nir_render.scene.documents.base import (
    Angle,
    Document,
    Fraction,
    Frequency,
    Length,
    NotNegative,
    Positive,
    Time,
)
from nir_render.scene.text.units import TIME

JITTER_SIGMAS = 3.0


class CalibrationFrames(Document):
    """How many of the first frames are for calibration: `dark`, then `flat`, then `rail`, then `shared`.

    Dark ones are taken with the cap on: no light comes in, and automatic exposure waits. What the others
    show is the scene's business: an even surface that fills the field, one source at known ranges, sources
    that two cameras share.
    """

    example: ClassVar[str] = "{dark: 16, flat: 16, rail: 320}"

    dark: Annotated[int, Field(ge=0)] = 0
    flat: Annotated[int, Field(ge=0)] = 0
    rail: Annotated[int, Field(ge=0)] = 0
    shared: Annotated[int, Field(ge=0, exclude_if=lambda count: count == 0)] = 0

    @property
    def count(self) -> int:
        """How many there are."""
        return self.dark + self.flat + self.rail + self.shared

    def kind_of(self, index: int) -> str:
        """Return the kind of a frame, as `frames.jsonl` has it."""
        for kind in ("dark", "flat", "rail", "shared"):
            count = getattr(self, kind)
            if index < count:
                return kind
            index -= count
        return "scene"


class Clock(Document):
    """When frames are taken: `frames` of them, at most a million, at `frame_rate` from `start` on.

    `calibration` says what the first of them are for; the others, all by default, show the scene.
    """

    frames: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    frame_rate_hz: Annotated[Frequency, Positive] = 30.0
    start_s: Time = 0.0
    calibration: CalibrationFrames = CalibrationFrames()

    @model_validator(mode="after")
    def _frames_for_calibration(self) -> Self:
        if (count := self.calibration.count) > self.frames:
            raise ValueError(
                f"calibration: {count} frames for it are more than the {self.frames} that are taken; raise "
                "frames, or take fewer of them"
            )
        return self

    @model_validator(mode="after")
    def _ends(self) -> Self:
        end_s = self.start_s + (self.frames - 1) / self.frame_rate_hz
        if abs(end_s) > TIME.most:
            raise ValueError(
                f"the last frame is at {end_s:.4g} s, beyond the {TIME.most:g} s that are taken; raise "
                "frame_rate, or take fewer frames"
            )
        return self


class CameraClock(Document):
    """How a camera's frames depart from the scene's clock.

    Frame i is taken at start + `offset` + (1 + `drift`) i / frame rate + jitter; the jitter is drawn anew for
    each frame, normal of the standard deviation `jitter`, cut off at three of them. The share `dropped` of
    the frames is taken and lost: their indices are missing. The stamps of the others are the true times.
    """

    example: ClassVar[str] = "{offset: 2 ms, drift: 1e-4, jitter: 0.1 ms, dropped: 0.05}"

    offset_s: Time = 0.0
    drift: Annotated[Fraction, Field(ge=-0.1, le=0.1)] = 0.0
    jitter_s: Annotated[Time, NotNegative] = 0.0
    dropped: Annotated[Fraction, Field(ge=0, lt=1)] = 0.0


class OdometryNoise(Document):
    """How well a robot knows its own way: errors of each record by itself, and walks, per axis.

    A walk is the standard deviation of what adds up in one second; it grows by the root of time. They are
    errors of dead reckoning: a heading that is off bends what follows.
    """

    example: ClassVar[str] = "{position_walk: 1 cm, rotation_walk: 0.2 deg}"

    position_walk_m: Annotated[Length, NotNegative] = 0.0
    rotation_walk_rad: Annotated[Angle, NotNegative] = 0.0
    position_noise_m: Annotated[Length, NotNegative] = 0.0
    rotation_noise_rad: Annotated[Angle, NotNegative] = 0.0
