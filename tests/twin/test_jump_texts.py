"""What a series says of jumps: in its numbers, in the text of the reports, and in the warnings."""

import json
from dataclasses import replace

import numpy as np

from analysis.monitor.disturbances import Consistency
from analysis.monitor.jump_detection import Jump
from twin.main_job.systematics import course_agrees
from twin.monitor.reading_table import ReadingTable
from twin.monitor.time_series import SmoothedCourse, jump_text

JUMP = Jump(
    "base/M2",
    (3, 4),
    ("base/M2 shift x", "base/M2 shift y"),
    ("um", "um"),
    (3.21, -0.5),
    (0.42, 0.4),
    3600.0,
    7200.0,
    ((3600.0, 0.0), (7200.0, 1.0)),
    31.4,
    2e-9,
    {"base/M1": 31.0, "base/M3": 12.0},
    1.5,
)


def course(jumps: tuple[Jump, ...] | None) -> SmoothedCourse:
    """Of two times; its changes are not looked at."""
    empty = ReadingTable((), {})
    agrees = Consistency(3.0, 4, 18.0)
    return SmoothedCourse("some", empty, np.zeros(0), empty, np.array([1.0, 2.0]), 2, agrees, jumps, 0.01)


def test_a_jump_in_words() -> None:
    assert jump_text(JUMP) == (
        "base/M2 jumped between 1 h and 2 h: shift x +3.21 ± 0.42 um, shift y -0.5 ± 0.4 um, log likelihood "
        "ratio 31.4; sigmas are larger there, and the smoothed changes treat it as an event; base/M1 would explain it "
        "nearly as well"
    )
    assert "nearly" not in jump_text(replace(JUMP, rivals={"base/M3": 12.0}))


def test_what_a_course_says() -> None:
    """Where nothing may jump nothing is said of it; where nothing did, that it was looked for; else what did."""
    times = np.array([0.0, 3600.0])
    none, nothing, one = course(None), course(()), course((JUMP,))
    assert "jumps" not in none.to_dict()
    assert "jump" not in course_agrees(none, times)
    assert nothing.to_dict()["jumps"] == {"false_alarm": 0.01, "detected": []}
    assert course_agrees(nothing, times).endswith("No jump was detected (false-alarm probability at most 0.01).")
    assert course_agrees(one, times).endswith(f"The series shows that {jump_text(JUMP)}.")
    (found,) = json.loads(json.dumps(one.to_dict()))["jumps"]["detected"]
    assert found["sizes"][0] == {"name": "base/M2 shift x", "unit": "um", "size": 3.21, "sigma": 0.42}
    assert found["rivals"] == [{"body": "base/M1", "log_ratio": 31.0}, {"body": "base/M3", "log_ratio": 12.0}]
