"""A leader at rest tells its followers the spacing; they hear it while they see each other, and obey."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.messages import decided_bits
from nir_render.experiments.communication.judge import Judged, judged
from nir_render.experiments.controllers import COMMANDED_M, Formation
from nir_render.experiments.frame_sight import FrameSight
from nir_render.experiments.measurement_sight import MeasurementSight
from nir_render.experiments.sight import Sight, TrueSight
from nir_render.experiments.world import Base, World
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


@dataclass(frozen=True)
class Communication:
    """What a run of the experiment is.

    Attributes
    ----------
    robots
        How many, the leader among them, 3 to 7.
    level, stack, refresh_s
        As of `Flocking`.
    timetable
        `ours`: a command every 20 s from 3 s on, and after each two packets that command nothing of the
        spacing, so that followers are also spoken to while they move. `paper`: sending begins at 5, 18, 24 s.
    lasts_s, period_s
        How long it goes, and how often robots look and decide: at 30 Hz, as one listens.
    """

    robots: int = 3
    level: str = "measurements"
    stack: str = "robust"
    timetable: str = "ours"
    lasts_s: float = 65.0
    period_s: float = 1.0 / 30.0
    refresh_s: float = 5.0
    base: Base = field(default_factory=Base)

    def loop(self, scene: Scene, seed: int) -> "Loop":
        """Return the beginning of a run."""
        return Loop(scene, self, seed)


@dataclass(frozen=True, eq=False)
class Instant:
    """Where everybody is at a time, shape (2,) each, and each follower's track of the leader, if any."""

    time_s: float
    places_m: dict[str, Array]
    leaders_track: dict[str, int | None]


class Loop:
    """A run in the making: world, eyes, controllers, and what happened so far."""

    def __init__(self, scene: Scene, plan: Communication, seed: int) -> None:
        self.plan, self.seed = plan, seed
        scene = sending_scene(scene, plan, seed)
        self.leader, *self.followers = scene.document.robots
        self.sent = sent_packets(scene)
        self.world = World(scene, starts_m([self.leader, *self.followers], seed), plan.base, seed)
        self.sights = {name: _sight(scene, name, plan, seed, self.sent) for name in self.followers}
        self.controllers = {name: Formation() for name in self.followers}
        self.instants: list[Instant] = []
        self.told: list[dict[str, Any]] = []

    @property
    def steps(self) -> int:
        """How many steps the whole run has."""
        return round(self.plan.lasts_s / self.plan.period_s)

    @property
    def done(self) -> int:
        """How many of them are done."""
        return len(self.instants)

    def step(self) -> Instant:
        """Look, listen, decide, go; return how it was when robots looked."""
        plan, world = self.plan, self.world
        wanted: dict[str, Array] = {}
        leaders: dict[str, int | None] = {}
        for name, sight in self.sights.items():
            seen, controller = sight.look(world), self.controllers[name]
            controller.hear(seen.messages, world.time_s)
            self.told += [
                {"robot": name, "told_s": world.time_s, "start_s": one.start_s, "end_s": one.end_s,
                 "word": one.word, "command": one.command, "track": one.track}
                for one in seen.messages
            ]  # fmt: skip
            wanted[name] = controller.velocity(seen.neighbours, world.time_s, plan.base.speed_m_per_s)
            leaders[name] = self._leaders_track(name, seen.tracks)
        places_m = {name: mover.place_m for name, mover in world.movers.items()}
        instant = Instant(world.time_s, places_m, leaders)
        self.instants.append(instant)
        world.step(wanted, plan.period_s)
        return instant

    def record(self) -> dict[str, Any]:
        """Return a run as plain data: what was sent, told and obeyed, the verdict, all places over time."""
        names = [self.leader, *self.followers]
        sent = [packet for packet in self.sent if packet.end_s <= self.plan.lasts_s]
        obeyed = {name: one.obeyed for name, one in self.controllers.items()}
        verdict = self._judged(sent)
        bits, wrong_bits, levels = self._bits(sent)
        held = [
            share
            for sight in self.sights.values()
            if isinstance(sight, FrameSight)
            for share in sight.held_shares
        ]
        return {
            "format": 1,
            "seed": self.seed,
            "judged": asdict(verdict),
            "bits": bits,
            "wrong_bits": wrong_bits,
            "levels": levels,
            "sent": [packet.record() for packet in self.sent],
            "told": self.told,
            "obeyed": {name: [list(each) for each in of_one] for name, of_one in obeyed.items()},
            "robots": names,
            "time_s": [round(instant.time_s, 9) for instant in self.instants],
            "places_m": np.round([[at.places_m[name] for name in names] for at in self.instants], 6).tolist(),
            "held_light_share": max(held) if held else None,
        }

    def _judged(self, sent: Sequence[SentTruth]) -> Judged:
        first = self.instants[0].places_m
        names = [self.leader, *self.followers]
        distances_m = {
            (one, other): np.array(
                [float(np.hypot(*(at.places_m[one] - at.places_m[other]))) for at in self.instants]
            )
            for number, one in enumerate(names)
            for other in names[number + 1 :]
        }
        # Starts scatter about a lattice of 1 m, whose next but one are 1.73 m apart.
        near = {
            pair: d_m
            for pair, d_m in distances_m.items()
            if np.hypot(*(first[pair[0]] - first[pair[1]])) < 1.35
        }
        times_s = np.array([at.time_s for at in self.instants])
        said = [(one["robot"], one["told_s"], one["word"]) for one in self.told]
        obeyed = {name: one.obeyed for name, one in self.controllers.items()}
        nearest_m = min(float(d_m.min()) for d_m in distances_m.values())
        return judged(times_s, near, sent, said, obeyed, nearest_m < self.plan.base.diameter_m)

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
                    at.leaders_track[name]
                    for at in self.instants
                    if packet.start_s <= at.time_s <= packet.end_s and at.leaders_track[name] is not None
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


def _sight(scene: Scene, robot: str, plan: Communication, seed: int, sent: Sequence[SentTruth]) -> Sight:
    if plan.level == "truth":
        return TrueSight(robot, sent)
    if plan.level == "measurements":
        return MeasurementSight(scene, robot, seed, keep_signals=True)
    return FrameSight(scene, robot, seed, plan.stack, plan.refresh_s, keep_signals=True)


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
