"""Tables of measurements with a million rows: an attitude in orbit, comparisons of a turntable in the laboratory."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.specs.measured.orbit_data import ConventionsSpec
from scenes.yaml.csv_table import read_table
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.workbench import Workbench
from tests.benchmarks.yardsticks import pace
from twin.laboratory.measured_readings import read_comparisons
from twin.orbit.measured.measurement_tables import COLUMNS, CONVENTIONS
from twin.orbit.measured.platform_readings import platform_of

ROWS, QUICK_ROWS = 1_000_000, 20_000
PACE = pace(python=0.8, memory=0.2)


def attitude(folder: Path, rows: int) -> Callable[[], int]:
    """Writes readings of a platform on a circle; reads and checks them."""
    seconds = np.linspace(0.0, 1e-3 * rows, rows)
    turn = Rotation.from_rotvec(1e-3 * seconds[:, None] * [0.1, 1.0, 0.2]).as_quat()
    _written(folder / "attitude.csv", "time [s],q1,q2,q3,q4", seconds, *turn.T)
    moments = np.linspace(-1.0, 1e-3 * rows + 1.0, 200)
    angle = moments * 1.1e-3
    place = 6.878e6 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    _written(folder / "orbit.csv", "time [s],x [m],y [m],z [m]", moments, *place)

    def read() -> int:
        orbit, looks = (read_table(folder / f"{key}.csv", COLUMNS[key], 2) for key in ("orbit", "attitude"))
        conventions = ConventionsSpec.model_validate(CONVENTIONS)
        return len(platform_of("2020-01-01T00:00:00Z", orbit, looks, conventions).attitude_time)

    return read


def comparisons(folder: Path, rows: int) -> Callable[[], int]:
    """Writes repeats at 1000 positions; reads them."""
    random = np.random.default_rng(1)
    position = np.repeat(np.arange(1000), rows // 1000)
    reading = 90.0 + 0.02 * position
    difference = random.normal(0.0, 0.1, position.size)
    repeat = np.tile(np.arange(rows // 1000), 1000)
    head = "position,repeat,reading [deg],difference [arcsec]"
    _written(folder / "comparisons.csv", head, position, repeat, reading, difference)
    return lambda: int(np.sum(read_comparisons(str(folder / "comparisons.csv"), 1e-7).lines > 0))


def _written(file: Path, head: str, *columns: np.ndarray) -> None:
    cells = [map(repr, column.tolist()) for column in columns]
    file.write_text("\n".join([head, *map(",".join, zip(*cells, strict=True))]) + "\n")


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds of a processor to read either; writing is not counted."""
    rows = QUICK_ROWS if quick else ROWS
    numbers = []
    with TemporaryDirectory() as name:
        for key, text, prepare in (
            ("attitude", "attitude in orbit", attitude),
            ("comparisons", "comparisons of a turntable", comparisons),
        ):
            read = prepare(Path(name), rows)
            bench.look()
            begun = time.process_time()
            count = read()
            seconds = time.process_time() - begun
            assert count == rows
            numbers.append(Number(f"{key}_s", seconds, f"{text}, {rows:,} rows", "s", PACE, limited=True))
    return Speed(tuple(numbers))
