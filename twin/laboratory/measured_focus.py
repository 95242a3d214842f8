"""Measured through-focus series, read from a table of MTF values or of images, with best focus at every site."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.focal_plane.through_focus import LEAST_POINTS, FocusError, focus_vertex, outlying_points
from analysis.images.image_file import ImageError, ImageFile, Region
from analysis.mtf.edge_location import EdgeError
from analysis.mtf.edge_pages import grey_step, measure_pages
from analysis.spots.noise import NoiseModel
from analysis.statistics import limit_of
from optics.numerics.backend import cores, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.camera_tests import FocusFiles, NoiseSpec
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import names_text, nearest
from scenes.yaml.units import LENGTH
from twin.framework.procedure import Advance, silent
from twin.laboratory.focus_bench import SiteScan
from twin.laboratory.measured_readings import DataFile
from twin.targets.target_images import ALONG, DIRECTIONS

MAX_SITES = 3000
"""Largest number of sites (positions on the focal plane) in a measured series."""
NANOMETRE = 1e-9
"""Distance below which two positions in a table are considered the same site, metres."""
_WHERE = (
    Column("band", text=True, needed=False),
    Column("x", LENGTH, least=-10.0, most=10.0),
    Column("y", LENGTH, least=-10.0, most=10.0),
    Column("edge", text=True, needed=False),
    Column("shift", LENGTH, least=-10.0, most=10.0),
    Column("per shift", needed=False, least=1e-9, most=1e6),
)
MTF_COLUMNS = (*_WHERE, Column("mtf", least=-0.5, most=1.5), Column("sigma", least=1e-9, most=10.0))
IMAGE_COLUMNS = (
    *_WHERE,
    Column("file", text=True),
    *(Column(name, needed=False, whole=True, least=0.0, most=1e7) for name in ("page", "row", "column")),
    *(Column(name, needed=False, whole=True, least=1.0, most=1e5) for name in ("height", "width")),
)
_FALSE_ALARM = 1e-3
"""Probability that any row of a table without errors is excluded as an outlier."""
_REGION = ("row", "column", "height", "width")


@dataclass(frozen=True, eq=False)
class _Site:
    """Site (position) on the focal plane with its rows of the table.

    Attributes
    ----------
    band : str
        Band of its CCD; empty if the table has no bands.
    position : (2,) ndarray
        Position (X', Y'), metres.
    rows : mapping
        Edge (direction of the MTF) -> indices of its rows of the table, sorted by shift.
    """

    band: str
    position: Array
    rows: Mapping[str, NDArray[np.intp]]

    def __str__(self) -> str:
        x, y = 1e3 * self.position
        return f"{self.band + ' at ' if self.band else ''}x {x:.6g} mm, y {y:.6g} mm"


@dataclass(frozen=True, eq=False)
class RowFault:
    """Row of the table that is excluded or doubtful, or whose image is, with the reason."""

    file: str
    line: int
    reason: str


@dataclass(frozen=True, eq=False)
class FocusReadings:
    """Measured through-focus series of N sites (positions on the focal plane).

    Attributes
    ----------
    table : Table
        Table of the series.
    bands : tuple of str
        Bands of the sites; empty names if the table has no bands.
    positions : (N, 2) ndarray
        Positions (X', Y') of the sites, metres.
    scans : tuple of SiteScan
        Curves through focus of the sites.
    no_edge : tuple of RowFault
        Images that could not be measured.
    uneven : tuple of RowFault
        Images with structure that their edge does not explain.
    excluded : tuple of RowFault
        Rows that disagree with the curve through all others and are not used.
    file : DataFile
        File of the table.
    """

    table: Table
    bands: tuple[str, ...]
    positions: Array
    scans: tuple[SiteScan, ...]
    no_edge: tuple[RowFault, ...]
    uneven: tuple[RowFault, ...]
    excluded: tuple[RowFault, ...]
    file: DataFile


def read_focus(files: FocusFiles, advance: Advance = silent) -> FocusReadings:
    """Read a through-focus series and find best focus at every site.

    Parameters
    ----------
    files : FocusFiles
        Section ``measured`` of the test's file.
    advance : Advance
        Called with the progress.

    Raises
    ------
    InputError
        A table or an image cannot be used, or best focus cannot be determined from it.
    """
    advance("read the series", 0, 1)
    images = files.images is not None
    table = read_table(str(files.images or files.mtf), IMAGE_COLUMNS if images else MTF_COLUMNS, 5)
    sites = _sites(table)
    empty: dict[int, str] = {}
    measured = _from_images(table, files, advance) if images else (table["mtf"], table["sigma"].copy(), empty, empty)
    mtf, sigma, reasons, warnings = measured
    shift = table["shift"] * _per_shift(table, files)
    excluded: dict[int, str] = {}
    limit = float(np.sqrt(limit_of(_FALSE_ALARM / len(table), 1)))
    for site in sites:
        for rows in site.rows.values():
            for row, away in zip(rows, outlying_points(shift[rows], mtf[rows], sigma[rows], limit), strict=True):
                if away:
                    excluded[int(row)] = f"the MTF is {away:+.3f} from the curve through all others"
    sigma[list(excluded)] = np.inf
    return FocusReadings(
        table,
        tuple(site.band for site in sites),
        np.array([site.position for site in sites]),
        tuple(_scan(table, site, shift, mtf, sigma, reasons) for site in sites),
        _faults(table, reasons),
        _faults(table, warnings),
        _faults(table, excluded),
        DataFile.of(table, [column.name for column in _WHERE]),
    )


def _faults(table: Table, reasons: Mapping[int, str]) -> tuple[RowFault, ...]:
    """Return the rows of a table for which ``reasons`` (row -> reason) has an entry, with the reason."""
    return tuple(RowFault(table.file, int(table.lines[row]), reasons[row]) for row in sorted(reasons))


def _per_shift(table: Table, files: FocusFiles) -> Array | float:
    """Return the shift of the image along the light per unit of the shift that the table gives.

    The table may give shifts of the image itself, or of the target in the collimator.
    """
    if files.moved != "target":
        if "per shift" in table:
            text = "the key is for a target that moves; a detector moves as much as the image"
            raise table.error(0, "per shift", text, allowed="moved: target")
        # moving the CCD downstream is equivalent to moving the image upstream
        return 1.0 if files.moved == "image" else -1.0
    if "per shift" in table:
        return table["per shift"]
    if files.per_shift is None:
        text = "the ratio of image shift to target shift is not specified"
        allowed = "per_shift: (f of the camera / f of the collimator)^2, or a column 'per shift'"
        raise files.error(text, ("moved",), value="target", allowed=allowed)
    return files.per_shift


def _sites(table: Table) -> tuple[_Site, ...]:
    """Return the sites, sorted by band and position, each with its rows."""
    band = table["band"] if "band" in table else np.full(len(table), "", dtype=object)
    edge = table["edge"] if "edge" in table else np.full(len(table), ALONG, dtype=object)
    odd = np.flatnonzero(~np.isin(edge, DIRECTIONS))
    if odd.size:
        row, unknown = int(odd[0]), str(edge[odd[0]])
        meant = nearest(unknown, DIRECTIONS)
        raise table.error(row, "edge", "no such direction", unknown, names_text(DIRECTIONS), meant)
    bands, of_band = np.unique(band.astype(str), return_inverse=True)
    keys_nm = np.rint(table.stacked("x", "y") / NANOMETRE)
    keys, group = np.unique(np.column_stack([of_band, keys_nm]), axis=0, return_inverse=True)
    if len(keys) > MAX_SITES:
        allowed = f"at most {MAX_SITES} sites; x and y are those of the field, the same in all rows of a site"
        raise table.error(0, "x", "too many sites", str(len(keys)), allowed)
    columns = [table[name] for name in ("sigma", "mtf") if name in table]
    names = [np.unique(table["file"].astype(str), return_inverse=True)[1]] if "file" in table else []
    pages = [table["page"]] if "page" in table else []
    order = np.lexsort((*columns, *pages, *names, table["shift"], edge == DIRECTIONS[1], group.ravel()))
    directions = [direction for direction in DIRECTIONS if np.any(edge == direction)]
    out = []
    starts = np.searchsorted(group.ravel()[order], np.arange(len(keys) + 1))
    for k in range(len(keys)):
        rows = order[starts[k] : starts[k + 1]]
        rows_by_edge = {direction: rows[edge[rows] == direction] for direction in directions}
        site = _Site(str(bands[int(keys[k][0])]), table.stacked("x", "y")[rows[0]], FrozenMap(rows_by_edge))
        empty = next((name for name, edge_rows in rows_by_edge.items() if not edge_rows.size), None)
        if empty is not None:
            text = f"{site} has no row of the edge {empty!r}, which other sites have"
            allowed = "both directions at every site, or the same one at all"
            raise table.error(int(rows[0]), "edge", text, allowed=allowed)
        out.append(site)
    return tuple(out)


def _scan(table: Table, site: _Site, shift: Array, mtf: Array, sigma: Array, reasons: Mapping[int, str]) -> SiteScan:
    """Fit the peaks (vertices) of a site's MTF curves through focus."""
    vertex = {}
    for edge, rows in site.rows.items():
        good = int(np.sum(np.isfinite(sigma[rows])))
        try:
            if good < LEAST_POINTS:
                few = f"only {good} of {len(rows)} positions have a measurable edge"
                raise FocusError(f"{few}, at least {LEAST_POINTS} are needed", {})
            vertex[edge] = focus_vertex(shift[rows], mtf[rows], sigma[rows])
        except FocusError as error:
            text = f"no best focus of {site}, edge {edge}: {error}; positions are shifts of the image, metres"
            bad = next((reasons[int(row)] for row in rows if int(row) in reasons), "")
            if bad:
                text += f"; reason for its first image without an edge: {bad}"
            raise table.error(int(rows[0]), "shift", text) from error
    shifts, heights, sigmas = ({edge: v[rows] for edge, rows in site.rows.items()} for v in (shift, mtf, sigma))
    return SiteScan(shifts, heights, sigmas, vertex, frames={}, target=np.empty(0))


def _from_images(
    table: Table, files: FocusFiles, advance: Advance
) -> tuple[Array, Array, dict[int, str], dict[int, str]]:
    """Measure the MTF in the image of every row of a table.

    Returns
    -------
    tuple
        MTF and its sigma, (rows,) each; row -> reason why its image has no measurable edge; row -> reason to doubt its
        sigma.
    """
    region_columns = [name for name in _REGION if name in table]
    if region_columns and len(region_columns) < len(_REGION):
        allowed = "all of row, column, height and width, or none for whole images"
        raise table.error(0, region_columns[0], "part of a region only", names_text(region_columns), allowed)
    band = table["band"] if "band" in table else np.full(len(table), "", dtype=object)
    stranger = next((name for name in files.noise if name not in set(band)), None)
    if stranger is not None:
        have = sorted(set(band))
        text, shown = "no image is of this band", names_text(have)
        raise files.error(text, ("noise", stranger), allowed=shown, suggestion=nearest(stranger, have))
    models = {name: _noise_model(files, name, spec) for name, spec in files.noise.items()}
    folder = Path(table.file).parent

    def measure_row(row: int) -> tuple[float, float, str, str]:
        page = int(table["page"][row]) if "page" in table else None
        region = Region(*(int(table[name][row]) for name in _REGION)) if region_columns else None
        try:
            frames = ImageFile.open(folder / str(table["file"][row]), page=page, choose="").frames(region)
        except ImageError as error:
            raise table.error(row, "file", str(error)) from error
        try:
            edge = measure_pages(frames, noise=models.get(str(band[row])), step=grey_step(frames))
            return *edge.at(files.frequency), "", edge.doubt
        except (EdgeError, ValueError) as error:
            return 0.0, np.inf, str(error), ""

    results: list[tuple[float, float, str, str]] = []
    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        for result in pool.map(measure_row, range(len(table))):
            results.append(result)
            advance("measure the edges", len(results), len(table))
    mtf, sigma = (np.array([result[k] for result in results], np.float64) for k in (0, 1))
    without = {row: result[2] for row, result in enumerate(results) if result[2]}
    doubts = {row: result[3] for row, result in enumerate(results) if result[3]}
    return mtf, sigma, without, doubts


def _noise_model(files: FocusFiles, name: str, spec: NoiseSpec) -> NoiseModel:
    """Return the noise model of a band from its specification."""
    try:
        return NoiseModel(**{field: getattr(spec, field) for field in NoiseSpec.model_fields})
    except ValueError as error:
        raise files.error(str(error).removeprefix("noise model: "), ("noise", name)) from error
