"""Answers that the page of an instrument in operation gets, as JSON: its state, trends, readings and motions."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import func, select

from analysis.chi_square import limit_of
from analysis.monitor.disturbances import FALSE_ALARM
from scenes.models.disturbances import HEAT, state_of
from scenes.yaml.errors import Problem
from twin.operate.daily_report import rivals_text
from twin.operate.estimate.alarms import name_of
from twin.operate.overview import CONFIDENCE, DAY, Overview, carried_text, code_of, group_name, largest_part, points_of
from twin.operate.past_view import View, Views
from twin.operate.record.entries import MICRO, one_line, utc_text
from twin.operate.record.history import History
from twin.operate.record.schema import ACKNOWLEDGEMENT, ALARM, ENTRY, REFUSED
from twin.operate.shown_readings import plain_reading, reading_near, readings
from twin.pictures.scene_file import motions, write_scene
from twin.run.report import sentence

if TYPE_CHECKING:
    from twin.operate.estimate.following import FoundJump
    from twin.operate.estimate.operation import Operation

_ALARM = ("id", "kind", "subject", "text", "time_us", "time_utc", "raised_utc", "acknowledged")
"""What a page gets of an alarm."""
MOST_LEFT_OUT = 200
"""Newest readings that were left out, as a page gets them."""
MOST_POINTS = 600
"""Single readings of a trend."""
MOST_MOTIONS = 12
"""Motions that are told beside the view in three dimensions, the surest first; temperatures are not among them."""
SURE = 2.0
"""Sigmas from which on a body is drawn as moved."""


class Desk:
    """Reads a record and answers.

    One thread at a time looks and asks for trends and motions. Others may ask for the state and for readings and
    acknowledge alarms meanwhile, which never waits for an estimate.

    Args:
        history: the record.
        estimate: makes the estimate anew, which goes on from what the record keeps of the one before.
    """

    def __init__(self, history: History, estimate: Callable[[], Operation]) -> None:
        self.history, self._estimate = history, estimate
        self.version = 0
        """Counts up with whatever is new in the record."""
        self.state = b""
        """All that is known now, with the version."""
        self._lock, self._views = RLock(), Views()
        self._seen = self._ends()
        self.overview = Overview.of(history, estimate())
        experiment = self.overview.operation.experiment
        self._instrument, self._thermal, self._stated = experiment.instrument, experiment.thermal, experiment.stated
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "scene.glb"
            write_scene(experiment, {}, place)
            self.scene = place.read_bytes()
            """Binary glTF of the instrument as designed."""
        self._tell(self.overview)

    def look(self) -> None:
        """Take what is new in the record.

        Raises:
            RecordFailed: it cannot be read now.
        """
        ends = self._ends()
        if ends[:2] != self._seen[:2]:
            overview = Overview.of(self.history, self._estimate())
            self._seen = ends
            self._tell(overview)
        elif ends != self._seen:
            self._seen = ends
            self._tell_alarms()

    def _ends(self) -> tuple[int, ...]:
        """Number of the last row of every table that a page shows; the first two change the estimate."""
        tables = (ENTRY, REFUSED, ALARM, ACKNOWLEDGEMENT)
        with self.history.reading() as connection:
            return tuple(connection.execute(select(func.coalesce(func.max(t.c.id), 0))).scalar_one() for t in tables)

    def _tell_alarms(self) -> None:
        with self._lock:  # no other state comes in between
            self._tell(replace(self.overview, alarms=tuple(self.history.alarms())))

    def _tell(self, overview: Overview) -> None:
        """Let pages have a new state."""
        ccd = self._instrument.spec.autocollimator.area_ccd
        told = page_state(self.history, overview) | {"ccd": {"rows": ccd.rows, "columns": ccd.columns}}
        with self._lock:
            self.version += 1
            self.overview, self.state = overview, _json({**told, "version": self.version})

    def work_ahead(self) -> None:
        """Work out what a page asks for first."""
        self._view(self.overview.time)

    def _view(self, begin: int) -> View:
        return self._views.over(self.history, self.overview, begin)

    def trend(self, begin: int, end: int) -> bytes:
        """Courses of all quantities over a span, cut where the record and its forecast end.

        Args:
            begin: microseconds of TAI since 2000.
            end: likewise.
        """
        overview = self.overview
        begin, end = max(begin, overview.begin), min(end, overview.time + overview.horizon)
        begin = min(begin, max(overview.begin, overview.time - DAY))  # a span of the forecast begins before it
        end = max(end, begin + DAY // 24)
        found = points_of(readings(self.history, begin, end, MOST_POINTS), overview.quantities)
        points = {"times": found.times, "values": found.values.T, "sigmas": found.sigmas.T}
        return _json({"from_us": begin, "to_us": end, **self._view(begin).part(begin, end), "points": points})

    def reading(self, time: int) -> bytes | None:
        """The reading that is nearest to a time, with its spots and frames; None without any."""
        found = reading_near(self.history, time)
        return None if found is None else _json(plain_reading(self.history, found))

    def acknowledge(self, alarm: int, by: str, note: str) -> str:
        """Acknowledge an alarm.

        Args:
            alarm: its number.
            by: who does.
            note: what there is to say of it.

        Returns:
            Why it cannot be; empty if it was.
        """
        try:
            self.history.acknowledge(alarm, by, note)
        except Problem as problem:
            return one_line(problem)
        finally:
            self._tell_alarms()
        return ""

    def motions(self, time: int) -> bytes:
        """What every body did by a time, as all readings have it; of the time nearest to it that was worked out.

        Args:
            time: microseconds of TAI since 2000.
        """
        view = self._view(max(time, self.overview.begin))
        k = view.nearest(time)
        names = list(view.together)
        mean, sigma = (np.array([one[part][k] for one in view.together.values()]) for part in (0, 1))
        components = () if self._stated is None else self._stated.components
        sizes = np.array([one.unit_size for one in components])
        state = state_of(view.moved[k] * sizes, components, self._thermal)
        named = {one.name: one for one in components}
        # sensors read temperatures, and what these do to shapes is known with them
        own = np.array([named[name].kind not in HEAT for name in names])
        ratio = own * np.abs(mean) / np.where(sigma > 0.0, sigma, np.inf)
        sure = {named[names[i]].body for i in np.flatnonzero(ratio >= SURE)}
        moved = motions(self._instrument, state, self._instrument.assembly.place([state]))
        first = np.argsort(-ratio, kind="stable")[:MOST_MOTIONS]
        largest = [{"label": names[i], "unit": named[names[i]].unit, "mean": mean[i], "sigma": sigma[i]} for i in first]
        return _json(
            {
                "utc": utc_text(int(view.times[k])),
                "time_us": view.times[k],
                "moved": {path: {**one, "sure": path in sure} for path, one in moved.items()},
                "largest": largest,
            }
        )


def _json(value: Any) -> bytes:
    return json.dumps(plain(value), allow_nan=False).encode()


def page_state(history: History, overview: Overview) -> dict[str, Any]:
    """All that is known now.

    Args:
        history: the record.
        overview: of it.
    """
    told = overview.following
    end, latest = overview.time, overview.latest
    newest = sorted(overview.alarms, key=lambda one: -int(one["time_us"]))
    return {
        "instrument": overview.name,
        "record": history.url,
        "time_us": end,
        "utc": utc_text(end),
        "first_us": overview.begin,
        "last_us": end + overview.horizon,
        "tai_minus_unix_us": end - unix_micros(end),
        "readings": told.readings,
        "sentences": [
            overview.state_sentence(),
            overview.change_sentence(latest - DAY, latest + 1, "in the last 24 hours"),
            *overview.break_sentences(),
            *(sentence(one).rstrip(".") for one in list(overview.following.doubts)),
        ],
        "holds": all(one.holds_now for one in told.breaks),
        "predictions": overview.score_sentence(),
        "quantities": _quantities(overview),
        "coverage": [{**vars(one), "holds": one.holds} for one in overview.coverages],
        "confidence": CONFIDENCE,
        "log_score": told.scores.log_score if told.scores.readings else None,
        "false_alarm": FALSE_ALARM,
        "innovations": [
            [time, chi, degrees, float(limit_of(FALSE_ALARM, degrees))] for time, chi, degrees in told.innovations
        ],
        "jumps": [{**_jump(jump), "carried": carried_text(overview, jump)} for jump in told.jumps],
        "events": [{"time_us": t, "utc": utc_text(t), "name": n, "causes": list(c)} for t, n, c in overview.events],
        "sensors": [
            {
                "body": one.body,
                "state": one.state,
                "since": utc_text(one.since_us),
                "last": utc_text(one.last_us),
                "reason": one.reason,
            }
            for one in told.sensors
        ],
        "left_out": [
            {"utc": utc_text(time), "kind": kind, "subject": subject, "reason": reason}
            for time, kind, subject, reason in sorted(told.left_out, key=lambda one: -one[0])[:MOST_LEFT_OUT]
        ],
        "left_out_count": len(told.left_out),
        "alarms": [{key: one[key] for key in _ALARM} for one in newest],
    }


def _quantities(overview: Overview) -> list[dict[str, Any]]:
    now = overview.following.now
    out = []
    for q, quantity in enumerate(overview.quantities):
        required = overview.required(quantity)
        own = None
        if required is not None:
            when = required.breaks_us
            own = {
                "limit": required.limit,
                "probability": required.probability,
                "holds": required.holds_now,
                "chance": required.chance_now,
                "breaks": None if when is None else utc_text(when),
            }
        parameter = quantity.parameter
        out.append(
            {
                "group": group_name(quantity.group),
                "name": name_of(code_of(quantity), overview.quantities),
                "symbol": parameter.symbol,
                "unit": parameter.unit,
                "meaning": parameter.meaning,
                "explained": overview.following.explained.get(code_of(quantity)),
                "value": now.values[0, q],
                "sigma": now.sigmas[0, q],
                "required": own,
            }
        )
    return out


def _jump(jump: FoundJump) -> dict[str, Any]:
    return {
        "body": jump.body,
        "after_us": jump.after_us,
        "until_us": jump.until_us,
        "after": utc_text(jump.after_us),
        "until": utc_text(jump.until_us),
        "told": utc_text(jump.told_us),
        "part": dict(zip(("label", "unit", "size", "sigma"), largest_part(jump), strict=True)),
        "log_ratio": jump.log_ratio,
        "false_alarm": jump.false_alarm,
        "rivals": rivals_text(jump),
    }


def unix_micros(time: int) -> int:
    """Microseconds of POSIX time, which has no leap seconds, of a time in microseconds of TAI since 2000."""
    text = utc_text(time).replace(":60", ":59").rstrip("Z")
    return round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp() * MICRO)


def plain(value: Any) -> Any:
    """A value as JSON has it: arrays as lists, and null for what is no finite number."""
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
