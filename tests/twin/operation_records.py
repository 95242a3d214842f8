"""Records of an instrument whose motions are drawn by the stated laws and move spots as they are computed to."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.monitor.disturbances import Disturbances, TimeLaw
from scenes.specs.operation import OperationSetup, read_operation
from scenes.specs.resolved import resolve_with
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.operate.estimate.operation_filter import Operation
from twin.operate.record.entries import MICRO, Entry, FileContent, digest_of_data, micros
from twin.operate.record.history import History, initialise_record

DAY = 86_400.0
START = micros("2026-03-01T00:00:00Z")
NOISE = 0.002
"""Px of a spot's coordinate."""
PLAN = """instrument: {instrument}
disturbances: {disturbances}
events: {{safe_mode: [settling]}}
mission: 8766 h
requirements: [{{quantity: intersection_angle change_arcsec, limit: 30 arcsec}}]
"""
DISTURBANCES = """name: own
description: mounts that drift, heat with the seasons, and slips
causes:
  mounts:
    bodies: base/<camera>
    rotate: 1 arcsec
    time: {drift: 2400 h}
    reason: a test
  heat:
    bodies: base/<camera>
    temperature: {change: 1 K}
    time: {period: 2400 h, drift: 9000 h}
    reason: a test
  settling:
    bodies: base/*/M?
    shift: 2 um
    time: {jump: 8766 h}
    reason: a test
"""


@dataclass(frozen=True, eq=False)
class Life:
    """Of a drawn instrument.

    Attributes:
        times: (T,) microseconds; motions: (T, M) in standard deviations; changes: (T, 4 K).
    """

    times: np.ndarray
    motions: np.ndarray
    changes: np.ndarray


def plan_of(folder: Path, instrument: str = "monitor_pair") -> OperationSetup:
    """The plan above, as a user's file."""
    (folder / "own.yaml").write_text(DISTURBANCES)
    (folder / "plan.yaml").write_text(PLAN.format(instrument=instrument, disturbances="own.yaml"))
    return read_operation(folder / "plan.yaml")


def drawn(law: TimeLaw, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(T,) one course of a law, by the covariance of all its times; jumps do not come by themselves."""
    covariance = law.covariance(times[:, None], times) + 1e-10 * np.eye(len(times))
    return np.linalg.cholesky(covariance) @ rng.standard_normal(len(times)) if not law.jump else np.zeros(len(times))


def life_of(stated: Disturbances, days: float, every: float, seed: int, slips: dict[float, dict[int, float]]) -> Life:
    """Motions by their laws, and slips: day -> motion -> amount."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0.0, days, every) * DAY
    motions = np.stack([drawn(law, seconds, rng) for law in stated.laws], axis=1)
    for day, own in slips.items():
        for motion, amount in own.items():
            motions[:, motion] += np.where(seconds >= day * DAY, amount, 0.0)
    return Life(START + np.round(seconds * MICRO).astype(np.int64), motions, motions @ stated.parameters.T)


def monitor_entry(experiment: MonitorExperiment, stated: Disturbances, life: Life, k: int, seed: int) -> Entry:
    """The reading number k, with noise."""
    rng = np.random.default_rng([seed, k])
    shifts = (stated.spots @ life.motions[k]).reshape(-1, 2) + NOISE * rng.standard_normal((len(stated.spots) // 2, 2))
    spots: dict[str, dict[str, object]] = {}
    channels = [(name, channel) for name, one in experiment.cameras.items() for channel in one.channels]
    for (camera, channel), shift in zip(channels, shifts.tolist(), strict=True):
        sigma = {"row_sigma": NOISE, "column_sigma": NOISE}
        before = {"row": 30.0, "column": 30.0, "row_sigma": 1e-9, "column_sigma": 1e-9}
        spots.setdefault(camera, {})[channel] = {
            "before": before,
            "after": {"row": 30.0 + shift[0], "column": 30.0 + shift[1], **sigma},
        }
    content = {"sha256": "0" * 64, "state": k, "numbers": {"cameras": {}, "spots": spots, "sigma_holds": True}}
    return Entry("monitor", "monitor", int(life.times[k]), content, None, digest_of_data([seed, k]))


def temperature_entry(body: str, time: int, kelvin: float, sigma: float = 0.05) -> Entry:
    return Entry("temperature", body, time, {"values": [kelvin], "sigma": sigma, "unit": "K"}, None)


def entries_of(
    known: tuple, life: Life, seed: int, factor: float = 1.0, sensor=lambda body, k, kelvin: kelvin
) -> list[Entry]:
    """All that the instrument sends down.

    Args:
        known: plan, its experiment and what is stated to move.
        life: of the instrument.
        seed: of the noise.
        factor: of what heat really does over the computed: sensors read as much less.
        sensor: what a sensor says of what it should say; None for nothing.
    """
    _, experiment, stated = known
    rng = np.random.default_rng([seed, 7])
    out = []
    for k, time in enumerate(life.times.tolist()):
        for m, label in enumerate(stated.labels):
            if label.endswith(" temperature"):
                body = stated.bodies[m]
                kelvin = 293.15 + life.motions[k, m] / factor + 0.05 * rng.normal()
                told = sensor(body, k, kelvin)
                out += [] if told is None else [temperature_entry(body, time, told)]
        out.append(monitor_entry(experiment, stated, life, k, seed))
    return out


def given(name: str, entries: list[Entry]) -> FileContent:
    return FileContent(name, digest_of_data(name), digest_of_data([name, "m"]), entries, {})


def record_of(folder: Path, plan: OperationSetup) -> History:
    """An empty record of the plan's instrument."""
    initialise_record(str(folder), resolve_with("monitor_pair"), True)
    return History(str(folder))


def operation(history: History, plan: OperationSetup) -> Operation:
    return Operation(history, plan)
