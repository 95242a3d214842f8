"""Reader of nodes of finite-element programs with displacements or temperatures.

CSV files are read by `csv_table`, meshes by meshlane.
"""

import contextlib
import io
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optics.numerics.number_tree import FrozenMap
from optics.thermal.nodal_deformation import MIN_NODES
from scenes.yaml.csv_table import LARGEST_TABLE, Column, Table, read_table
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.input_file import digest_of, is_file, no_file, why_unreadable
from scenes.yaml.units import LENGTH, TEMPERATURE, TEMPERATURE_DIFFERENCE, unit_ratio

POSITION_COLUMNS, MOVES = ("x", "y", "z"), ("dx", "dy", "dz")
FARTHEST = 100.0
"""Largest absolute coordinate of a node and largest displacement, in metres."""
COLUMNS = (
    *(Column(name, LENGTH, least=-FARTHEST, most=FARTHEST) for name in (*POSITION_COLUMNS, *MOVES)),
    Column("node", text=True, needed=False),
)
"""Columns of a table of displacements; the node numbers are not used."""
ABSOLUTE, CHANGE = "T", "dT"
HOTTEST = 2000.0
"""Highest temperature of a node and largest change of it, in kelvin."""
HEAT_COLUMNS = (
    *COLUMNS[:3],
    Column(ABSOLUTE, TEMPERATURE, needed=False, least=0.0, most=HOTTEST),
    Column(CHANGE, TEMPERATURE_DIFFERENCE, needed=False, least=-HOTTEST, most=HOTTEST),
    COLUMNS[-1],
)
"""Columns of a table of temperatures: absolute ones, or changes from the temperature of the instrument."""
LONGEST_READING, LONGEST_PER_BYTE = 10.0, 2e-6
"""Time limit for reading a mesh in seconds, and its increase for each byte: ten times what intact files take."""
ZERO_CELSIUS = 273.15
MOST_NODES = 1_000_000
TABLES = (".csv", ".tsv", ".txt")
MESHES = FrozenMap({".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".med": "med"})
"""Suffix of a mesh file -> its format in meshlane: the formats that hold nodal displacements in a single file."""
INPUT_DECKS = (".inp", ".bdf", ".nas", ".fem", ".dat", ".cdb", ".ans", ".rst", ".op2", ".f06", ".odb")
"""Suffixes of files that are refused: input decks of NASTRAN, ANSYS and Abaqus, which have no results, and their own
result formats, for which there is no reader.
"""
HEAT_DECKS_NEED = "a table with the heads 'x [mm]', 'y [mm]', 'z [mm]', 'T [degC]', or a .vtu file"
DECKS_NEED = "a table with the heads 'x [mm]', 'y [mm]', 'z [mm]', 'dx [mm]', 'dy [mm]', 'dz [mm]', or a .vtu file"


@dataclass(frozen=True, eq=False)
class DisplacedNodes:
    """N nodes of a finite-element program and their displacements.

    Both are (N, 3) arrays in metres, in the frame that the specification names.
    """

    points: np.ndarray
    moves: np.ndarray


@dataclass(frozen=True, eq=False)
class WarmNodes:
    """N nodes of a finite-element program and their temperatures.

    Attributes
    ----------
    points : np.ndarray
        (N, 3) coordinates in metres, in the frame that the specification names.
    values : np.ndarray
        (N,) temperatures in kelvin.
    absolute : bool
        True for absolute temperatures, False for changes from the temperature of the instrument.
    """

    points: np.ndarray
    values: np.ndarray
    absolute: bool


def read_nodes(
    path: str | Path, unit: str | None = None, field: str | None = None, sha256: str | None = None
) -> DisplacedNodes:
    """Read nodes and displacements from a table or a mesh.

    Parameters
    ----------
    path : str | Path
        Path of the file; its suffix determines the format.
    unit : str | None
        Unit of length of a mesh; metres by default.
    field : str | None
        Name of the displacements in a mesh; None for its only vector field.
    sha256 : str | None
        Checksum that the file must have; None for any.

    Raises
    ------
    InputError
        The file cannot be read (the error has line and column of a table), or its checksum differs.
    """
    _checked(Path(path), sha256)
    if Path(path).suffix.lower() in MESHES:
        points, moves = _of_mesh(Path(path), unit or "m", field, "vectors", DECKS_NEED)
        moves = moves * unit_ratio(unit or "m", LENGTH.si)
        _within(str(path), moves, FARTHEST, "displacements", "up to 100 m")
        return DisplacedNodes(points, moves)
    table = _table(path, COLUMNS)
    points, moves = table.stacked(*POSITION_COLUMNS), table.stacked(*MOVES)
    _one_load_case(table, points, moves, "displacement")
    return DisplacedNodes(points, moves)


def read_temperatures(
    path: str | Path,
    unit: str | None = None,
    field: str | None = None,
    reading: str | None = None,
    sha256: str | None = None,
) -> WarmNodes:
    """Read nodes and temperatures from a table or a mesh.

    Parameters
    ----------
    path : str | Path
        Path of the file; its suffix determines the format.
    unit : str | None
        Unit of a mesh's coordinates; metres by default.
    field : str | None
        Name of the temperatures in a mesh; None for its only scalar field.
    reading : str | None
        Meaning of a mesh's numbers: "change", "K" or "degC".
    sha256 : str | None
        Checksum that the file must have; None for any.

    Raises
    ------
    InputError
        The file cannot be read (the error has line and column of a table), or its checksum differs.
    """
    _checked(Path(path), sha256)
    if Path(path).suffix.lower() in MESHES:
        points, values = _of_mesh(Path(path), unit or "m", field, "temperatures", HEAT_DECKS_NEED)
        values = values + (ZERO_CELSIUS if reading == "degC" else 0.0)
        absolute = reading in ("K", "degC")
        _within(str(path), values[:, None], HOTTEST, "a temperature", f"up to {HOTTEST:g} K")
        if absolute and np.any(values < 0.0):
            number = int(np.argmax(values < 0.0))
            text = f"node number {number} (from 0) is colder than absolute zero"
            raise InputError(Issue(text, str(path), value=shown(float(values[number])), allowed="values: change"))
        return WarmNodes(points, values, absolute)
    table = _table(path, HEAT_COLUMNS)
    columns = [name for name in (ABSOLUTE, CHANGE) if name in table]
    if len(columns) != 1:
        text = "absolute temperatures and changes" if columns else "no temperatures"
        allowed = "either 'T [degC]' (or 'T [K]'), absolute, or 'dT [K]', changes from the instrument's temperature"
        raise InputError(Issue(text, str(path), int(table.lines[0]) - 1, allowed=allowed))
    points, values = table.stacked(*POSITION_COLUMNS), table[columns[0]]
    _one_load_case(table, points, values[:, None], "temperature")
    return WarmNodes(points, values, columns[0] == ABSOLUTE)


def _checked(path: Path, sha256: str | None) -> None:
    """Raise `InputError` if the checksum of a file differs."""
    if sha256 is not None and is_file(path) and (digest := digest_of(path)) != sha256:
        text = "not the table that was used: its checksum differs"
        raise InputError(Issue(text, str(path), value=digest, allowed=f"sha256 {sha256}, as the job says"))


def _table(path: str | Path, columns: tuple[Column, ...]) -> Table:
    table = read_table(path, columns, MIN_NODES)
    if len(table.lines) > MOST_NODES:
        allowed = f"at most {MOST_NODES}: those of the optical surface alone"
        raise InputError(Issue(f"{len(table.lines)} nodes", str(path), int(table.lines[MOST_NODES]), allowed=allowed))
    return table


def _one_load_case(table: Table, points: np.ndarray, values: np.ndarray, what: str) -> None:
    """Raise `InputError` if a node occurs twice with different values, as in a file of several load cases."""
    first: dict[bytes, int] = {}
    for row, point in enumerate(points):
        other = first.setdefault(point.tobytes(), row)
        if other != row and np.any(values[other] != values[row]):
            text = f"a second {what} of the node in line {table.lines[other]}"
            raise table.error(row, "", text, allowed="one load case in a table, every node once")


def _of_mesh(path: Path, unit: str, field: str | None, what: str, need: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the nodes of a mesh file, with displacements or temperatures, by the library meshlane.

    The readers of meshlane may raise any exception.

    Returns
    -------
    tuple of ndarray
        Coordinates of N nodes, (N, 3), in metres; and displacements (N, 3) or temperatures (N,), in the mesh's unit.
    """
    import meshlane  # slow to import, and only needed for a job with a mesh

    file = str(path)
    wrong = no_file(path)
    if wrong is not None:
        raise InputError(Issue(wrong, file, allowed="a mesh"))
    if path.stat().st_size > LARGEST_TABLE:
        raise InputError(Issue("too large", file, allowed="at most 1 GB"))
    form = MESHES[path.suffix.lower()]
    try:
        # meshlane leaves an HDF5 file open that it cannot read, so it gets the bytes instead
        content = io.BytesIO(path.read_bytes()) if form == "med" else file
        mesh = _in_time(path, lambda: meshlane.read(content, file_format=form))
        points = np.asarray(mesh.points, np.float64)
        shapes = [(len(points), 3)] if what == "vectors" else [(len(points),), (len(points), 1)]
        fields = {
            str(name): np.asarray(values, np.float64)
            for name, values in mesh.point_data.items()
            if np.shape(values) in shapes
        }
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(Issue(f"meshlane cannot read this mesh: {why_unreadable(error)}", file)) from None
    if field is None and len(fields) != 1:
        text = f"no {what} at its nodes" if not fields else f"several {what} at its nodes"
        remedy = need if not fields else "field: one of " + names_text(sorted(fields))
        raise InputError(Issue(text, file, value=names_text(sorted(fields)) or None, allowed=remedy))
    name = field if field is not None else next(iter(fields))
    if name not in fields:
        known = sorted(fields)
        text = f"no such {what} at its nodes"
        raise InputError(Issue(text, file, None, (), shown(name), names_text(known) or "none", nearest(name, known)))
    points = points * unit_ratio(unit, LENGTH.si)
    if points.ndim != 2 or points.shape[1] != 3 or not MIN_NODES <= len(points) <= MOST_NODES:
        raise InputError(Issue(f"nodes of shape {points.shape}", file, allowed=f"{MIN_NODES} to {MOST_NODES} in space"))
    _within(file, points, FARTHEST, "coordinates", "up to 100 m")
    return points, fields[name] if what == "vectors" else fields[name].reshape(len(points))


def _in_time(path: Path, read: Callable[[], Any]) -> Any:
    """Run a reader of meshes, return its result or raise its exception; refuse the mesh after a time limit.

    With a wrong node count in the file some readers run for hours. Such a thread is abandoned: it does not delay the
    end of the program.
    """
    ended: dict[str, Any] = {}

    def run() -> None:
        try:
            ended["value"] = read()
        except BaseException as error:
            ended["error"] = error

    thread = threading.Thread(target=run, daemon=True)
    # some readers print errors or exit the program
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        thread.start()
        thread.join(LONGEST_READING + path.stat().st_size * LONGEST_PER_BYTE)
    if thread.is_alive():
        text = "meshlane does not finish reading this mesh"
        raise InputError(Issue(text, str(path), allowed="an intact file, whose counts match its nodes and cells"))
    if "error" in ended:
        raise ended["error"]
    return ended["value"]


def _within(file: str, values: np.ndarray, most: float, what: str, allowed: str) -> None:
    """Raise `InputError` if values at nodes are not finite, or larger than ``most`` in absolute value."""
    bad = ~np.all(np.isfinite(values) & (np.abs(values) <= most), axis=1)
    if np.any(bad):
        number = int(np.argmax(bad))
        text = f"node number {number} (from 0) has {what} out of range"
        raise InputError(Issue(text, file, value=shown(values[number].tolist()), allowed=allowed))
