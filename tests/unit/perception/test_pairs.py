"""Two robots in one place of the image, both sending: frames by brute force, through the whole stack."""

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import Message, Pipeline
from perception.messages.uart import encode
from tests.unit.perception.stage import CAMERA, CAMERAS, EXPOSURE_S, RATE_HZ, frame_of

Array = NDArray[np.float64]

WORDS = {"near": 42, "far": 19}
START_S = {"near": 6.83, "far": 8.12}
RANGE_M = {"near": 2.0, "far": 2.7}
SIDE = {"near": 1.0, "far": -1.0}


def _place_m(who: str, time_s: float) -> Array:
    """In one line with the camera from second 6 to 15, a hundredth of a pixel apart; before and after beside it."""
    way = min(max(6.0 - time_s, time_s - 15.0, 1e-3), 3.0)
    return np.array([RANGE_M[who], SIDE[who] * 0.05 * way * RANGE_M[who], 0.1])


def _lit(who: str, time_s: float) -> bool:
    bit = int(np.floor((time_s - START_S[who]) * 10.0 * (1.0025 if who == "near" else 0.9975)))
    bits = encode(WORDS[who])
    return not 0 <= bit < len(bits) or bool(bits[bit])


@pytest.mark.parametrize(
    ("silent", "beside"),
    [
        (None, False),
        pytest.param("near", False, marks=pytest.mark.verify),
        pytest.param(None, True, marks=pytest.mark.verify),
    ],
)
def test_both_are_heard_while_they_are_one_light(silent: str | None, beside: bool) -> None:
    """Each word once, by the track that said it; who is silent, or shines 3 px beside, is not said to have said any."""
    pipeline = Pipeline(CAMERAS, keep_signals=True)
    messages: list[Message] = []
    first: dict[int, str] = {}
    for index in range(540):
        when = index / RATE_HZ + 0.5 * EXPOSURE_S
        lit = [_place_m(who, when) for who in WORDS if who == silent or _lit(who, when)]
        if beside:
            lit.append(np.array([2.3, 0.0, 0.1 + 3.0 / CAMERA.fx_px * 2.3]))
        heard = pipeline.push([frame_of(index, lit)])
        messages += heard.messages
        if index == 60:
            first = {
                t.track: min(RANGE_M, key=lambda who: abs(RANGE_M[who] - t.position_body_m[0]))
                for t in heard.tracks
                if t.position_body_m[2] < 0.12
            }
    messages += pipeline.finish()
    assert len(heard.tracks) == 2 + beside
    assert {track.track for track in heard.tracks} >= set(first)
    said = {first[message.track]: message for message in messages}
    assert len(messages) == len(said)
    assert {who: one.word for who, one in said.items()} == {w: x for w, x in WORDS.items() if w != silent}
    for who, one in said.items():
        assert one.start_s == pytest.approx(START_S[who], abs=0.03)
        assert one.ambiguous_with is None
