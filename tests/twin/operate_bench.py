"""A record with readings of the monitor and a stand-in for what is estimated from it; for tests of what is shown."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.stats import norm

from analysis.monitor.limits import quantities
from optics.numerics.backend import load_backend
from tests.twin.operation_records import life_of, plan_of, record_of
from tests.twin.operation_records import monitor_entry as own_entry
from tests.twin.record_bench import START, given, made, pair
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.estimate.estimate_snapshot import Scores
from twin.operate.estimate.operation_model import store_plan
from twin.operate.estimate.reported_estimate import (
    Course,
    DetectedJump,
    FilterResult,
    Motions,
    RequirementStatus,
    SensorState,
)
from twin.operate.record.entries import MICRO, Alarm, Entry
from twin.operate.record.history import History

HOUR = 3600 * MICRO
DAY = 24 * HOUR
COUNT = 160
"""Readings of the record, three hours apart."""
REFOCUS = START + 20 * DAY - 2 * HOUR
EVIL = '<img src=x onerror="alert(1)">'


@cache
def experiment() -> MonitorExperiment:
    return MonitorExperiment(pair(), load_backend("llvm"))


@cache
def all_quantities() -> tuple[Any, ...]:
    own = experiment()
    return quantities(own.cameras, own.ground)


def monitor_entry(k: int, frames: bool = False) -> Entry:
    """A reading as a run of the main job leaves it."""
    names = {"forward": 1.0, "backward": -1.0}
    cameras = {
        camera: {
            "posterior": {
                one.key: sign * (0.02 * k + 0.3 * np.sin(0.7 * k)) for one in all_quantities() if one.group == camera
            }
            | {f"{one.key}_sigma": 0.3 for one in all_quantities() if one.group == camera}
        }
        for camera, sign in names.items()
    }
    spot = {"row": 47.5, "column": 47.5, "row_sigma": 8e-4, "column_sigma": 8e-4}
    spots = {
        camera: {
            channel: {"before": spot, "after": {**spot, "row": 47.5 - 0.002 * k, "column": 47.5 + sign * 0.004 * k}}
            for channel in ("left", "right")
        }
        for camera, sign in names.items()
    }
    angles = {"posterior": {"change_arcsec": 0.04 * k, "change_arcsec_sigma": 0.4}}
    numbers = {"cameras": cameras, "spots": spots, "intersection_angle": angles, "sigma_holds": True}
    return Entry("monitor", "monitor", START + 3 * HOUR * k, {"sha256": f"{k:064x}", "state": 0, "numbers": numbers})


def filled(place: Any, count: int = COUNT) -> History:
    """A new record with readings and two alarms, of which one was acknowledged."""
    history = made(place)
    events = [Entry("event", name, time, {}) for time, name in ((START + 5 * DAY, "safe_mode"), (REFOCUS, "refocus"))]
    history.ingest(given("passes.csv", [monitor_entry(k) for k in range(count)]))
    history.ingest(given("events.csv", events if count > 100 else []))
    texts = (f"the height will break its requirement {EVIL}", "a jump of base/forward/M2")
    for k, (kind, text) in enumerate(zip(("requirements", "jump"), texts, strict=True)):
        time = START + (20 - 7 * k) * DAY - 3 * HOUR
        span = {"after_us": time - HOUR, "until_us": time}
        history.raise_alarm(Alarm(kind, "ground height_m", time, text, span))
    history.acknowledge(2, "A. Nurse", "seen in the images, too")
    return history


def plan(events: bool = True) -> Any:
    """What is asked of a plan."""
    own = {"safe_mode": ("settling",)} if events else {}
    return SimpleNamespace(operation=SimpleNamespace(disturbances="in_service", horizon=30 * 86_400.0, events=own))


@dataclass
class StandIn:
    """In place of an `Operation`: quantities grow evenly, one jump, one stuck sensor."""

    history: History
    plan: Any = field(default_factory=plan)
    reading_kind: str = "monitor"

    @property
    def experiment(self) -> MonitorExperiment:
        return experiment()

    @property
    def quantities(self) -> tuple[Any, ...]:
        return all_quantities()

    def _course(self, times: Any) -> Course:
        times = np.asarray(times, np.int64)
        days = (times - START) / DAY
        rate = np.array([0.05 * (1 + k) for k in range(len(self.quantities))])
        jump = 0.4 * (days > 12.0)
        values = rate * (days + jump)[:, None]
        sigmas = (0.05 + 0.02 * np.clip(days - 20.0, 0.0, None))[:, None] * np.ones_like(rate)
        return Course(times, self.quantities, values, sigmas, np.zeros((len(times), 8)), np.zeros((len(times), 8, 8)))

    def filter_readings(self) -> FilterResult:
        times = [int(entry["time_us"]) for entry in self.history.entries("monitor")]
        newest = times[-1]
        now = self._course([newest])
        requirements = []
        for q, limit, probability in ((0, 0.4, 0.99), (8, 20.0, 0.95)):
            value, sigma = now.values[0, q], now.sigmas[0, q]
            beyond = float(norm.sf((limit - value) / sigma) + norm.cdf((-limit - value) / sigma))
            when = newest if q == 0 else newest + 9 * DAY
            one = self.quantities[q]
            name = f"{one.group} {one.key}"
            holds = beyond <= 1.0 - probability
            requirements.append(RequirementStatus(name, one.parameter.unit, limit, probability, beyond, holds, when))
        chi = np.random.default_rng(3).chisquare(8, len(times))
        chi[-5] = 60.0
        jump = DetectedJump(
            "base/forward/M2",
            START + 12 * DAY - 3 * HOUR,
            START + 12 * DAY,
            START + 12 * DAY + 6 * HOUR,
            (("base/forward/M2 rotate x", "arcsec", 0.1, 0.1), ("base/forward/M2 shift z", "um", 1.234, 0.056)),
            88.2,
            1e-9,
            {"base/backward": 3.25, "base/forward/M3": 70.5},
        )
        stuck = f"40 consecutive readings of 293.1 K {EVIL}"
        reason = "its reported sigma does not hold"
        return FilterResult(
            newest,
            len(times),
            now,
            Scores(len(times), 8 * len(times), 800, 1220, 7.764),
            tuple((time, float(one), 8) for time, one in zip(times, chi, strict=True)),
            (jump,),
            ((START + 5 * DAY, "safe_mode", ("settling",)),),
            (
                SensorState("base", "ok", START, newest, ""),
                SensorState("base/forward/M1", "stuck", START + 18 * DAY, newest, stuck),
            ),
            tuple((START + day * DAY, "monitor", "monitor", reason) for day in (3, 4)),
            {"forward d_alpha_arcsec": 0.62, "forward d_beta_arcsec": float("nan")},
            1.5,
            False,
            tuple(requirements),
        )

    def smoothed(self, times: Any) -> Course:
        return self._course(times)

    def forecast(self, times: Any) -> Course:
        return self._course(times)

    def motions(self, time: int) -> Motions:
        """Every third motion grows to two of its standard deviations, the others to a tenth of that."""
        stated = self.experiment.prior.components
        size = np.array([one.sigma / one.unit_size for one in stated])
        mean = 0.1 * (time - START) / DAY * size * np.where(np.arange(len(size)) % 3 == 0, 1.0, 0.1)
        labels, units = zip(*((one.name, one.unit) for one in stated), strict=True)
        return Motions(time, labels, units, mean, 0.3 * np.diag(size**2))


def lived(folder: Path, days: float = 80.0) -> tuple[Path, Path]:
    """A plan, and a record that keeps it, of a simulated life of `tests.twin.operation_records`; a mount slips."""
    setup = plan_of(folder)
    own = MonitorExperiment(setup.model, load_backend())
    stated = own.disturbances
    assert stated is not None
    slip = {50.0: {stated.labels.index("base/backward/M2 shift x"): 60.0}}
    life = life_of(stated, days, 4, 3, slip)
    with record_of(folder / "record", setup) as history:
        entries = [own_entry(own, stated, life, k, 3) for k in range(len(life.times))]
        entries.append(Entry("event", "safe_mode", int(life.times[0]) + 30 * DAY + HOUR, {}))
        history.ingest(given("all", sorted(entries, key=lambda one: one.time)))
        store_plan(setup, folder / "plan.yaml", history)
    return folder / "record", folder / "plan.yaml"
