"""Displaced nodes of finite-element programs from CSV files, and from meshes by meshio."""

import contextlib
import hashlib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.numerics.frozen_map import FrozenMap
from optics.thermal.nodal_deformation import LEAST_NODES
from scenes.yaml.csv_table import LARGEST_TABLE, Column, read_table
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.units import LENGTH, unit_ratio
from scenes.yaml.yaml_file import is_file

PLACES, MOVES = ("x", "y", "z"), ("dx", "dy", "dz")
FARTHEST = 100.0
"""Metres: no coordinate of a node and no displacement is larger."""
COLUMNS = (
    *(Column(name, LENGTH, least=-FARTHEST, most=FARTHEST) for name in (*PLACES, *MOVES)),
    Column("node", text=True, needed=False),
)
"""Of a table; the nodes' own numbers say nothing here."""
MOST_NODES = 1_000_000
TABLES = (".csv", ".tsv", ".txt")
MESHES = FrozenMap({".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".med": "med"})
"""Ending of a mesh's file -> its format in meshio: those that carry displacements of the nodes, all in one file."""
INPUT_DECKS = (".inp", ".bdf", ".nas", ".fem", ".dat", ".cdb", ".ans", ".rst", ".op2", ".f06", ".odb")
"""Input of NASTRAN, ANSYS and Abaqus has no results, and their own result files are not read."""
DECKS_NEED = "a table with the heads 'x [mm]', 'y [mm]', 'z [mm]', 'dx [mm]', 'dy [mm]', 'dz [mm]', or a .vtu file"


@dataclass(frozen=True, eq=False)
class DisplacedNodes:
    """Nodes and their displacements, metres, (N, 3) each, in the frame that the specification names."""

    points: np.ndarray
    moves: np.ndarray


def read_nodes(
    path: str | Path, unit: str | None = None, field: str | None = None, sha256: str | None = None
) -> DisplacedNodes:
    """The nodes of a table or a mesh.

    Args:
        path: of the file; its ending says what it is.
        unit: of a mesh.
        field: name of the displacements in a mesh, None for its only vectors.
        sha256: checksum that the file must have, None for any.

    Raises:
        InputError: it cannot be read, with the line and the column of a table, or is not the one of the checksum.
    """
    if sha256 is not None and is_file(Path(path)) and (digest := digest_of(Path(path))) != sha256:
        text = "not the table that was used: its checksum is another"
        raise InputError(Issue(text, str(path), found=digest, allowed=f"sha256 {sha256}, as the job says"))
    if Path(path).suffix.lower() in MESHES:
        return _of_mesh(Path(path), unit or "m", field)
    table = read_table(path, COLUMNS, LEAST_NODES)
    if len(table.lines) > MOST_NODES:
        allowed = f"at most {MOST_NODES}: those of the optical surface alone"
        raise InputError(Issue(f"{len(table.lines)} nodes", str(path), int(table.lines[MOST_NODES]), allowed=allowed))
    points, moves = table.stacked(*PLACES), table.stacked(*MOVES)
    first: dict[bytes, int] = {}
    for row, place in enumerate(points):
        other = first.setdefault(place.tobytes(), row)
        if other != row and np.any(moves[other] != moves[row]):
            text = f"another displacement of the node that line {table.lines[other]} has"
            raise table.error(row, "", text, allowed="one load case in a table, every node once")
    return DisplacedNodes(points, moves)


def _of_mesh(path: Path, unit: str, field: str | None) -> DisplacedNodes:
    """The nodes of a mesh by meshio, whose readers end in any exception."""
    import meshio  # only a job with a mesh waits for it

    file = str(path)
    if path.stat().st_size > LARGEST_TABLE:
        raise InputError(Issue("too large", file, allowed="at most 1 GB"))
    try:
        # it prints its complaints, and leaves the program for some
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            mesh = meshio.read(file, file_format=MESHES[path.suffix.lower()])
        points = np.asarray(mesh.points, np.float64)
        vectors = {
            str(name): np.asarray(values, np.float64)
            for name, values in mesh.point_data.items()
            if np.shape(values) == (len(points), 3)
        }
    except (Exception, SystemExit) as error:
        reason = re.sub(r"\s+", " ", str(error)).strip()[:200] or type(error).__name__
        raise InputError(Issue(f"meshio cannot read this mesh: {reason}", file)) from None
    if field is None and len(vectors) != 1:
        text = "no vectors at its nodes" if not vectors else "several vectors at its nodes"
        remedy = DECKS_NEED if not vectors else "field: one of " + names_text(sorted(vectors))
        raise InputError(Issue(text, file, found=names_text(sorted(vectors)) or None, allowed=remedy))
    name = field if field is not None else next(iter(vectors))
    if name not in vectors:
        known = sorted(vectors)
        issue = Issue("no such vectors at its nodes", file, None, (), shown(name), names_text(known) or "none")
        raise InputError(issue if nearest(name, known) is None else _suggesting(issue, nearest(name, known)))
    factor = unit_ratio(unit, LENGTH.si)
    points, moves = points * factor, vectors[name] * factor
    if points.ndim != 2 or points.shape[1] != 3 or not LEAST_NODES <= len(points) <= MOST_NODES:
        raise InputError(
            Issue(f"nodes of shape {points.shape}", file, allowed=f"{LEAST_NODES} to {MOST_NODES} in space")
        )
    for values, what in ((points, "coordinates"), (moves, "displacements")):
        bad = ~np.all(np.isfinite(values) & (np.abs(values) <= FARTHEST), axis=1)
        if np.any(bad):
            number = int(np.argmax(bad))
            text = f"node number {number} (from 0) has {what} out of range"
            raise InputError(Issue(text, file, found=shown(values[number].tolist()), allowed="up to 100 m"))
    return DisplacedNodes(points, moves)


def _suggesting(issue: Issue, suggestion: str | None) -> Issue:
    return Issue(issue.problem, issue.file, issue.line, issue.key, issue.found, issue.allowed, suggestion)


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
