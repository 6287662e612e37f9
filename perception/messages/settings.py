"""What a receiver takes for granted, and when it speaks."""

from dataclasses import dataclass

from perception.messages.uart import RATE_HZ, REPEATS, WORDS


@dataclass(frozen=True)
class DecoderSettings:
    """How messages are sent, and how sure the decoder must be.

    Attributes
    ----------
    rate_hz
        Nominal bits per second.
    repeats
        Identical frames in a packet.
    words
        The words that may be sent, each with the same probability: all of them, the sixteen commands
        (`range(16)`), or Hamming words.
    drift
        The senders' clocks are this far off at most, as a share.
    confidence
        A message is given out where the probability of its word is at least this.
    packets_per_s
        How often packets are expected to start; a little more or less matters little.
    level_sigma, lit_floor, dark_floor
        Standard deviation of the one factor on a signal's levels before it was seen; what its lit and its
        dark levels are off beyond the noise that they claim (it adds to it by squares).
    """

    rate_hz: float = RATE_HZ
    repeats: int = REPEATS
    words: tuple[int, ...] = tuple(range(WORDS))
    drift: float = 0.015
    confidence: float = 0.999
    packets_per_s: float = 0.1
    level_sigma: float = 0.1
    lit_floor: float = 0.05
    dark_floor: float = 0.02

    def __post_init__(self) -> None:
        """Refuse what cannot be decoded with."""
        if not self.words or not set(self.words) <= set(range(WORDS)):
            raise ValueError(f"words: wanted some of 0 to {WORDS - 1}, got {self.words!r}")
        if self.rate_hz <= 0.0 or self.repeats < 1 or not 0.0 <= self.drift < 0.05:
            raise ValueError("wanted a rate above 0, one repeat or more, and a drift of 0 to below 0.05")
