"""The published focus law of the Hubble Space Telescope's secondary mirror, and readings drawn by it, in plain NumPy.

Source: instrument science reports of STScI on the focus of the telescope: secular A + B exp(-C t) with a slope from MJD
55643, breathing by temperatures of which one counts from its mean of eight samples, and commanded moves, in micrometres
of the mirror. Nothing here uses the program's models.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from scenes.specs.operation import OperationSetup, read_operation
from scenes.specs.resolved import resolve_with
from twin.operate.record.entries import MICRO, Entry, FileContent, digest_of_data, micros, utc_text
from twin.operate.record.history import History, initialise_record

EXAMPLE = Path(__file__).resolve().parents[2] / "scenes/examples/focus_life.yaml"
DAY = 86_400.0
LAUNCH = date(1990, 4, 24)
ORIGIN = micros("1990-04-24T00:00:00Z")
LAST, AMPLITUDE, RATE, BREAK, LATE_SLOPE = 5.17, 269.93, 6.366e-4, date(2011, 3, 23), -3.31505e-3
"""Constant after the last move [um], decaying part [um], its rate [1/day], date of the slope, slope [um/day]."""
MOVES = {
    "1994-03-07": 95.0,
    "1994-06-29": 5.0,
    "1995-01-15": 5.0,
    "1995-08-28": 6.5,
    "1996-03-14": 6.0,
    "1996-10-30": 5.0,
    "1997-03-18": -2.4,
    "1998-01-12": 21.0,
    "1998-02-01": -18.6,
    "1998-06-04": 16.6,
    "1998-06-28": -15.2,
    "1999-09-15": 3.0,
    "2000-01-09": 4.2,
    "2000-06-15": 3.6,
    "2002-12-02": 3.6,
    "2004-12-22": 4.16,
    "2006-07-31": 5.34,
    "2009-07-20": 2.97,
    "2013-01-24": 3.6,
    "2013-11-12": 2.97,
    "2015-02-05": 1.78,
}
"""Date -> commanded move, um."""
INPUTS = {"aft_light_shield": 0.48, "truss_axial": 0.81, "aft_shroud": -0.28, "forward_shell": 0.18}
"""Input -> um per degC."""
LIGHT_SHIELD, SAMPLES, STEP, OFFSET = 0.55 * 0.7, 8, 300.0, -9.88
"""Coefficient of the light shield relative to its mean of the last samples, their number and spacing in s, and the
constant of the breathing law, um."""
SCATTER, SENSOR = 2.0, 0.05
MIRROR = "base/ritchey_chretien/M2 shift z"


@dataclass(frozen=True, eq=False)
class Life:
    """Drawn readings.

    Attributes:
        days: (N,) since launch; focus: (N,) um, without noise; read: (N,) with it; inputs: name -> (N,) degC;
        shield: (N, 8) samples of the light shield, the last one at the reading.
    """

    days: np.ndarray
    focus: np.ndarray
    read: np.ndarray
    inputs: dict[str, np.ndarray]
    shield: np.ndarray


def days_since_launch(text: str | date) -> int:
    day = date.fromisoformat(text) if isinstance(text, str) else text
    return (day - LAUNCH).days


def secular(days: np.ndarray, moved: bool = True) -> np.ndarray:
    """Law without breathing; its constant is the published one after all moves."""
    out = LAST - sum(MOVES.values()) + AMPLITUDE * np.exp(-RATE * days)
    out = out + LATE_SLOPE * np.maximum(days - days_since_launch(BREAK), 0.0)
    return out + sum(size * (days >= days_since_launch(day)) for day, size in MOVES.items()) * moved


def drawn(seed: int, first: float = 120.0, last: float = 9200.0, every: float = 20.0) -> Life:
    """A life from day to day after launch, with readings at random intervals."""
    rng = np.random.default_rng(seed)
    gaps = every * rng.uniform(0.5, 1.5, round((last - first) / every))
    days = np.round((first + np.cumsum(gaps)) * DAY) / DAY
    common = rng.normal(0.0, 1.5, len(days))  # the telescope's attitude to the sun warms all parts
    means = {"aft_light_shield": 6.0, "truss_axial": 9.0, "aft_shroud": 8.0, "forward_shell": 4.0}
    inputs = {name: means[name] + common + rng.normal(0.0, 2.0, len(days)) for name in INPUTS}
    shield = 4.0 + common[:, None] + np.cumsum(rng.normal(0.0, 1.2, (len(days), SAMPLES)), axis=1)
    focus = secular(days) + OFFSET + LIGHT_SHIELD * (shield[:, -1] - shield.mean(axis=1))
    focus = focus + sum(INPUTS[name] * values for name, values in inputs.items())
    return Life(days, focus, focus + rng.normal(0.0, SCATTER, len(days)), inputs, shield)


def micros_of(day: float) -> int:
    return ORIGIN + round(day * DAY) * MICRO


def entries_of(life: Life, seed: int, shown: slice = slice(None)) -> list[Entry]:
    """Readings of focus and of the inputs, these with the noise of their sensors."""
    rng = np.random.default_rng([seed, 1])
    out = []
    for k in range(len(life.days))[shown]:
        time = micros_of(life.days[k])
        content = {"values": [1e-6 * life.read[k]], "sigma": 1e-6 * SCATTER, "unit": "m"}
        out.append(Entry("focus", "ritchey_chretien", time, content))
        kelvin = {"sigma": SENSOR, "unit": "K"}
        samples = {name: [values[k]] for name, values in life.inputs.items()} | {"light_shield": life.shield[k]}
        for name, values in samples.items():
            for i, value in enumerate(values):
                at = time - round(STEP * (len(values) - 1 - i)) * MICRO
                read = 273.15 + value + SENSOR * rng.normal()
                out.append(Entry("input", name, at, {**kelvin, "values": [read]}))
    return sorted(out, key=lambda one: one.time)


def move_entry(day: str, size: float, sigma: float = 0.3, time_sigma: float = 0.0, hour: float = 0.0) -> Entry:
    content = {"values": [1e-6 * size], "sigma": 1e-6 * sigma, "unit": "m", "time_sigma": time_sigma}
    return Entry("move", MIRROR, micros(f"{day}T00:00:00Z") + round(3600.0 * hour) * MICRO, content)


def given(name: str, entries: list[Entry]) -> FileContent:
    return FileContent(name, digest_of_data([name, [one.digest for one in entries]]), "", entries, {})


def plan(folder: Path, changes: dict[str, str] | None = None, causes: str = "") -> OperationSetup:
    """The shipped plan with parts of its text changed, and with other causes of disturbance."""
    text, disturbances = EXAMPLE.read_text(), (EXAMPLE.parent / "focus_disturbances.yaml").read_text()
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    head = disturbances[: disturbances.index("causes:")]
    folder.mkdir(exist_ok=True)
    (folder / "focus_disturbances.yaml").write_text(f"{head}causes:\n{causes}" if causes else disturbances)
    (folder / "plan.yaml").write_text(text)
    return read_operation(folder / "plan.yaml")


def cause(name: str, sigma: str, law: str) -> str:
    place = f"{{bodies: base/<camera>/M2, shift: [0 um, 0 um, {sigma}], time: {{{law}}}, reason: a test}}"
    return f"  {name}: {place}\n"


BLIND = cause("jumps", "5 um", "jump: 8766 h")
"""Moves are not told: one a year."""
LAW_ALONE = cause("creep", "0.05 um", "drift: 4800 h")


def tables(seed: int = 1990, every: float = 90.0) -> dict[str, str]:
    """The tables of the shipped example: file -> text."""
    life = drawn(seed, every=every)
    rng = np.random.default_rng([seed, 2])
    focus, inputs = ["time,focus_um"], [f"time,{','.join(INPUTS)},light_shield"]
    for k, day in enumerate(life.days):
        time = micros_of(day)
        focus.append(f"{utc_text(time)},{life.read[k]:.2f}")
        for i, shield in enumerate(life.shield[k].tolist()):
            last = i == SAMPLES - 1
            cells = [f"{v[k] + SENSOR * rng.normal():.2f}" if last else "" for v in life.inputs.values()]
            at = time - round(STEP * (SAMPLES - 1 - i)) * MICRO
            inputs.append(",".join([utc_text(at), *cells, f"{shield + SENSOR * rng.normal():.2f}"]))
    moves = ["date,move_um", *(f"{day}T00:00:00Z,{size}" for day, size in MOVES.items())]
    rows = {"focus.csv": focus, "inputs.csv": inputs, "moves.csv": moves}
    return {name: "\n".join(lines) + "\n" for name, lines in rows.items()}


def record_of(folder: Path, *files: list[Entry]) -> History:
    initialise_record(str(folder), resolve_with("ritchey_chretien"), True)
    history = History(str(folder))
    for k, entries in enumerate(files):
        taken = history.ingest(given(f"file {k}", entries))
        assert not taken.refused, taken.refused[:2]
    return history
