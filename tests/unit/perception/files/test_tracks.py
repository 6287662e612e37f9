"""Lines about time: what was written comes back, and what is broken is told."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception import (
    Message,
    Odometry,
    RecordingError,
    Signal,
    Track,
    message_record,
    odometry_record,
    parse_message,
    parse_odometry,
    parse_signal,
    parse_track,
    read_odometry,
    signal_record,
    track_record,
)

_POSE = Odometry("r1", 0.5, np.array([1.0, 2.0, 0.25]), Rotation.from_euler("z", 0.3).as_matrix(), 1e-3, 2e-3)
_TRACK = Track(
    "r1", 0.5, 7, np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.0, -0.2]), np.diag(np.arange(1.0, 7.0)),
    (("r1.front", 3, 0),), 0.0, None, "possible",
)  # fmt: skip
_MESSAGE = Message("r1", 7, 1.0, 6.5, 8, "aggregate", 0.999, 5, None, 9)
_SIGNAL = Signal(
    "r1", 7, np.array([0.1, 0.2]), np.array([1e-3, 1e-3]), np.array([0.9, np.nan]), np.array([0.1, np.inf]),
    np.array([0.2, np.inf]),
)  # fmt: skip


def _through_json(record: dict[str, Any]) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(json.dumps(record, allow_nan=False))
    assert read["format"] == 1
    return read


def _assert_same(one: Any, other: Any) -> None:
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_allclose(b, a, rtol=0, atol=1e-15, err_msg=field.name)
        else:
            assert a == b, field.name


def test_what_was_written_comes_back() -> None:
    _assert_same(_POSE, parse_odometry(_through_json(odometry_record(_POSE))))
    _assert_same(_TRACK, parse_track(_through_json(track_record(_TRACK))))
    _assert_same(_MESSAGE, parse_message(_through_json(message_record(_MESSAGE))))
    _assert_same(_SIGNAL, parse_signal(_through_json(signal_record(_SIGNAL))))


@pytest.mark.parametrize(
    ("parse", "record", "change", "told"),
    [
        (parse_odometry, odometry_record(_POSE), {"quaternion_xyzw": [0, 0, 0, 2]}, "length 1"),
        (parse_odometry, odometry_record(_POSE), {"position_sigma_m": -1.0}, "0 or more"),
        (parse_odometry, odometry_record(_POSE), {"position_m": [0, 0]}, "position_m"),
        (parse_track, track_record(_TRACK), {"covariance": [[1.0]]}, "covariance"),
        (parse_track, track_record(_TRACK), {"ghost": "maybe"}, "ghost"),
        (parse_track, track_record(_TRACK), {"track": 1.5}, "track"),
        (parse_message, message_record(_MESSAGE), {"word": 128}, "0 to 127"),
        (parse_message, message_record(_MESSAGE), {"confidence": 1.5}, "0 to 1"),
        (parse_signal, signal_record(_SIGNAL), {"level": [0.5]}, "another length"),
        (parse_signal, signal_record(_SIGNAL), {"time_s": [0.1, None]}, "time_s"),
    ],
)
def test_what_is_broken_is_told(
    parse: Any, record: dict[str, Any], change: dict[str, Any], told: str
) -> None:
    with pytest.raises(RecordingError, match=told):
        parse(record | change, "a.jsonl", 3)
    with pytest.raises(RecordingError, match=rf"line 3.*{next(iter(change))}"):
        parse(
            {name: value for name, value in record.items() if name not in change}
            | ({next(iter(change)): "nonsense"}),
            "a.jsonl",
            3,
        )


def test_odometry_is_read_by_robot_in_the_order_of_time(tmp_path: Path) -> None:
    assert read_odometry(tmp_path) == {}
    lines = [_POSE, replace(_POSE, robot="r2"), replace(_POSE, time_s=0.6)]
    path = tmp_path / "odometry.jsonl"
    path.write_text("\n".join(json.dumps(odometry_record(line)) for line in lines) + "\n")
    found = read_odometry(tmp_path)
    assert {robot: [one.time_s for one in own] for robot, own in found.items()} == {
        "r1": [0.5, 0.6],
        "r2": [0.5],
    }
    path.write_text("\n".join(json.dumps(odometry_record(line)) for line in reversed(lines)))
    with pytest.raises(RecordingError, match=r"line 3.*order of time"):
        read_odometry(tmp_path)
