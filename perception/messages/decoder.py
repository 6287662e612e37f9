"""The maximum-likelihood decoder: whole packets over word, start and clock rate, with their probability.

A signal is a chain of idle stretches (lit) and packets; a hidden semi-Markov model. Each explanation of all
that was seen so far has a probability: packets at every start, on every clock rate, of every word, also those
that began before the signal did or go on after it, and stretches that are neither. A message's confidence is
the share of the explanations that hold it (forward recursion, and what is still under way). A rotated reading
of a packet that was joined midway shares its probability with the true one until idle was seen, and is not
given out. Packets into which another's light fell are read by what it left of them, a second later.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.messages.foreign import foreign_light
from perception.messages.lattice import STEPS_PER_BIT, Lattice, clocks_of, moved_on
from perception.messages.samples import ROWS, AnyLevels, LevelScale, add_samples, usable_samples
from perception.messages.settings import DecoderSettings
from perception.messages.uart import IDLE_BITS, could_be_rotated, meaning
from perception.types import Message, Signal

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
Numbers = NDArray[np.int64]

_BLOCK = 5 * STEPS_PER_BIT  # steps that are taken in at once
_MARGIN = 4  # steps that a sample's exposure may reach over its middle, and half a bit of decency
_LAST_CHANCE = (IDLE_BITS + 2) * STEPS_PER_BIT  # steps after its end until a packet must have been settled
_BACK = _LAST_CHANCE + 4 * _BLOCK  # steps that are kept before the longest packet
_WORTH_ASKING = 15.0  # log-likelihood over idle from which a packet is looked into
_GARBAGE = float(np.log(1e-3))  # log-probability that what starts is no packet
_LIKELY = 7.0  # a packet's clocks are those whose log-probability is not this far below the best one's
_CONTRADICTS = 25.0  # log-likelihood of another word in one frame: another's light fell in with its own
_INTRUDED = 14.0  # the same of any levels in a stretch of bits: an undisturbed packet shows it once in 2·10⁴
_JOINED = 30.0  # log-likelihood over any levels that a packet needs whose beginning was not seen
_NEGLIGIBLE = 35.0  # log-probability below another explanation from which one is left out
_STAGGER = 0.618034  # of a block, by which the next track's end sooner: so the work of each set is as even
_KEPT = 3  # packets that are looked into of those that end in a block
_NEIGHBOURS = 6  # steps to either side that count as the same packet
_BEHIND = 2 * _BLOCK  # steps after which it is clear where another's light fell in
_FORGET_S = 12.0  # a gap after which a signal starts anew
_BACKWARDS_S = 1.0  # a clock that jumps back by more starts anew; by less, its samples are left out


@dataclass(frozen=True)
class _Candidate:
    """A packet that may have been sent: its score with what came before, its start in steps, rate, word."""

    score: float
    start: int
    rate: int
    column: int


class Decoder:
    """Decodes one track's signal as it comes; what it remembers does not grow.

    Samples that are not later than the last are left out; a clock that jumps back by more than a second, or
    a gap of more than twelve, starts anew.
    """

    def __init__(self, robot: str, track: int, settings: DecoderSettings | None = None) -> None:
        self._again = True  # what another's light leaves of a packet is read by a decoder that asks no more
        self._robot, self._track = robot, track
        self._settings = DecoderSettings() if settings is None else settings
        self._clocks = clocks_of(self._settings)
        self._lead = int(_BLOCK * (_STAGGER * track % 1.0))  # steps of the first block before the signal
        self._begin_at = _BACK + self._clocks.longest  # the block's first step in the window
        self._complete = self._begin_at + _BLOCK - _MARGIN  # the last step of which all samples are in
        self._size = self._begin_at + _BLOCK + 2 * _MARGIN + self._clocks.longest
        step_rate = self._settings.packets_per_s * self._clocks.step_s
        self._log_start = float(np.log(step_rate / len(self._settings.words)))
        self._log_garbage = float(np.log(step_rate)) + _GARBAGE
        self._rotated = could_be_rotated(self._settings.words)
        self._restart()

    def _restart(self) -> None:
        self._waiting: list[Array] = []
        self._held: list[Array] = []  # the window's samples
        self._alone: Decoder | None = None
        self._touched_s = np.empty(0)  # when another's light may have fallen in
        self._last_s = -np.inf
        self._origin_s: float | None = None  # of step 0
        self._done = 0  # steps by which the window has moved on
        self._table = np.zeros((ROWS, self._size))
        self._scale = LevelScale(self._settings.level_sigma)
        self._any_levels = AnyLevels()
        # Before the signal: a packet may have been under way, begun at any step with the same probability.
        rates = len(self._clocks.drifts)
        self._before = np.full((rates, self._complete + 1), np.log(0.5 / self._clocks.longest))
        self._before -= np.log(self._settings.packets_per_s * self._clocks.step_s)
        self._idle = np.full(rates, np.log(0.5))
        self._looked = np.zeros(rates, bool)
        self._under_way = np.full((rates, self._clocks.longest), -np.inf)
        self._candidates: list[_Candidate] = []
        self._spoken_until = -np.inf

    def push(self, signal: Signal) -> tuple[Message, ...]:
        """Take in samples of the track, later than those before; return the messages that they complete."""
        columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
        rows = np.array(columns, float)
        if rows.shape[1] == 1 and 0.0 < rows[0, 0] - self._last_s <= _FORGET_S:
            return tuple(self._take(rows))  # as it is in a stream, and quicker
        since = rows[0] - np.append(self._last_s, rows[0, :-1])
        if ((since > 0.0) & (since <= _FORGET_S)).all():
            return tuple(self._take(rows))
        messages: list[Message] = []
        while rows.shape[1]:
            time_s = rows[0]
            later = time_s > np.maximum.accumulate(np.concatenate([[self._last_s], time_s[:-1]]))
            jump = np.diff(time_s, prepend=self._last_s if np.isfinite(self._last_s) else time_s[0])
            anew = np.flatnonzero((jump < -_BACKWARDS_S) | (jump > _FORGET_S))
            until = int(anew[0]) if len(anew) else rows.shape[1]
            messages += self._take(rows[:, :until][:, later[:until]])
            rows = rows[:, until:]
            if len(anew):
                messages += self.finish()
        return tuple(messages)

    def finish(self) -> tuple[Message, ...]:
        """Return what can be said of the samples still held, and forget the signal."""
        messages: list[Message] = []
        if self._origin_s is not None:
            messages += self._block()
            for _ in range(_LAST_CHANCE // _BLOCK + 1):
                messages += self._block()
            if self._alone is not None:
                messages += self._new(self._alone.finish())
        self._restart()
        return tuple(messages)

    def _take(self, rows: Array) -> list[Message]:
        if not rows.shape[1]:
            return []
        if self._origin_s is None:
            self._origin_s = float(rows[0, 0]) - (self._begin_at + self._lead) * self._clocks.step_s
        self._waiting.append(rows)
        self._last_s = float(rows[0, -1])
        messages: list[Message] = []
        while self._last_s >= self._step_s(self._begin_at + _BLOCK):
            messages += self._block()
        return messages

    def _step_s(self, step: float) -> float:
        """Return the time of a step of the window."""
        assert self._origin_s is not None
        return self._origin_s + (step + self._done) * self._clocks.step_s

    def _step_of(self, time_s: float) -> float:
        """Return the step of the window at a time."""
        return (time_s - self._step_s(0)) / self._clocks.step_s

    def _block(self) -> list[Message]:
        """Take in the samples of the next block, and say what is now clear."""
        self._learn()
        lattice = Lattice(self._table, self._clocks)
        self._recurse(lattice)
        alone = self._seen_alone() if self._again else np.empty((5, 0))
        messages = self._settle(lattice)
        if len(self._touched_s):
            messages += self._read_alone(alone)
        else:
            self._alone = None
        moved_on(self._table, _BLOCK)
        self._before[:, :-_BLOCK] = self._before[:, _BLOCK:]
        top = float(self._idle.max())  # only differences matter
        self._before -= top
        self._idle -= top
        self._candidates = [
            _Candidate(one.score - top, one.start, one.rate, one.column) for one in self._candidates
        ]
        self._done += _BLOCK
        return messages

    def _learn(self) -> None:
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting, axis=1)
        now = rows[0] < self._step_s(self._begin_at + _BLOCK)
        self._waiting = [] if now.all() else [rows[:, ~now]]
        held = [*self._held, rows[:, now]]
        self._held = [each for each in held if each.size and each[0, -1] > self._step_s(0)]
        time_s, exposure_s, level, dark, lit = rows[:, now]
        samples = usable_samples(time_s, exposure_s, level, dark, lit, self._settings)
        if len(samples):
            amplitude, alone = self._scale.learn(samples), np.zeros((1, len(samples)))
            origin_s, step_s = self._step_s(0), self._clocks.step_s
            add_samples(self._table, samples, amplitude, alone, origin_s, step_s, self._any_levels)

    def _recurse(self, lattice: Lattice) -> None:
        """Go on with the probability of idle at each step, and note the best packet that ends there."""
        ends = np.arange(self._complete - _BLOCK + 1, self._complete + 1)
        rates = np.repeat(np.arange(len(self._idle)), _BLOCK)
        starts = (ends - self._clocks.lengths[:, None]).ravel()
        before = self._before[rates, starts]
        garbage = self._log_garbage + lattice.garbage(starts, rates)
        ended = before + garbage
        if self._dark_in_reach():
            floor = np.maximum(garbage, self._idle[rates] - before) - self._log_start - _NEGLIGIBLE
            total, tops, columns = lattice.best_words(starts, rates, floor)
            ended = np.logaddexp(ended, before + self._log_start + total)
            self._note_best(tops, columns, before, starts, rates)
        ended = ended.reshape(-1, _BLOCK)
        idle = np.logaddexp.accumulate(np.concatenate([self._idle[:, None], ended], axis=1), axis=1)
        self._before[:, ends] = idle[:, 1:]
        self._idle = idle[:, -1].copy()

    def _dark_in_reach(self) -> bool:
        """Return whether anything was dark for as long as a packet: an idle source costs nothing."""
        first = self._complete - _BLOCK - self._clocks.longest
        return float(np.maximum(self._table[0, first:], 0.0).sum()) > _WORTH_ASKING

    def _note_best(
        self, tops: Array, columns: Numbers, before: Array, starts: Numbers, rates: Numbers
    ) -> None:
        """Keep the best packets that may have been sent, of neighbours the best."""
        worthy = (tops > _WORTH_ASKING) & (starts + self._done + _MARGIN >= self._spoken_until)
        score = np.where(worthy, tops + before, -np.inf)
        for _ in range(_KEPT):
            row = int(np.argmax(score))
            if score[row] == -np.inf:
                break
            start, column = int(starts[row]) + self._done, int(columns[row])
            found = _Candidate(float(score[row]), start, int(rates[row]), column)
            score[np.abs(starts - starts[row]) <= STEPS_PER_BIT] = -np.inf
            same = [
                one
                for one in self._candidates
                if one.column == column and abs(one.start - start) <= STEPS_PER_BIT
            ]
            if all(one.score < found.score for one in same):
                self._candidates = [one for one in self._candidates if one not in same] + [found]
        self._candidates = sorted(self._candidates, key=lambda one: -one.score)[: 2 * _KEPT]

    def _settle(self, lattice: Lattice) -> list[Message]:
        """Give out the packets that have become clear; forget those that had their chance."""
        messages: list[Message] = []
        kept: list[_Candidate] = []
        self._looked[:] = False
        self._under_way[:] = -np.inf
        for one in self._candidates:
            if one.start + _MARGIN < self._spoken_until:
                continue
            over = self._complete - (one.start - self._done + int(self._clocks.lengths[one.rate]))
            message = self._message(one, lattice) if over >= _MARGIN else None
            if message is not None:
                messages.append(message)
                self._spoken_until = one.start + float(self._clocks.lengths[one.rate])
            elif over <= _LAST_CHANCE:
                kept.append(one)
        self._candidates = kept
        return messages

    def _message(self, one: _Candidate, lattice: Lattice) -> Message | None:
        """Return a packet as a message if its probability is high enough."""
        here = one.start - self._done
        idle, end = int(self._clocks.idle[one.rate]), here + int(self._clocks.lengths[one.rate])
        if self._touched(here - idle, end + idle):  # beside it, too: by that a rotated word is known
            return None
        where = here, one.rate, one.column
        if lattice.contradiction(*where) > _CONTRADICTS or lattice.intrusion(*where) > _INTRUDED:
            return None
        if not self._phase_known(one, lattice):
            return None
        # A frame or two of another rate may look like a word; a packet seen to begin after idle does not.
        joined = here < self._begin_at - self._done
        if joined and lattice.over_anything(*where) < _JOINED:
            return None
        shift = np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
        # On other clocks the same packet is where the middle of what was seen of it stays.
        unseen = min(max(self._begin_at - self._done - here, 0), int(self._clocks.lengths[one.rate]))
        middle = 0.5 * (1.0 + unseen / self._clocks.lengths[one.rate])
        longer = self._clocks.lengths - self._clocks.lengths[one.rate]
        starts = (here + shift - np.rint(middle * longer).astype(np.int64)[:, None]).ravel()
        rates = np.repeat(np.arange(len(self._idle)), len(shift))
        over = starts + self._clocks.lengths[rates] <= self._complete
        starts, rates = starts[over], rates[over]
        ends = starts + self._clocks.lengths[rates]
        score = lattice.word(starts, rates, one.column)
        log = self._before[rates, starts] + score + self._log_start
        # What is under way on the packet's own clocks refuses most that is refused.
        own = np.zeros(len(self._idle), bool)
        own[rates[log > log.max() - _LIKELY]] = True
        for asked in (own, ~own):
            self._look_under_way(lattice, asked)
            confidence = self._share(log + self._after(rates, ends))
            if confidence < self._settings.confidence:
                return None
        log += self._after(rates, ends)
        weight = np.exp(log - log.max())
        begin, end = np.average(np.stack([starts, ends]), axis=1, weights=weight)
        seen = np.flatnonzero(lattice.frames_seen(here, one.rate))
        if not len(seen):
            return None
        frame = (end - begin) / self._settings.repeats
        word = self._settings.words[one.column]
        return Message(
            robot=self._robot,
            track=self._track,
            start_s=self._step_s(begin + frame * int(seen[0])),
            end_s=self._step_s(begin + frame * (int(seen[-1]) + 1)),
            word=word,
            command=meaning(word),
            confidence=confidence,
            frames=len(seen),
        )

    def _seen_alone(self) -> Array:
        """Return the samples held without those that another's light may have touched, and note these."""
        rows = np.concatenate(self._held, axis=1) if self._held else np.empty((5, 0))
        touched = foreign_light(rows, self._scale.value, self._settings)
        self._touched_s = rows[0, touched]
        return np.asarray(rows[:, ~touched])

    def _touched(self, start: float, end: float) -> bool:
        """Return whether another's light may have fallen in between two steps."""
        after = self._touched_s > self._step_s(start)
        return bool((after & (self._touched_s < self._step_s(end))).any())

    def _read_alone(self, rows: Array) -> list[Message]:
        """Return what packets into which another's light fell say by the rest of their samples.

        A decoder of its own reads them, two blocks behind: until then it is clear what was touched.
        """
        if self._alone is None:
            self._alone = Decoder(self._robot, self._track, self._settings)
            self._alone._again = False
        until_s = self._step_s(self._complete - _BEHIND)
        new = rows[:, (rows[0] > self._alone._last_s) & (rows[0] <= until_s)]
        return self._new(self._alone.push(Signal(self._robot, self._track, *new)))

    def _new(self, said: tuple[Message, ...]) -> list[Message]:
        """Return messages of packets that were touched, and not said."""
        messages = []
        for message in said:
            first, end = (self._step_of(at_s) for at_s in (message.start_s, message.end_s))
            new = first + self._done + _MARGIN >= self._spoken_until
            if new and self._touched(end - self._clocks.longest, first + self._clocks.longest):
                messages.append(message)
                self._spoken_until = end + self._done
        return messages

    def _phase_known(self, one: _Candidate, lattice: Lattice) -> bool:
        """Return whether a word cannot be another's rotation, or else where its packet starts.

        That is where idle was seen before it or after it, or where it follows on one that was given out.
        """
        since = one.start - self._spoken_until
        if not self._rotated[one.column] or -_NEIGHBOURS <= since < IDLE_BITS * STEPS_PER_BIT:
            return True
        start, idle = one.start - self._done, int(self._clocks.idle[one.rate])
        end = start + int(self._clocks.lengths[one.rate])
        after = end + idle <= self._complete and lattice.idle_seen(end + idle, one.rate)
        return after or lattice.idle_seen(start, one.rate)

    def _share(self, log: Floats) -> float:
        """Return the share of some explanations among all: idle now, or a packet under way."""
        total = _log_sum(np.logaddexp(self._idle, _log_sum(self._under_way)))
        return min(float(np.exp(_log_sum(log) - total)), 1.0)

    def _look_under_way(self, lattice: Lattice, asked: NDArray[np.bool_]) -> None:
        """Find the log-probability of packets that began and have not ended, on some of the clocks.

        Starts are the steps of a longest packet up to now. Where a block has looked already it is not done
        again.
        """
        asked = asked & ~self._looked
        self._looked |= asked
        first = self._complete - self._clocks.longest + 1
        steps = np.arange(first, self._complete + 1)
        starts, rates = (pair.ravel() for pair in np.meshgrid(steps, np.flatnonzero(asked)))
        going = starts + self._clocks.lengths[rates] > self._complete
        starts, rates = starts[going], rates[going]
        log = lattice.garbage(starts, rates) + self._log_garbage
        total, _, _ = lattice.best_words(starts, rates, log - self._log_start - _NEGLIGIBLE)
        log = np.logaddexp(log, total + self._log_start)
        self._under_way[rates, starts - first] = log + self._before[rates, starts]

    def _after(self, rates: Numbers, ends: Numbers) -> Array:
        """Return the log-probability of all that may follow packets which end at steps, up to now."""
        first = self._complete - self._clocks.longest + 1
        following = (self._under_way - self._before[:, first : self._complete + 1])[:, ::-1]
        following = np.logaddexp.accumulate(following, axis=1)[:, ::-1]
        return np.asarray(np.logaddexp(0.0, following[rates, np.maximum(ends - first, 0)]))


def decode(signal: Signal, settings: DecoderSettings | None = None) -> tuple[Message, ...]:
    """Return what a whole signal says: what a `Decoder` says that is fed it piece by piece."""
    decoder = Decoder(signal.robot, signal.track, settings)
    return decoder.push(signal) + decoder.finish()


def _log_sum(logs: Floats) -> Array:
    """Return the logarithm of the sum over the last axis."""
    if not logs.shape[-1]:
        return np.full(logs.shape[:-1], -np.inf)
    top = np.maximum(logs.max(axis=-1), -1e30)
    return np.asarray(top + np.log(np.exp(logs - top[..., None]).sum(axis=-1) + 1e-300))
