"""Two sources in one place of the image: both packets, from the sum of their light."""

import numpy as np
from numpy.typing import NDArray

from perception.messages.pair_search import PairSearch
from perception.messages.samples import usable_samples
from perception.messages.settings import DecoderSettings
from perception.messages.uart import FRAME_BITS, meaning
from perception.types import Message, Signal

Array = NDArray[np.float64]

WHO_ODDS = 1e3
"""Odds from which it is said who said which."""
_INTRUDED = 14.0  # log-likelihood of any levels over a packet's in a stretch of it, from which it is refused
_MODULATED = 15.0  # log-likelihood that a packet must bring over light that only drifts
_FEWEST_FRAMES = 2  # one frame alone is also what a source looks like that is hidden for a second


def decode_pair(
    signal: Signal,
    amplitudes: tuple[float, float] | Array,
    amplitude_sigmas: tuple[float, float],
    tracks: tuple[int, int],
    settings: DecoderSettings | None = None,
) -> tuple[Message, ...]:
    """Return what two sources say whose light falls in one place, at most one packet each.

    Parameters
    ----------
    signal
        Of the sum of both. `sigma_dark` where both are dark, `sigma_lit` at a level of 1.
    amplitudes
        The levels of each alone, in the units of the signal, by ranges and fluxes before the two merged: two
        numbers, or shape (2, samples) where they change as the sources move. A factor of each is fitted.
    amplitude_sigmas
        How well those factors are known, times the mean amplitudes.
    tracks
        The numbers of their tracks. Where who said which is less than a thousand times as probable as the
        other way round, each message is `ambiguous_with` the other track.

    Returns
    -------
    What was read, at most one packet of each. A packet of which fewer than two frames were seen is none, nor
    is one in which any levels explain a stretch of samples better (a source may have been hidden meanwhile),
    or that light which only drifts explains as well (predictions of tracks that are not seen alone do).
    """
    settings = DecoderSettings() if settings is None else settings
    columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
    samples = usable_samples(*columns, settings)
    if not len(samples):
        return ()
    each = np.broadcast_to(np.array(amplitudes).T, (len(signal.time_s), 2)).T
    each = each[:, np.isin(signal.time_s, samples.time_s)]
    mean = each.mean(axis=1)
    search = PairSearch(samples, mean, np.array(amplitude_sigmas), each / mean[:, None], settings)
    best = search.best()
    if best is None:
        return ()
    sure = search.log_odds_of_who(best) >= np.log(WHO_ODDS)
    messages = []
    for number, packet in enumerate(best.packets):
        if packet is None or best.confidence[number] < settings.confidence:
            continue
        start_s, bit_s = search.times_s(packet)
        seen = search.frames_seen(packet)
        if len(seen) < _FEWEST_FRAMES or search.intrusion(best, packet) > _INTRUDED:
            continue
        if search.modulation(best, number) < _MODULATED:
            continue
        messages.append(
            Message(
                robot=signal.robot,
                track=tracks[number],
                start_s=start_s + FRAME_BITS * bit_s * int(seen[0]),
                end_s=start_s + FRAME_BITS * bit_s * (int(seen[-1]) + 1),
                word=packet.word,
                command=meaning(packet.word),
                confidence=best.confidence[number],
                frames=len(seen),
                ambiguous_with=None if sure else tracks[1 - number],
            )
        )
    return tuple(messages)
