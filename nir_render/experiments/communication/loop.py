"""A leader at rest tells its followers the spacing; they hear it while they see each other, and obey."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.messages import decided_bits
from nir_render.experiments.communication.judge import Judged, judged
from nir_render.experiments.loop.closed import ClosedLoop, LoopPlan
from nir_render.experiments.loop.controllers import COMMANDED_M, Formation
from nir_render.experiments.loop.sight import Seen
from nir_render.randomness import generator
from nir_render.scene.scene import Scene
from nir_render.simulation.sent import sent_packets
from nir_render.truth.sent import SentTruth
from perception import Signal, Track
from perception.messages.uart import COMMANDS, FRAME_BITS, RATE_HZ, REPEATS, encode, word_of

Array = NDArray[np.float64]

PACKET_S = FRAME_BITS * REPEATS / RATE_HZ
ORDER = ("disperse", "aggregate", "recover")
PAPERS_INTERVALS_S = ((5.0, 10.0), (18.0, 24.0), (24.0, 30.0))
"""The paper's: disperse, aggregate, recover."""

_FIRST_S, _PHASE_S, _PAUSE_S, _PACKETS_A_PHASE = 3.0, 20.0, 1.15, 3
_DRIFT_MOST = 0.01  # of the leader's clock: assumed
_ASIDE_M = 0.03  # of a start from its place, each axis, σ
_FOLLOWED_M = 0.3  # a track so near to the leader is its


@dataclass(frozen=True, kw_only=True)
class Communication(LoopPlan):
    """What a run of the experiment is, beside what all closed loops are; robots look 30 times a second.

    Attributes
    ----------
    robots
        How many, the leader among them, 3 to 7.
    timetable
        `ours`: a command every 20 s from 3 s on, and after each two packets that command nothing of the
        spacing, so that followers are also spoken to while they move. `paper`: sending begins at 5, 18, 24 s.
    """

    robots: int = 3
    timetable: str = "ours"
    lasts_s: float = 65.0
    period_s: float = 1.0 / 30.0

    def loop(self, scene: Scene, seed: int) -> "Loop":
        """Return the beginning of a run."""
        return Loop(scene, self, seed)


class Loop(ClosedLoop):
    """A run in the making: controllers, and what was heard, beside what all closed loops know.

    Attributes
    ----------
    told
        Every word: to whom, when, what, by which track.
    leaders_track
        At each step the number of each follower's track of the leader, if any.
    """

    listens = True

    def __init__(self, scene: Scene, plan: Communication, seed: int) -> None:
        scene = sending_scene(scene, plan, seed)
        super().__init__(scene, plan, seed, starts_m(list(scene.document.robots), seed), sent_packets(scene))
        self.plan = plan
        self.controllers = {name: Formation() for name in self.followers}
        self.told: list[dict[str, Any]] = []
        self.leaders_track: list[dict[str, int | None]] = []

    def _wanted(self, seen: Mapping[str, Seen]) -> dict[str, Array]:
        plan, now_s = self.plan, self.world.time_s
        wanted: dict[str, Array] = {}
        for name, one in seen.items():
            controller = self.controllers[name]
            controller.hear(one.messages, now_s)
            self.told += [
                {"robot": name, "told_s": now_s, "start_s": word.start_s, "end_s": word.end_s,
                 "word": word.word, "command": word.command, "track": word.track}
                for word in one.messages
            ]  # fmt: skip
            wanted[name] = controller.velocity(one.neighbours, now_s, plan.base.speed_m_per_s)
        self.leaders_track.append({name: self._leaders_track(name, one.tracks) for name, one in seen.items()})
        return wanted

    def record(self) -> dict[str, Any]:
        """Return a run as plain data: what was sent, told, obeyed, the verdict, beside where all were."""
        sent = [packet for packet in self.sent if packet.end_s <= self.plan.lasts_s]
        bits, wrong_bits, levels = self._bits(sent)
        return super().record() | {
            "judged": asdict(self._judged(sent)),
            "bits": bits,
            "wrong_bits": wrong_bits,
            "levels": levels,
            "sent": [packet.record() for packet in self.sent],
            "told": self.told,
            "obeyed": {name: [list(each) for each in one.obeyed] for name, one in self.controllers.items()},
        }

    def _judged(self, sent: Sequence[SentTruth]) -> Judged:
        distances_m = self.distances_m()
        # Starts scatter about a lattice of 1 m, whose next but one are 1.73 m apart.
        near = {pair: d_m for pair, d_m in distances_m.items() if d_m[0] < 1.35}
        said = [(one["robot"], one["told_s"], one["word"]) for one in self.told]
        obeyed = {name: one.obeyed for name, one in self.controllers.items()}
        nearest_m = min(float(d_m.min()) for d_m in distances_m.values())
        touched = nearest_m < self.plan.base.diameter_m
        return judged(np.array(self.times_s), near, sent, said, obeyed, touched)

    def _leaders_track(self, follower: str, tracks: Sequence[Track]) -> int | None:
        """Return the number of the track that follows the leader: the nearest to its true place."""
        movers = self.world.movers
        away_m = movers[self.leader].place_m - movers[follower].place_m
        off_m = [
            (float(np.hypot(*(one.position_body_m[:2] - away_m))), one.track)
            for one in tracks
            if one.ghost != "yes"
        ]
        nearest = min(off_m, default=(math.inf, 0))
        return nearest[1] if nearest[0] < _FOLLOWED_M else None

    def _bits(self, sent: Sequence[SentTruth]) -> tuple[int, int, dict[str, list[float]]]:
        """Return how many bits of packets were sampled and, each decided by itself, are wrong; levels.

        Levels are number, mean and σ of the samples within bits that were sent, dark and lit.
        """
        bits = wrong = 0
        levels: dict[str, list[float]] = {"dark": [], "lit": []}
        for name, sight in self.sights.items():
            signals = {signal.track: signal for signal in sight.signals()}
            for packet in sent:
                during = Counter(
                    at[name]
                    for time_s, at in zip(self.times_s, self.leaders_track, strict=True)
                    if packet.start_s <= time_s <= packet.end_s and at[name] is not None
                )
                if not during or (signal := signals.get(during.most_common(1)[0][0] or 0)) is None:
                    continue
                decided, known = decided_bits(signal, packet)
                coded = encode(packet.word)
                bits += int(known.sum())
                wrong += int((decided[known] != coded[known]).sum())
                dark, lit = levels_in(signal, packet)
                levels["dark"] += dark
                levels["lit"] += lit
        return bits, wrong, {name: _moments(of_one) for name, of_one in levels.items()}


def sending_scene(scene: Scene, plan: Communication, seed: int) -> Scene:
    """Return the scene with so many robots, and a leader that sends; its clock is off by up to 1 %.

    Packets that command nothing of the spacing say one of the other thirteen commands, drawn by the seed.
    """
    random = generator(seed, "words", "communication", 0)
    others = [word for word, command in enumerate(COMMANDS) if command not in COMMANDED_M]
    sends: list[dict[str, Any]] = []
    for number, command in enumerate(ORDER):
        if plan.timetable == "paper":
            sends.append({"at": f"{PAPERS_INTERVALS_S[number][0]} s", "word": word_of(command)})
            continue
        at_s = _FIRST_S + _PHASE_S * number
        words = [word_of(command), *map(int, random.choice(others, _PACKETS_A_PHASE - 1))]
        sends += [
            {"at": f"{at_s + (PACKET_S + _PAUSE_S) * place} s", "word": word}
            for place, word in enumerate(words)
        ]
    drift, offset_s = random.uniform(-_DRIFT_MOST, _DRIFT_MOST), random.uniform(0.0, 1.0 / RATE_HZ)
    leader, *others_of = list(scene.document.robots)[: plan.robots]
    return scene.with_(
        {
            "robots": {name: scene.raw["robots"][name] for name in (leader, *others_of)},
            "observe": others_of,
            f"robots.{leader}.rig.sources.top.drive": {
                "packets": {"sends": sends, "drift": drift, "offset": f"{offset_s} s"}
            },
        }
    )


def starts_m(names: Sequence[str], seed: int) -> dict[str, Array]:
    """Return where robots start: the leader, and followers around it at 1 m and 60° from each other.

    All is turned anyhow, and followers stand some centimetres aside.
    """
    random = generator(seed, "starts", "communication", 0)
    turned = random.uniform(0.0, 2.0 * math.pi)
    places = [np.zeros(2)]
    for number in range(len(names) - 1):
        angle = turned + number * math.pi / 3.0
        places.append(np.array([math.cos(angle), math.sin(angle)]) + _ASIDE_M * random.standard_normal(2))
    return dict(zip(names, places, strict=True))


def truth_of(plan: Communication, timetable: str) -> Communication:
    """Return the plan with the truth known, by a timetable."""
    return replace(plan, level="truth", timetable=timetable)


def levels_in(signal: Signal, packet: SentTruth) -> tuple[list[float], list[float]]:
    """Return the levels of the samples that lie within dark bits of a packet, and within lit ones."""
    coded = encode(packet.word)
    bit_s = (packet.end_s - packet.start_s) / len(coded)
    first = (signal.time_s - 0.5 * signal.exposure_s - packet.start_s) / bit_s
    last = first + signal.exposure_s / bit_s
    within = (first >= 0.0) & (last < len(coded)) & (np.floor(first) == np.floor(last))
    within &= np.isfinite(signal.sigma_lit)
    lit = coded[np.floor(first[within]).astype(int)] == 1
    levels = signal.level[within]
    return levels[~lit].tolist(), levels[lit].tolist()


def _moments(levels: Sequence[float]) -> list[float]:
    if len(levels) < 2:
        return [float(len(levels)), 0.0, 0.0]
    return [float(len(levels)), float(np.mean(levels)), float(np.std(levels, ddof=1))]
