"""Ground points from files: CSV, GeoJSON (RFC 7946), and .gcp of the Ames Stereo Pipeline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenes.yaml.csv_table import Column, read_table, table_text
from scenes.yaml.errors import InputError, Issue, Problem, names_text, shown
from scenes.yaml.input_file import parse_json
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH
from twin.orbit.flight.earth import Earth, east_north_up
from twin.orbit.measured.maps import Datum, Geoid
from twin.orbit.measured.pass_measurements import ROLES, GroundPoints
from twin.orbit.measured.xml_file import numbers, text_lines

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import GroundFileSpec

_SIGMAS = ("sigma_east", "sigma_north", "sigma_up")
_COORDINATE_SETS = (("longitude", "latitude", "height"), ("east", "north", "height"), ("x", "y", "z"))
_COLUMNS = (
    Column("point", text=True),
    *(Column(name, ANGLE, needed=False) for name in ("longitude", "latitude")),
    *(Column(name, DISTANCE, needed=False) for name in ("east", "north", "height", "x", "y", "z")),
    *(Column(name, LENGTH, needed=False, least=0.0, most=1e4) for name in (*_SIGMAS, "sigma")),
    Column("role", text=True, needed=False),
)
_GEOGRAPHIC = "EPSG:4979"


@dataclass(frozen=True, eq=False)
class GroundFile:
    """Ground points read from a file.

    Attributes
    ----------
    points : GroundPoints
        Ground points with covariances and roles, in the ITRS.
    accuracy : float or None
        Accuracy of the transformation to the ITRS according to its authority (such as EPSG), metres; None where none is
        given.
    images : mapping of str to (n, 5) ndarray for n measurements
        Image measurements by image file, where the file has some: index in `points`, line, pixel, and the sigmas of
        line and pixel in pixels.
    """

    points: GroundPoints
    accuracy: float | None
    images: Mapping[str, np.ndarray]


@dataclass(eq=False)
class _Rows:
    """Points of a file: names, coordinates in the file's system, sigmas (NaN if not given), roles, line numbers."""

    ids: list[str]
    coordinates: np.ndarray
    sigmas: np.ndarray
    roles: list[str]
    lines: Sequence[int | None]


def read_ground_points(spec: GroundFileSpec, folder: Path) -> GroundFile:
    """Read the ground points of a file.

    Parameters
    ----------
    spec : GroundFileSpec
        Path of the file, and what the file itself does not specify.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    InputError
        The file cannot be read; with file and line, or the feature of a GeoJSON file.
    """
    path = folder / spec.file
    images: dict[str, np.ndarray] = {}
    heights = spec.heights
    match path.suffix.lower():
        case ".geojson" | ".json":
            rows, system = _geojson(path, spec), spec.crs or _GEOGRAPHIC
        case ".gcp":
            rows, images, header = _gcp(path)
            system = _required(spec) if header is None else _of_header(spec, header)
            if header is not None and heights is None and "geocent" not in header.lower():
                heights = "ellipsoid"  # the Ames Stereo Pipeline counts heights from the datum
        case _:
            rows, system = _csv(path, spec), _required(spec)
    file = str(path)
    try:
        geoid = None if spec.geoid is None else Geoid.read(folder / spec.geoid)
        datum = Datum.of(system, heights, geoid)
    except Problem as problem:
        raise spec.error(problem, ("crs",)) from None
    try:
        itrs = datum.itrs(*rows.coordinates.T)
    except Problem as problem:
        line = rows.lines[int(problem.within[0])] if problem.within else None
        raise InputError(Issue(problem.problem, file, line, (), problem.value, problem.allowed)) from None
    height = Earth().geodetic(itrs)[2]
    for row in np.flatnonzero(~((height > -1000.0) & (height < 10000.0)))[:1]:
        value = f"{height[row]:.6g} m above the ellipsoid"
        raise InputError(
            Issue("not a position on the ground", file, rows.lines[row], (), value, "-1000 m to 10 000 m; units?")
        )
    covariance = _covariance(spec, file, rows, itrs, path.suffix.lower() == ".gcp" and spec.sigma_axes == "xyz")
    points = GroundPoints.of(np.array(rows.ids, object), itrs, covariance, np.array(rows.roles, object))
    return GroundFile(points, datum.accuracy, images)


def _required(spec: GroundFileSpec) -> str:
    """Return the coordinate system named in the test's file; raise InputError if it names none."""
    if spec.crs is None:
        raise spec.error("the coordinate system is not specified", ("crs",), allowed="EPSG:4979, EPSG:32650, ...")
    return spec.crs


def _covariance(spec: GroundFileSpec, file: str, rows: _Rows, itrs: np.ndarray, earth_fixed: bool) -> np.ndarray:
    """Return the covariances of n points in axes of the ITRS, (n, 3, 3), in m^2."""
    sigma = rows.sigmas.copy()
    missing = np.isnan(sigma).any(axis=1)
    for row in np.flatnonzero(missing)[:1]:
        if spec.sigma is None:
            problem, allowed = "a point without sigmas", f"{names_text(_SIGMAS)} in the file, or `sigma:` for all"
            raise InputError(Issue(problem, file, rows.lines[row], (), shown(rows.ids[row]), allowed))
        sigma[missing] = (spec.sigma[0], spec.sigma[0], spec.sigma[1])
    square = sigma[:, None, :] ** 2
    lon, lat, _ = Earth().geodetic(itrs)
    axes = np.swapaxes(east_north_up(lon, lat), 1, 2)
    if earth_fixed:
        axes = np.where(missing[:, None, None], axes, np.eye(3))
    return np.asarray((axes * square) @ np.swapaxes(axes, 1, 2))


def _unique(file: str, ids: Sequence[str], lines: Sequence[int | None]) -> None:
    """Raise InputError if a name of a ground point occurs twice."""
    seen: set[str] = set()
    for name, line in zip(ids, lines, strict=True):
        if name in seen:
            raise InputError(Issue("a point that occurs twice", file, line, (), shown(name), "each point once"))
        seen.add(name)


def _role(file: str, role: str, line: int | None, key: tuple[str | int, ...] = ("role",)) -> str:
    """Return the role of a point, or raise InputError if it is neither control nor check."""
    if role not in ROLES[:2]:
        raise InputError(Issue("unknown role", file, line, key, shown(role), names_text(ROLES[:2])))
    return role


def _csv(path: Path, spec: GroundFileSpec) -> _Rows:
    """Read ground points from the rows of a CSV file."""
    table, file = read_table(path, _COLUMNS), str(path)
    sets = [names for names in _COORDINATE_SETS if all(name in table for name in names)]
    others = [n for names in _COORDINATE_SETS for n in names if n in table and not (sets and n in sets[0])]
    if len(sets) != 1 or others:
        allowed = "; or ".join(names_text(names) for names in _COORDINATE_SETS)
        raise InputError(
            Issue("not one complete set of coordinates", file, None, (), names_text(table.columns), allowed)
        )
    coordinates = table.stacked(*sets[0])
    if sets[0] == _COORDINATE_SETS[0]:
        coordinates[:, :2] = np.degrees(coordinates[:, :2])
    _fits(spec, sets[0])
    lines = [int(v) for v in table.lines]
    have = [name for name in _SIGMAS if name in table]
    if have and len(have) < 3:
        raise InputError(Issue("incomplete sigmas", file, None, (), names_text(have), names_text(_SIGMAS)))
    if have and "sigma" in table:
        raise InputError(Issue("sigmas are given in two ways", file, None, (), names_text([*have, "sigma"])))
    sigmas = table.stacked(*_SIGMAS) if have else np.full((len(table), 3), np.nan)
    if "sigma" in table:
        sigmas = np.repeat(table["sigma"][:, None], 3, axis=1)
    ids = [str(v) for v in table["point"]]
    _unique(file, ids, lines)
    roles = [_role(file, str(r), k) for r, k in zip(table["role"], lines, strict=True)] if "role" in table else []
    return _Rows(ids, coordinates, sigmas, roles or ["control"] * len(ids), lines)


def _fits(spec: GroundFileSpec, names: tuple[str, ...]) -> None:
    """Raise InputError unless columns with these names can hold coordinates in the file's reference system."""
    import pyproj

    try:
        crs = pyproj.CRS(_required(spec))
    except pyproj.exceptions.CRSError:
        return  # Datum.of reports the error
    right = (
        _COORDINATE_SETS[0] if crs.is_geographic else _COORDINATE_SETS[2] if crs.is_geocentric else _COORDINATE_SETS[1]
    )
    if names != right:
        raise spec.error(
            f"columns {names_text(names)} are not coordinates of {crs.name}", ("crs",), allowed=names_text(right)
        )


def _geojson(path: Path, spec: GroundFileSpec) -> _Rows:
    """Read ground points from the point features of a GeoJSON file."""
    file, text = str(path), table_text(path, "a GeoJSON file")
    data = parse_json(text, file)
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list) or not features:
        raise InputError(Issue("no features", file, None, ("features",), None, "a FeatureCollection of Points"))
    if "crs" in data and spec.crs is None:
        problem = "a member `crs`, which GeoJSON no longer has"
        raise InputError(Issue(problem, file, None, ("crs",), shown(data["crs"]), "`crs:` in the test's file"))
    ids, coordinates, sigmas, roles = [], [], [], []
    for k, feature in enumerate(features):
        key: tuple[str | int, ...] = ("features", k)
        if not isinstance(feature, dict):
            raise InputError(Issue("not a feature", file, None, key, shown(feature), "a Feature of a Point"))
        geometry, properties = feature.get("geometry"), feature.get("properties") or {}
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        if not isinstance(geometry, dict) or kind != "Point" or not isinstance(properties, dict):
            raise InputError(Issue("not a point", file, None, (*key, "geometry"), shown(kind), "a Point"))
        position = geometry.get("coordinates")
        if not isinstance(position, list) or len(position) != 3 or not all(map(_finite, position)):
            at = (*key, "geometry", "coordinates")
            raise InputError(Issue("not a position", file, None, at, shown(position), "[longitude, latitude, height]"))
        name = feature.get("id", properties.get("point", properties.get("id", properties.get("name"))))
        if not isinstance(name, str | int) or isinstance(name, bool) or not str(name).strip():
            raise InputError(Issue("a point without a name", file, None, (*key, "id"), shown(name), "an `id`"))
        spread = [properties.get(n) for n in _SIGMAS]
        if any(v is not None for v in spread) and not all(_finite(v) and 0.0 <= float(v) <= 1e4 for v in spread):  # type: ignore[arg-type]
            at = (*key, "properties")
            raise InputError(Issue("invalid sigmas", file, None, at, shown(spread), f"{names_text(_SIGMAS)}, metres"))
        ids.append(str(name))
        coordinates.append([float(v) for v in position])
        sigmas.append([math.nan if v is None else float(v) for v in spread])
        role = properties.get("role", "control")
        roles.append(_role(file, role if isinstance(role, str) else shown(role), None, (*key, "properties", "role")))
    lines: list[int | None] = [None] * len(ids)
    _unique(file, ids, lines)
    return _Rows(ids, np.array(coordinates), np.array(sigmas), roles, lines)


def _finite(value: Any) -> bool:
    """Return whether a value of a JSON file is a finite number."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


_GCP = ("latitude", "longitude", "height", "sigma x", "sigma y", "sigma z")
"""Names of the numeric fields of a point in a .gcp file."""


def _alike(first: Any, second: Any) -> bool:
    """Return whether two geographic systems name the same datum, or one that PROJ treats as the same."""
    import pyproj

    bodies = (first.ellipsoid, second.ellipsoid)
    if bodies[0] is None or bodies[1] is None or abs(bodies[0].semi_major_metre - bodies[1].semi_major_metre) > 1e-3:
        return False
    to_first = pyproj.Transformer.from_crs(second.to_2d(), first.to_2d(), always_xy=True)
    there = np.array(to_first.transform([10.0, 116.0, -75.0], [50.0, 40.0, -30.0]))
    return bool(np.abs(there - [[10.0, 116.0, -75.0], [50.0, 40.0, -30.0]]).max() < 1e-9)


def _of_header(spec: GroundFileSpec, header: str) -> str:
    """Return the coordinate system of a header `# WKT:`; raise InputError if the test file names another one."""
    import pyproj

    try:
        crs = pyproj.CRS(header)
        # Ensembles, datums and their axes are spelt in many ways, so the coordinates are compared.
        same = spec.crs is None or _alike(pyproj.CRS(spec.crs), crs)
    except pyproj.exceptions.CRSError:
        raise spec.error("the header # WKT: of the file cannot be read", ("file",), value=shown(header)) from None
    if not crs.is_geographic:
        problem, allowed = "the header names a projected system", "a geographic system: latitude, longitude, height"
        raise spec.error(problem, ("file",), value=crs.name, allowed=allowed)
    if not same:
        problem, allowed = f"the file's header names {crs.name}, not the specified system", f"{crs.name}, or no key crs"
        raise spec.error(problem, ("crs",), value=spec.crs, allowed=allowed)
    return spec.crs or header


def _gcp(path: Path) -> tuple[_Rows, dict[str, np.ndarray], str | None]:
    """Return the points of a .gcp file, their image measurements, and the system of its header."""
    file, header = str(path), None
    rows, lines = [], []
    for k, line in enumerate(text_lines(path, "a .gcp file")):
        cells = line.replace(",", " ").split()
        if not cells or line.lstrip().startswith("#"):
            if "WKT:" in line:
                header = line.partition("WKT:")[2].strip()
            continue
        if len(cells) < 7 or (len(cells) - 7) % 5:
            allowed = "id, latitude, longitude, height, three sigmas, and for each image name, column, row, two sigmas"
            raise InputError(Issue("not a ground control point", file, k + 1, (), f"{len(cells)} fields", allowed))
        rows.append(cells)
        lines.append(k + 1)
    if not rows:
        raise InputError(Issue("no points", file, None, (), None, "one a line"))
    numeric = numbers(file, [row[1:7] for row in rows], lines, _GCP)
    for row, column in np.argwhere((numeric[:, 3:] <= 0.0) | (numeric[:, 3:] > 1e4))[:1].tolist():
        value = shown(rows[row][4 + column])
        raise InputError(Issue("invalid sigma", file, lines[row], (_GCP[3 + column],), value, "0 m to 10 km"))
    ids = [row[0] for row in rows]
    _unique(file, ids, lines)
    images: dict[str, list[np.ndarray]] = {}
    for k, cells in enumerate(rows):
        for start in range(7, len(cells), 5):
            heads = ("column", "row", "sigma column", "sigma row")
            column, line, sigma_column, sigma_row = numbers(file, [cells[start + 1 : start + 5]], [lines[k]], heads)[0]
            if not (sigma_column > 0.0 and sigma_row > 0.0):
                raise InputError(Issue("invalid sigma", file, lines[k], ("image",), shown(cells[start]), "above zero"))
            images.setdefault(cells[start], []).append(np.array([k, line, column, sigma_row, sigma_column]))
    measured = {name: np.array(values) for name, values in images.items()}
    return _Rows(ids, numeric[:, [1, 0, 2]], numeric[:, 3:], ["control"] * len(ids), lines), measured, header
