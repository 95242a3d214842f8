"""Measured readings of a turntable, and spots of a camera on it, read from tables for the analysis.

Rows are sorted before anything is computed, so that their order in a file does not change any digit of a result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.orientation.interior import CALIBRATED, Spots
from analysis.turntable.dividing_error import CalibrationSeries, covered, gaps
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera_tests import DistortionFiles, TurntableFiles
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import digest_of
from scenes.yaml.units import ANGLE, LENGTH

Integers = NDArray[np.int64]
MAX_ANGLES = 3000
"""Largest number of different angles of a series: the fits have matrices with this many rows and columns."""
MAX_CELLS = 30_000_000
"""Largest product of number of angles and number of repeats, to limit memory."""
READING_TOLERANCE = 1e-9
"""Difference below which two readings are repeats of the same angle, radians (0.0002 arcsec)."""
MAX_DIFFERENCE_CHANGE = np.radians(1.0)
"""Largest plausible change over the region of turntable minus reference, radians; dividing errors are smaller."""
CIRCLE = 2.0 * np.pi
# Columns that number repeats; largest fraction of rows that rounding makes equal; least number of such rows.
_COUNTS, _COPIED, _LEAST_SET = ("set", "repeat"), 0.8, 3
READING = Column("reading", ANGLE, least=-2.0 * CIRCLE, most=2.0 * CIRCLE)
COMPARISON_COLUMNS = (
    READING,
    Column("difference", ANGLE, needed=False),
    Column("reference", ANGLE, needed=False),
    Column("position", needed=False, whole=True, least=-1e9, most=1e9),
    Column("repeat", needed=False, whole=True, least=-1e9, most=1e9),
)
SPOT_COLUMNS = (
    READING,
    Column("along", LENGTH, needed=False),
    Column("column", needed=False),
    Column("sigma", LENGTH, needed=False, least=0.0),
    Column("fixed sigma", LENGTH, needed=False, least=0.0),
    Column("column sigma", needed=False, least=0.0),
    Column("column fixed sigma", needed=False, least=0.0),
    Column("across", LENGTH, needed=False),
    Column("point", needed=False, whole=True, least=-1e9, most=1e9),
    Column("set", needed=False, whole=True, least=-1e9, most=1e9),
)


@dataclass(frozen=True)
class DataFile:
    """Data file that was read, identified so that a result can be checked against its data.

    Attributes
    ----------
    file : str
        Path of the file.
    rows : int
        Number of rows below the column names.
    sha256 : str
        SHA-256 of its contents.
    copied : int
        Number of rows that repeat another one to the last digit, which suggests copied data. They are counted only if
        all rows of a set do, or, where sets have no number, most of the rows that repeat a measurement; else 0.
    """

    file: str
    rows: int
    sha256: str
    copied: int

    @classmethod
    def of(cls, table: Table, where: Sequence[str]) -> DataFile:
        """Return the description of a table's file.

        Rows with equal values in the columns named in ``where`` repeat the same measurement.
        """
        code = {name: np.unique(each, return_inverse=True)[1].ravel() for name, each in table.columns.items()}
        copy, again = np.ones((2, len(table)), bool)
        for rows, names in ((copy, set(code) - set(_COUNTS)), (again, set(code) & set(where))):
            rows[np.unique(np.column_stack([code[name] for name in names]), axis=0, return_index=True)[1]] = False
        number = next((code[name] for name in _COUNTS if name in code), np.where(again, 1, 0))
        copied = np.bincount(number, copy) > np.maximum(_COPIED * np.bincount(number), _LEAST_SET)
        return cls(table.file, len(table), digest_of(Path(table.file)), int(copy.sum()) if np.any(copied) else 0)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about the contents of the file, such as copied rows."""
        text = f"{self.copied} rows of {self.file} of a repeated measurement equal another one to the last digit"
        return (f"{text}: were they copied? All count in the sigmas",) if self.copied else ()


@dataclass(frozen=True, eq=False)
class Comparisons:
    """Measured series of comparisons of a turntable's readings with a reference.

    Attributes
    ----------
    series : CalibrationSeries
        Series for the analysis.
    lines : (N, repeats) ndarray of int
        Line in the file of each comparison at N readings; 0 where none was made.
    file : DataFile
        File that holds the series.
    head : str
        Name of its column of readings.
    """

    series: CalibrationSeries
    lines: Integers
    file: DataFile
    head: str


@dataclass(frozen=True, eq=False)
class SpotReadings:
    """Measured spots on a camera's line for turntable readings at N points, repeated in S sets.

    Attributes
    ----------
    reading : (N, S) ndarray
        Readings of the turntable, radians.
    spots : Spots
        Spots on the line.
    present : (N, S) ndarray of bool, or None
        Spots that were measured; None for all.
    across : (N, S) ndarray, or None
        Positions of the spots across the line, metres; None if the table has no such column.
    lines : (N, S) ndarray of int
        Lines in the file; 0 where nothing was measured.
    file : DataFile
        File that holds the spots.
    head : str
        Name of its column of readings.
    numbered : bool
        True if the sets have numbers in the file.
    """

    reading: Array
    spots: Spots
    present: NDArray[np.bool_] | None
    across: Array | None
    lines: Integers
    file: DataFile
    head: str
    numbered: bool


def read_turntable(files: TurntableFiles) -> tuple[Comparisons, ...]:
    """Read the calibration of a turntable and, if there is one, the series at held-out readings.

    Raises
    ------
    InputError
        A table cannot be used; the message has file, line and column.
    """
    series = read_comparisons(files.comparisons, files.reference)
    if files.held_out is None:
        return (series,)
    calibrated = series.series.angle
    middle = 0.5 * float(calibrated[0] + calibrated[-1])
    held_out = read_comparisons(files.held_out, files.reference, fewest=1, around=middle)
    beyond = ~covered(calibrated, held_out.series.angle)
    if np.any(beyond):
        k = int(np.argmax(beyond))
        reading = f"{np.degrees(held_out.series.angle[k]):.9g} deg"
        allowed = f"{calibrated_text(calibrated)}, as {files.comparisons} has it"
        line = int(held_out.lines[k].max())
        text = "a held-out reading beyond the calibrated ones"
        raise InputError(Issue(text, held_out.file.file, line, (held_out.head,), reading, allowed))
    return series, held_out


def calibrated_text(angle: Array) -> str:
    """Describe the region in which a turntable is calibrated, and the gaps in it, from its N angles, (N,)."""
    holes = [f"{a:.9g} to {b:.9g}" for a, b in np.degrees(gaps(angle))]
    first, last = np.degrees(angle[[0, -1]])
    return f"{first:.9g} to {last:.9g} deg" + (f" without the gaps {', '.join(holes)} deg" if holes else "")


def unwrapped(reading: Array, around: float | None = None) -> Array:
    """Return angle readings of a circle unwrapped, so that they have no jump of 360 deg.

    Parameters
    ----------
    reading : (N,) ndarray
        The N readings, radians.
    around : float, optional
        Reading from which none shall be farther than half a turn. By default the circle is cut in its widest arc
        without a reading: 350, 355, 0, 5 deg become -10, -5, 0, 5 deg.
    """
    if around is not None:
        return reading - CIRCLE * np.rint((reading - around) / CIRCLE)
    rank = np.sort(reading)
    steps = np.diff(rank)
    if not len(steps) or np.max(steps) <= CIRCLE - (rank[-1] - rank[0]):
        return reading
    return np.where(reading > rank[int(np.argmax(steps))], reading - CIRCLE, reading)


def read_comparisons(path: str, reference_sigma: float, fewest: int = 4, around: float | None = None) -> Comparisons:
    """Read a table of comparisons of a turntable with a reference.

    Parameters
    ----------
    path : str
        Path of the CSV file.
    reference_sigma : float
        Standard deviation from the certificate of the reference, radians.
    fewest : int
        Smallest allowed number of different angles.
    around : float, optional
        Reading around which the circle is unwrapped, as in `unwrapped`.

    Raises
    ------
    InputError
        The table cannot be used; the message has file, line and column.
    """
    table = read_table(path, COMPARISON_COLUMNS, 2)
    if ("difference" in table) is ("reference" in table):
        columns = "neither" if "difference" not in table else "both"
        allowed = "'difference [arcsec]', reading minus reference, or 'reference [deg]'"
        raise InputError(Issue("a column with the reading of the reference is needed", path, 1, (), columns, allowed))
    reading = unwrapped(table["reading"], around)
    table = replace(table, columns=FrozenMap({**table.columns, "reading": reading}))
    if "difference" in table:
        value = table["difference"]
    else:
        value = reading - table["reference"]
        # whole turns only, so that the order of rows changes no bit
        value = value - CIRCLE * (np.rint((value - value[0]) / CIRCLE) + np.rint(value[0] / CIRCLE))
    group = _groups(table)
    # sort repeats by their number, else by their value, so that the order of rows does not matter
    order = np.lexsort((value, table["repeat"] if "repeat" in table else value, group))
    cells = _Cells(table, group[order], order)
    if "repeat" in table:
        cells.refuse_twice(table["repeat"], "repeat")
    angle = cells.centre(reading)
    _check_angles(cells, angle, fewest)
    _check_positions(cells, reading, angle)
    few = cells.count < 2
    if np.any(few):
        remedy = (
            "2 or more of each, 5 for Chauvenet's criterion to reject any; where the table does not return to the "
            "same reading, a column 'position' that numbers the stops"
        )
        text = "a single repeat of this reading, from which its noise cannot be estimated"
        raise table.error(int(cells.first[int(np.argmax(few))]), "reading", text, allowed=remedy)
    matrix = cells.matrix(value)
    present = cells.present
    mean = np.sum(matrix, axis=1) / cells.count
    if np.ptp(mean) > MAX_DIFFERENCE_CHANGE:
        worst = int(np.argmax(np.abs(mean - np.median(mean))))
        name = "difference" if "difference" in table else "reference"
        text = f"the difference from the reference changes by {np.degrees(np.ptp(mean)):.3g} deg over the region"
        meant = "reading minus reference, both with the same sense of rotation and in the unit of the head"
        raise table.error(int(cells.first[worst]), name, text, allowed=f"less than 1 deg: {meant}")
    series = CalibrationSeries(angle, matrix, reference_sigma, present=None if np.all(present) else present)
    return Comparisons(series, cells.matrix(table.lines, 0), DataFile.of(table, ["reading"]), table.heads[READING.name])


def read_spots(files: DistortionFiles) -> SpotReadings:
    """Read a table of turntable readings and spots.

    Parameters
    ----------
    files : DistortionFiles
        Section ``measured`` of the test's file.

    Raises
    ------
    InputError
        The table cannot be used; the message has file, line and column.
    """
    table = read_table(files.spots, SPOT_COLUMNS, len(CALIBRATED))
    positions, sigma, fixed = _spot_positions(table, files)
    numbered = "point" in table
    if "set" in table and not numbered:
        raise InputError(Issue("sets of points without numbers", files.spots, 1, allowed="a column 'point' as well"))
    reading = unwrapped(table["reading"], files.zero)
    rows = np.argsort(np.argsort(reading, kind="stable"))
    group = np.unique(table["point"], return_inverse=True)[1] if numbered else rows
    sets = table["set"] if "set" in table else np.zeros(len(table))
    order = np.lexsort((positions, reading, sets, group))
    cells = _Cells(table, group[order], order)
    if "set" in table:
        cells.refuse_twice(sets, "set")
        slot = np.unique(sets[order], return_inverse=True)[1]
    else:
        slot = cells.slot
    cells = cells.at(slot)
    _few_points(table, cells, sets if "set" in table else None)
    present = cells.present
    single = cells.count < 2
    if present.shape[1] > 1 and np.any(single):
        row = int(cells.first[int(np.argmax(single))])
        text = "a single spot of this point in a test of several sets"
        raise table.error(row, "point", text, allowed="2 or more of each, 5 for Chauvenet's criterion to reject any")
    # a missing spot gets a value of its point, which no mean uses
    filled = {name: cells.matrix(value, None) for name, value in (("reading", reading), ("where", positions))}
    spots = Spots(filled["where"], cells.matrix(sigma), cells.matrix(fixed), np.zeros(present.shape))
    if present.shape[1] == 1 and sigma is not None and not np.all(sigma > 0.0) and files.turntable is None:
        row = int(np.argmin(sigma))
        name = "sigma" if "along" in table else "column sigma"
        text = "a single set of points without sigmas, from which their noise cannot be estimated"
        shown = name if name in table else ""
        raise table.error(row, shown, text, allowed=f"a column '{name}' above zero, or two sets or more")
    # points in the order of their readings
    rank = np.argsort(np.mean(filled["reading"], axis=1), kind="stable")
    spots = Spots(spots.position[rank], spots.temporal[rank], spots.fixed[rank], spots.row[rank])
    across = cells.matrix(table["across"], None)[rank] if "across" in table else None
    lines = cells.matrix(table.lines, 0)[rank]
    mask = None if np.all(present) else present[rank]
    file = DataFile.of(table, ["point" if numbered else "reading"])
    head, named = table.heads[READING.name], "set" in table
    return SpotReadings(filled["reading"][rank], spots, mask, across, lines, file, head, named)


def _spot_positions(table: Table, files: DistortionFiles) -> tuple[Array, Array, Array]:
    """Return the spots' positions along the line and their sigmas, (rows,) each, metres.

    The first sigma is of the error that is independent in every exposure, the second of one that is fixed.
    """
    if ("along" in table) is ("column" in table):
        value = "neither" if "along" not in table else "both"
        text = "a column with the positions of the spots is needed"
        allowed = "'along [mm]' from the line's middle, or 'column' with `line:` in the test's file"
        raise InputError(Issue(text, files.spots, 1, (), value, allowed))
    none = np.zeros(len(table))
    if "along" in table:
        wrong = next((n for n in ("column sigma", "column fixed sigma") if n in table), None)
        if wrong is not None:
            raise table.error(0, wrong, "a sigma in pixels for positions in lengths", allowed=f"'{wrong[7:]} [um]'")
        return table["along"], table.columns.get("sigma", none), table.columns.get("fixed sigma", none)
    wrong = next((n for n in ("sigma", "fixed sigma") if n in table), None)
    if wrong is not None:
        raise table.error(0, wrong, "a sigma in lengths for positions in pixels", allowed=f"'column {wrong}'")
    if files.line is None:
        text, allowed = "positions in pixels need the pixel pitch of the line", "line: {pitch: 7 um, middle: 6143.5}"
        raise files.error(text, ("spots",), value="column", allowed=allowed)
    pitch = files.line.pitch
    temporal, fixed = (table.columns.get(n, none) for n in ("column sigma", "column fixed sigma"))
    return (table["column"] - files.line.middle) * pitch, temporal * pitch, fixed * pitch


def _few_points(table: Table, cells: _Cells, sets: Array | None) -> None:
    """Raise InputError for too few points, in total or in one set, or for more points than fit into memory."""
    count, need = len(cells.count), len(CALIBRATED) + 2
    if count < need or count > MAX_ANGLES:
        few, many = f"{need} or more, over the whole field", f"at most {MAX_ANGLES}; 'point' numbers them"
        text, remedy = ("too few points", few) if count < need else ("too many points", many)
        raise table.error(0, "", text, str(count), remedy)
    points_per_set = cells.present.sum(axis=0)
    if np.min(points_per_set) < need:
        k = int(np.argmin(points_per_set))
        row = int(cells.order[np.flatnonzero(cells.slot == k)[0]])
        name = "point" if sets is None else "set"
        text = f"a set of {points_per_set[k]} points"
        raise table.error(row, name if name in table else "", text, allowed=f"{need} or more in every set")


def _groups(table: Table) -> Integers:
    """Return the number of the nominal angle to which each row belongs, (rows,), increasing with the readings."""
    reading = table["reading"]
    if "position" in table:
        _, group = np.unique(table["position"], return_inverse=True)
        # the smallest reading of a stop has the order of the means where no two stops overlap, and
        # does not depend on the order of rows by rounding
        least = np.full(int(group.max()) + 1, np.inf)
        np.minimum.at(least, group, reading)
        return np.asarray(np.argsort(np.argsort(least, kind="stable"))[group], np.int64)
    order = np.argsort(reading, kind="stable")
    new = np.concatenate([[0], np.cumsum(np.diff(reading[order]) > READING_TOLERANCE)])
    group = np.empty(len(reading), np.int64)
    group[order] = new
    return group


class _Cells:
    """Rows of a table arranged as a matrix: a matrix row for each group (such as an angle) of table rows.

    Parameters
    ----------
    table
        Table with the lines.
    group
        Group of each sorted line, (lines,), non-decreasing.
    order
        Index in the table of each sorted line, (lines,).
    slot
        Column of each sorted line in the matrix; by default members of a group one after the other.
    """

    def __init__(self, table: Table, group: Integers, order: Integers, slot: Integers | None = None) -> None:
        self.table, self.order = table, order
        _, start, self.group, self.count = np.unique(group, return_index=True, return_inverse=True, return_counts=True)
        self.first = order[start]
        self.slot = np.arange(len(order)) - start[self.group] if slot is None else slot
        width = int(self.slot.max()) + 1
        if len(self.count) * width > MAX_CELLS:
            text = f"{len(self.count)} angles with up to {width} repeats each"
            raise table.error(0, "", "too many for the memory", text, "fewer repeats")
        self.present = np.zeros((len(self.count), width), bool)
        self.present[self.group, self.slot] = True

    def at(self, slot: Integers) -> _Cells:
        """Return the same lines arranged with the given matrix columns."""
        return _Cells(self.table, self.group, self.order, slot)

    def matrix(self, value: Array | Integers, empty: float | None = 0.0) -> np.ndarray:
        """Return values of the table's lines as a matrix: a row for each group, a column for each member.

        Empty cells get ``empty``, or if that is None the first value of their group.
        """
        values = np.asarray(value)
        start = values[self.first] if empty is None else np.full(len(self.count), empty, values.dtype)
        out = np.repeat(start[:, None], self.present.shape[1], axis=1)
        out[self.group, self.slot] = values[self.order]
        return out

    def centre(self, value: Array) -> Array:
        """Return the mean of each of N groups, (N,), without rounding error where all its values are equal."""
        least, most = (np.full(len(self.count), side) for side in (np.inf, -np.inf))
        np.minimum.at(least, self.group, value[self.order])
        np.maximum.at(most, self.group, value[self.order])
        mean = np.bincount(self.group, value[self.order]) / self.count
        return np.where(least == most, least, mean)

    def refuse_twice(self, number: Array, name: str) -> None:
        """Raise InputError if two rows of a group have the same number (such as that of a set) in a column."""
        numbers = number[self.order]
        same = (np.diff(self.group) == 0) & (np.diff(numbers) == 0)
        if np.any(same):
            k = int(np.argmax(same))
            first, again = sorted((int(self.order[k]), int(self.order[k + 1])))
            text = f"the same {name} twice, first in line {self.table.lines[first]}"
            raise self.table.error(again, name, text, f"{numbers[k]:g}", "every number once for each angle")


def _check_angles(cells: _Cells, angle: Array, fewest: int) -> None:
    """Raise InputError for too few different readings, or more than fit into memory."""
    count = len(angle)
    if fewest <= count <= MAX_ANGLES:
        return
    few = f"{fewest} or more; where the table does not return to the same reading, a column 'position'"
    many = f"at most {MAX_ANGLES}; a column 'position' numbers the stops of the table"
    text, remedy = ("few", few) if count < fewest else ("many", many)
    raise cells.table.error(0, READING.name, f"too {text} different readings", str(count), remedy)


def _check_positions(cells: _Cells, reading: Array, angle: Array) -> None:
    """Raise InputError for repeated readings that are too far from the mean of their nominal angle.

    The limit is half the distance between that mean and the next one.
    """
    if "position" not in cells.table or len(angle) < 2:
        return
    same = np.diff(angle) == 0.0
    if np.any(same):
        rows = sorted(int(row) for row in cells.first[int(np.argmax(same)) :][:2])
        text = f"two positions with the same readings, the other in line {cells.table.lines[rows[0]]}"
        allowed = "the same number for all comparisons of a stop, however often the table returned to it"
        raise cells.table.error(rows[1], "position", text, f"{cells.table['position'][rows[1]]:g}", allowed)
    rank = np.sort(angle)
    at = np.searchsorted(rank, angle)
    gap = np.diff(rank)
    room = 0.5 * np.minimum(np.concatenate([[np.inf], gap])[at], np.concatenate([gap, [np.inf]])[at])
    beyond = np.abs(reading[cells.order] - angle[cells.group]) > room[cells.group]
    if np.any(beyond):
        row = int(cells.order[int(np.argmax(beyond))])
        text = "a reading that is nearer to those of another position"
        raise cells.table.error(row, "reading", text, allowed="the position's own number in this row")
