"""Focal-plane alignment from a measured through-focus series: a table of MTF values, or images of a slanted knife edge,
to vertices, a weighted plane and shims.

Everything from the MTF values on is what the simulated bench's images go through.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.focal_plane.plane_fit import LineLevel, ObservabilityError
from analysis.focal_plane.through_focus import LEAST_POINTS, FocusError, focus_vertex
from analysis.images.image_file import ImageError, ImageFile, Region
from analysis.mtf.edge_location import EdgeError
from analysis.spots.noise import NoiseModel
from optics.numerics.backend import Backend
from optics.numerics.frozen_map import FrozenMap
from optics.numerics.threads import cores, one_blas_thread
from scenes.specs.camera_tests import FocusFiles, MeasuredFocusSpec, NoiseSpec
from scenes.specs.resolved import ExperimentSetup, FocusSetup, MeasuredFocusSetup
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue, names_text, nearest
from scenes.yaml.units import LENGTH
from twin.laboratory.focus_alignment import Alignment, Shimming, decide, mount_of, run_focus
from twin.laboratory.focus_scan import SiteScan, edge_mtf
from twin.laboratory.measured_readings import DataFile
from twin.run.procedure import Advance, silent
from twin.targets.target_images import ALONG, DIRECTIONS

__all__ = ["MeasuredAlignment", "MeasuredSite", "align_measured", "run_focus_test"]

Array = NDArray[np.float64]
MOST_SITES = 3000
NANOMETRE = 1e-9
"""Places nearer than this are one."""
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
_REGION = ("row", "column", "height", "width")


@dataclass(frozen=True, eq=False)
class MeasuredSite:
    """One place of the focal plane with its rows of the table.

    Attributes:
        band: whose CCD; empty if the table does not say.
        place: (X', Y'), metres.
        rows: edge -> its rows of the table, by shift.
    """

    band: str
    place: Array
    rows: Mapping[str, NDArray[np.intp]]

    def __str__(self) -> str:
        x, y = 1e3 * self.place
        return f"{self.band + ' at ' if self.band else ''}x {x:.6g} mm, y {y:.6g} mm"


@dataclass(frozen=True, eq=False)
class NoEdge:
    """An image in which no edge could be measured, and why."""

    file: str
    line: int
    reason: str


@dataclass(frozen=True, eq=False)
class MeasuredAlignment:
    """One measured standing of the assembly, and what to do about it.

    Attributes:
        spec: of the test.
        seed: of the command; nothing is drawn.
        sites: with their rows.
        scans: of each site.
        no_edge: images that could not be measured.
        level: of the line; None if nobody read it.
        shimming: plane and shims.
        file: the table.
    """

    spec: MeasuredFocusSpec
    seed: int
    sites: tuple[MeasuredSite, ...]
    scans: tuple[SiteScan, ...]
    no_edge: tuple[NoEdge, ...]
    level: LineLevel | None
    shimming: Shimming
    file: DataFile

    @cached_property
    def defocus(self) -> Array:
        """Measured, (N,), metres, positive where the CCD stands downstream of best focus."""
        return np.array([scan.defocus for scan in self.scans])

    @cached_property
    def defocus_sigma(self) -> Array:
        """Its sigma by noise, (N,), metres."""
        return np.array([scan.defocus_sigma for scan in self.scans])

    @property
    def edges(self) -> tuple[str, ...]:
        """Directions that were measured."""
        return tuple(self.scans[0].vertex)

    @property
    def chi_square(self) -> tuple[float, int]:
        """Of all curves through focus together, and their degrees of freedom."""
        every = [vertex for scan in self.scans for vertex in scan.vertex.values()]
        return sum(v.chi_square for v in every), sum(v.degrees_of_freedom for v in every)


def run_focus_test(
    setup: ExperimentSetup[Any], backend: Backend, seed: int, advance: Advance = silent
) -> Alignment | MeasuredAlignment:
    """``python -m twin.lab focus``. Raises InputError, BenchError."""
    if isinstance(setup, MeasuredFocusSetup):
        return align_measured(setup.test, seed, advance)
    assert isinstance(setup, FocusSetup)
    return run_focus(setup, backend, seed, advance)


def align_measured(spec: MeasuredFocusSpec, seed: int = 0, advance: Advance = silent) -> MeasuredAlignment:
    """Read the series, find best focus at every place, fit the plane and decide on shims.

    Raises:
        InputError: a table or an image cannot be used, or no best focus can be told from it.
        BenchError: the mount does not allow the motion.
    """
    files = spec.measured
    advance("read the series", 0, 1)
    images = files.images is not None
    table = read_table(str(files.images or files.mtf), IMAGE_COLUMNS if images else MTF_COLUMNS, 5)
    sites = _sites(table)
    mtf, sigma, reasons = _from_images(table, files, advance) if images else (table["mtf"], table["sigma"], {})
    shift = table["shift"] * _per_shift(table, files)
    scans = tuple(_scan(table, site, shift, mtf, sigma, reasons) for site in sites)
    level = None if files.level is None else LineLevel(files.level.angle, files.level.sigma, np.zeros(2), 0.0, 0)
    mount = mount_of(spec)
    places, defocus = np.array([site.place for site in sites]), np.array([scan.defocus for scan in scans])
    noise = np.array([scan.defocus_sigma for scan in scans])
    present = np.array(spec.shims or [spec.mount.thickness] * len(spec.mount.holes))
    try:
        shimming = decide(places, defocus, noise, level, mount, present, (spec.vertex_error, spec.vertex_trend))
    except ObservabilityError as error:
        text = str(error).removeprefix("focal plane: ")
        raise InputError(Issue(text, table.file, int(table.lines[0]), ("x",))) from error
    return MeasuredAlignment(
        spec=spec,
        seed=seed,
        sites=sites,
        scans=scans,
        no_edge=tuple(NoEdge(table.file, int(table.lines[row]), reasons[row]) for row in sorted(reasons)),
        level=level,
        shimming=shimming,
        file=DataFile.of(table),
    )


def _per_shift(table: Table, files: FocusFiles) -> Array | float:
    """What a shift of the table is multiplied by to be one of the image along the light."""
    if files.moved != "target":
        if "per shift" in table:
            raise table.error(
                0, "per shift", "only a target's move is another than the image's", allowed="moved: target"
            )
        # a CCD that moves downstream sees what it would see if the image moved upstream
        return 1.0 if files.moved == "image" else -1.0
    if "per shift" in table:
        return table["per shift"]
    if files.per_shift is None:
        text = "how far the image moves with the target is not told"
        allowed = "per_shift: (f of the camera / f of the collimator)^2, or a column 'per shift'"
        raise files.error(text, ("moved",), found="target", allowed=allowed)
    return files.per_shift


def _sites(table: Table) -> tuple[MeasuredSite, ...]:
    """Places in the order of bands as they are named and of their places, each with its rows."""
    band = table["band"] if "band" in table else np.full(len(table), "", dtype=object)
    edge = table["edge"] if "edge" in table else np.full(len(table), ALONG, dtype=object)
    odd = np.flatnonzero(~np.isin(edge, DIRECTIONS))
    if odd.size:
        row, found = int(odd[0]), str(edge[odd[0]])
        meant = nearest(found, DIRECTIONS)
        raise table.error(row, "edge", "no such direction", found, names_text(DIRECTIONS), meant)
    bands, of_band = np.unique(band.astype(str), return_inverse=True)
    spots = np.rint(table.stacked("x", "y") / NANOMETRE)
    keys, group = np.unique(np.column_stack([of_band, spots]), axis=0, return_inverse=True)
    if len(keys) > MOST_SITES:
        allowed = f"at most {MOST_SITES} places; x and y are those of the field, the same in all rows of a place"
        raise InputError(Issue("too many places", table.file, int(table.lines[0]), ("x",), str(len(keys)), allowed))
    columns = [table[name] for name in ("sigma", "mtf") if name in table]
    names = [np.unique(table["file"].astype(str), return_inverse=True)[1]] if "file" in table else []
    pages = [table["page"]] if "page" in table else []
    order = np.lexsort((*columns, *pages, *names, table["shift"], edge == DIRECTIONS[1], group.ravel()))
    directions = [one for one in DIRECTIONS if np.any(edge == one)]
    out = []
    starts = np.searchsorted(group.ravel()[order], np.arange(len(keys) + 1))
    for k in range(len(keys)):
        rows = order[starts[k] : starts[k + 1]]
        own = {one: rows[edge[rows] == one] for one in directions}
        site = MeasuredSite(str(bands[int(keys[k][0])]), table.stacked("x", "y")[rows[0]], FrozenMap(own))
        empty = next((one for one, some in own.items() if not some.size), None)
        if empty is not None:
            text = f"{site} has no row of the edge {empty!r}, which other places have"
            raise table.error(int(rows[0]), "edge", text, allowed="both directions at every place, or one at all")
        out.append(site)
    return tuple(out)


def _scan(
    table: Table, site: MeasuredSite, shift: Array, mtf: Array, sigma: Array, reasons: Mapping[int, str]
) -> SiteScan:
    """The place's curves and their vertices."""
    vertex = {}
    for edge, rows in site.rows.items():
        good = int(np.sum(np.isfinite(sigma[rows])))
        try:
            if good < LEAST_POINTS:
                raise FocusError(
                    f"{good} positions with an edge of {len(rows)}, at least {LEAST_POINTS} are needed", {}
                )
            vertex[edge] = focus_vertex(shift[rows], mtf[rows], sigma[rows])
        except FocusError as error:
            text = f"no best focus of {site}, edge {edge}: {error}; positions are moves of the image, metres"
            bad = next((reasons[int(row)] for row in rows if int(row) in reasons), "")
            if bad:
                text += f"; of its first image without an edge: {bad}"
            raise table.error(int(rows[0]), "shift", text) from error
    return SiteScan(
        shift={edge: shift[rows] for edge, rows in site.rows.items()},
        mtf={edge: mtf[rows] for edge, rows in site.rows.items()},
        sigma={edge: sigma[rows] for edge, rows in site.rows.items()},
        vertex=vertex,
        frames={},
        target=np.empty(0),
    )


def _from_images(table: Table, files: FocusFiles, advance: Advance) -> tuple[Array, Array, dict[int, str]]:
    """MTF and sigma of every row's image, and of those without a measurable edge the reason."""
    given = [name for name in _REGION if name in table]
    if given and len(given) < len(_REGION):
        allowed = "all of row, column, height and width, or none for whole images"
        raise table.error(0, given[0], "part of a region only", names_text(given), allowed)
    band = table["band"] if "band" in table else np.full(len(table), "", dtype=object)
    stranger = next((name for name in files.noise if name not in set(band)), None)
    if stranger is not None:
        have = sorted(set(band))
        text, shown = "no image is of this band", names_text(have)
        raise files.error(text, ("noise", stranger), allowed=shown, suggestion=nearest(stranger, have))
    models = {name: _noise_model(files, name, spec) for name, spec in files.noise.items()}
    folder = Path(table.file).parent

    def one(row: int) -> tuple[float, float, str]:
        page = int(table["page"][row]) if "page" in table else None
        region = Region(*(int(table[name][row]) for name in _REGION)) if given else None
        try:
            frames = ImageFile.open(folder / str(table["file"][row]), page=page, choose="").frames(region)
        except ImageError as error:
            raise table.error(row, "file", str(error)) from error
        try:
            return *edge_mtf(frames, models.get(str(band[row])), files.frequency), ""
        except (EdgeError, ValueError) as error:
            return 0.0, np.inf, str(error)

    results: list[tuple[float, float, str]] = []
    with one_blas_thread(), ThreadPoolExecutor(cores()) as pool:
        for result in pool.map(one, range(len(table))):
            results.append(result)
            advance("measure the edges", len(results), len(table))
    mtf, sigma = (np.array([result[k] for result in results], np.float64) for k in (0, 1))
    return mtf, sigma, {row: result[2] for row, result in enumerate(results) if result[2]}


def _noise_model(files: FocusFiles, name: str, spec: NoiseSpec) -> NoiseModel:
    try:
        return NoiseModel(**{field: getattr(spec, field) for field in NoiseSpec.model_fields})
    except ValueError as error:
        raise files.error(str(error).removeprefix("noise model: "), ("noise", name)) from error
