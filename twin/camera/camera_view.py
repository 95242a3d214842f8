"""Camera for interactive use: ``CameraOptics`` with plots of maps, spots and MTF curves.

>>> camera = CameraView.alone(load_camera("gf7"), load_backend("llvm"))
>>> camera.wavefront(field=(1, 0)).plot()

For the perturbed instrument of a job use

>>> experiment = MonitorExperiment(resolved, backend)
>>> CameraView.within(experiment.instrument, "forward", backend, experiment.state(resolved.job))
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from html import escape
from typing import Any, TypeVar

import numpy as np
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from analysis.arrays import summary
from optics.camera.ghosts import Ghost
from optics.camera.prescription import MIRROR, Camera, OpticalSurface
from optics.geometry.aperture import Circle, Ray
from optics.materials.glass import refractive_index
from optics.numerics.backend import Backend
from scenes.models.camera_model import IMAGE, CameraModel
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import KeyPath
from twin.camera.camera_optics import INSIDE, CameraOptics
from twin.camera.camera_results import Field, FieldText, Frequencies, Mtf, Spot, Wavefront
from twin.camera.first_order_data import obstacles, ray_paths
from twin.framework.artefact import plain
from twin.framework.svg import BLUE, DIVERGING, GREEN, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg

LINE, TRACK = BLUE, VERMILION
"""Plot colours of quantities along the line and along the track."""

WAVES = DIVERGING
"""Colour map of wavefront errors; points without light are white."""


def draw_wavefront(axes: Axes, wavefront: Wavefront, most: float | None = None) -> QuadMesh:
    """Draw a wavefront map over the stop.

    Parameters
    ----------
    axes : Axes
        Axes to draw into.
    wavefront : Wavefront
        Wavefront error.
    most : float, optional
        Waves at both ends of the colour scale; by default the largest absolute value of the map.
    """
    values = wavefront.map
    end = float(np.nanmax(np.abs(values))) if most is None else most
    mesh = axes.pcolormesh(
        wavefront.x, wavefront.y, values, cmap=WAVES, vmin=-end, vmax=end, shading="nearest", rasterized=True
    )
    axes.add_patch(patches.Circle((0.0, 0.0), 1.0, fill=False, lw=0.7, color=GREY))
    axes.set_aspect("equal")
    axes.set_xlim(-1.06, 1.06)
    axes.set_ylim(-1.06, 1.06)
    return mesh


def draw_spot(axes: Axes, spot: Spot, half: float | None = None) -> None:
    """Draw the rays of a spot about their centroid in a box, micrometres, with the Airy disk.

    Parameters
    ----------
    axes : Axes
        Axes to draw into.
    spot : Spot
        Spot.
    half : float, optional
        Half the width of the box, metres; by default it contains all rays and the Airy disk.
    """
    rays = 1e6 * (spot.rays - spot.centroid)
    half_width = 1e6 * (spot.half_width if half is None else half)
    axes.plot(rays[:, 0], rays[:, 1], ".", ms=2.2, color=BLUE, mew=0.0)
    axes.add_patch(patches.Circle((0.0, 0.0), 1e6 * spot.airy, fill=False, lw=0.8, color=INK))
    axes.axhline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.axvline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.set_aspect("equal")
    axes.set_xlim(-half_width, half_width)
    axes.set_ylim(-half_width, half_width)


def draw_mtf(axes: Axes, mtf: Mtf, labels: tuple[str, str] | None = ("along the line", "along the track")) -> None:
    """Draw the MTF along line and track over cycles/mm, with the diffraction limit and the Nyquist frequency.

    Parameters
    ----------
    axes : Axes
        Axes to draw into.
    mtf : Mtf
        MTF at one field.
    labels : tuple of str, optional
        Names of the two directions for a legend; None for none.
    """
    frequency = 1e-3 * mtf.frequency
    names = labels or (None, None)
    for values, limit, colour, name in zip(mtf.values, mtf.limit, (LINE, TRACK), names, strict=True):
        axes.plot(frequency, values, color=colour, lw=1.4, label=name)
        axes.plot(frequency, limit, color=INK, lw=0.7, ls=(0, (4, 3)), zorder=4)
    if labels is not None:
        axes.plot([], [], color=INK, lw=0.7, ls=(0, (4, 3)), label="diffraction limit")
    axes.axvline(1e-3 * mtf.nyquist, color=GREY, lw=0.8, ls=":")
    axes.annotate(
        "Nyquist", (1e-3 * mtf.nyquist, 0.98), (3, 0), textcoords="offset points", va="top", color=GREY, fontsize=7.5
    )
    axes.set_xlim(0.0, float(frequency[-1]))
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("cycles/mm")
    plain_axes(axes)


class Plottable:
    """Base class of results that a notebook shows as text and figure."""

    def plot(self) -> Figure:
        """Return the figure of the result."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        figure = self.plot()
        # an svg has no size of its own here, and would be as wide as the notebook
        width = f"{figure.get_figwidth():.1f}in"
        return f'<p>{escape(repr(self))}</p><div style="max-width: {width}">{to_svg(figure)}</div>'


SIZE = (4.6, 4.0)
"""Width and height of a figure, inches."""


@dataclass(frozen=True, eq=False, repr=False)
class WavefrontView(Wavefront, Plottable):
    """Wavefront error at one field, with a method that plots its map."""

    def plot(self) -> Figure:
        """Plot the map over the stop, waves."""
        with look("wavefront"):
            figure = Figure(figsize=SIZE, layout="constrained")
            axes = figure.subplots()
            mesh = draw_wavefront(axes, self)
            axes.set_title(
                f"field {summary(self.field_rad, 'deg')}: {self.rms:.3g} waves rms, {self.peak_to_valley:.3g} PV"
            )
            axes.set_xlabel("x / stop radius (along the line)")
            axes.set_ylabel("y / stop radius (along the track)")
            figure.colorbar(mesh, ax=axes, label=f"waves of {1e9 * self.wavelength:.0f} nm", shrink=0.85)
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class SpotView(Spot, Plottable):
    """Spot diagram at one field, with a method that plots it."""

    def plot(self) -> Figure:
        """Plot the rays and the Airy disk."""
        with look("spot"):
            figure = Figure(figsize=(SIZE[1], SIZE[1]), layout="constrained")
            axes = figure.subplots()
            draw_spot(axes, self)
            axes.set_title(f"field {summary(self.field_rad, 'deg')}: rms radius {1e6 * self.rms:.3g} \N{MICRO SIGN}m")
            axes.set_xlabel("along the line [\N{MICRO SIGN}m]")
            axes.set_ylabel("along the track [\N{MICRO SIGN}m]")
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class MtfView(Mtf, Plottable):
    """MTF at one field, with a method that plots its curves."""

    def plot(self) -> Figure:
        """Plot the MTF along line and track, the diffraction limit and the Nyquist frequency."""
        with look("mtf"):
            figure = Figure(figsize=SIZE, layout="constrained")
            axes = figure.subplots()
            draw_mtf(axes, self)
            axes.set_title(f"MTF of the optics, field {summary(self.field_rad, 'deg')}")
            axes.legend()
        return figure


class CameraView(CameraOptics, Plottable):
    """``CameraOptics`` whose wavefront, spot and MTF have ``plot()``; create it by ``alone`` or ``within``."""

    def plot(self) -> Figure:
        """Plot the nominal layout with rays of three fields, in the plane of symmetry and from above."""
        # it draws with what the reports draw with
        from twin.camera.camera_view import layout_figure

        with look("layout"):
            return layout_figure(self.model, self.path.backend)

    def wavefront(self, field: Field | FieldText = (0.0, 0.0), points: int = 129) -> WavefrontView:
        """Compute the wavefront error at a field.

        Parameters
        ----------
        field : Field or FieldText
            Angles from the middle of the field, along the line and along the track, such as ``"0.2 -0.1 deg"``, or
            fractions of the half field, such as ``(1, 0)``.
        points : int
            Points of the map on each axis.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        return _shown(WavefrontView, super().wavefront(field, points))

    def ghosts(self, field: Field | FieldText = (0.0, 0.0)) -> tuple[Ghost, ...]:
        """Trace the ghosts of the nominal camera at a field, the largest irradiance first.

        Parameters
        ----------
        field : Field or FieldText
            Field, as for `wavefront`.
        """
        # with first-order data, which need a camera's optics
        from twin.camera.aberrations import camera_ghosts

        along, across = map(float, self.fractions([field])[0])
        return camera_ghosts(self.model, self.path.backend, (along, across))

    @property
    def prescription(self) -> Camera:
        """Nominal camera as an `optics.Camera`, for `optics.psf`, `optics.ensquared_energy`, `optics.seidel` and more.

        The frame of its surfaces is that of the camera's file, with the origin at the first vertex; `field_angles`
        converts fields. Colour and best image plane of this camera are included.

        Raises
        ------
        InputError
            `optics.Camera` cannot describe the surfaces or their edges.
        ValueError
            The camera is perturbed or as built, or prisms of its instrument block light.
        """
        if self.state or self.built:
            raise ValueError(
                "prescription: it describes the nominal camera, and this one is perturbed or as built; take that of "
                "the nominal camera and set decenter, tilt or figure of its surfaces"
            )
        if self.vignetting is not None:
            raise ValueError(
                "prescription: prisms of the instrument block light of this camera, which optics.Camera cannot "
                "describe; camera(NAME, obstruction=False) has its full beam"
            )
        return optics_camera(self.model, self.wavelength)

    def field_angles(self, field: Field | FieldText = (0.0, 0.0)) -> tuple[float, float]:
        """Return the angles x and y of a field from the axis of ``prescription``, radians, as `optics` takes a field.

        Parameters
        ----------
        field : Field or FieldText
            Field, as for `wavefront`.
        """
        along, across = self._angles(self.fractions([field])[0])
        return along, self.model.spec.field_bias + across

    def spot(self, field: Field | FieldText = (0.0, 0.0), defocus: float | str = 0.0) -> SpotView:
        """Compute the spot at a field, on the line CCD moved downstream.

        Parameters
        ----------
        field : Field or FieldText
            Field, as for `wavefront`.
        defocus : float or str
            Distance of the line CCD, metres or with its unit, such as ``"20 um"``.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        return _shown(SpotView, super().spot(field, defocus))

    def mtf(self, field: Field | FieldText = (0.0, 0.0), frequency: Frequencies | None = None) -> MtfView:
        """Compute the MTF at a field.

        Parameters
        ----------
        field : Field or FieldText
            Field, as for `wavefront`.
        frequency : (M,) ndarray or sequence of str or str, optional
            Spatial frequencies in cycles/m, or with their unit, such as ``"50 cycles/mm"``; by default 65 from 0 to the
            cut-off or twice Nyquist, whichever is smaller.

        Raises
        ------
        AimError, BeamMissedError, ValueError
            The light is lost, edges cut a pupil into too many pieces, or a wavefront is too irregular.
        """
        return _shown(MtfView, super().mtf(field, frequency))


Shown = TypeVar("Shown")


def _shown(kind: type[Shown], value: Any) -> Shown:
    """Convert a wavefront, spot or MTF to the subclass that has a ``plot`` method."""
    return kind(**{field.name: getattr(value, field.name) for field in fields(value)})


_EDGES = "one clear circle, one blocking circle and vanes about one centre, at the stop about its middle"


def optics_camera(model: CameraModel, wavelength: float) -> Camera:
    """Return the nominal camera as an `optics.Camera`, whose frame is that of the file moved to the first vertex.

    Parameters
    ----------
    model : CameraModel
        The camera.
    wavelength : float
        Wavelength of the light, metres.

    Raises
    ------
    InputError
        `optics.Camera` cannot describe the camera: a surface has terms of ``sag`` or other edges than circles and vanes
        about one centre, or vertices in another order than that of the light.
    """
    spec = model.spec
    heights = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    surfaces: list[OpticalSurface] = []
    medium: str | float = 1.0
    for (name, mirror), thickness in zip(spec.mirrors.items(), np.diff(heights), strict=True):
        if mirror.sag:
            problem = f"optics.Camera has conics and even aspheric terms only, and {name} has further terms of its sag"
            raise spec.error(problem, ("mirrors", name, "sag"), allowed="radius, conic and aspheric")
        shape, light = model.surfaces[name], mirror.light
        if light == "refracts":
            medium = _material(spec, name, wavelength)
        x, y = mirror.decentre or (0.0, 0.0)
        outer, inner, vanes, centre = _edges(model, name)
        surface = OpticalSurface(
            radius=mirror.radius,
            thickness=float(thickness),
            conic=shape.conic,
            material=MIRROR if light is None else medium,
            diameter=2.0 * outer,
            inner_diameter=2.0 * inner,
            vanes=vanes,
            offset=centre,
            asphere=shape.even,
            decenter=(x, y),
            tilt=mirror.rotate or (0.0, 0.0, 0.0),
        )
        surfaces.append(surface)
    try:
        tilt = (spec.image.tilt or 0.0, 0.0, 0.0)
        return Camera(surfaces, wavelength, model.mirrors.index(spec.stop), tilt, spec.medium or "vacuum")
    except ValueError as error:  # a thickness against the light
        problem = f"optics.Camera cannot describe this camera: {error}"
        raise spec.error(problem, ("mirrors",), allowed="vertices in the order of the light") from error


def _material(spec: CameraSpec, name: str, wavelength: float) -> str | float:
    """Return the glass behind a lens face by name where the catalogue has it, else its refractive index."""
    index, glass = spec.index_behind(name, wavelength), spec.mirrors[name].glass
    with suppress(ValueError):  # the catalogue does not have the glass, or not at this wavelength
        if glass is not None and refractive_index(glass.name, wavelength, spec.medium or "vacuum") == index:
            return glass.name
    return index


def _edges(model: CameraModel, name: str) -> tuple[float, float, tuple[tuple[float, float], ...], tuple[float, float]]:
    """Return the edges of a surface: radii of its rim and of its hole, vanes, and their common centre, metres.

    Raises
    ------
    InputError
        `OpticalSurface` cannot describe these edges.
    """
    key: KeyPath = ("mirrors", name, "edges")
    rims: list[float] = []
    holes: list[float] = []
    vanes: list[tuple[float, float]] = []
    centres: list[tuple[float, float]] = []
    if name == model.spec.stop:
        x_min, x_max, y_min, y_max = model.apertures[name].bounds
        rims.append(0.5 * (x_max - x_min))
        centres.append((0.5 * (x_min + x_max), 0.5 * (y_min + y_max)))
    other = False
    for edge in model.edges.get(name, ()):
        shape = edge.shape
        if isinstance(shape, Circle):
            (holes if edge.blocks else rims).append(shape.radius)
            holes += [shape.inner] if shape.inner and not edge.blocks else []
            other = other or bool(edge.blocks and shape.inner)
        elif isinstance(shape, Ray) and edge.blocks:
            vanes.append((shape.width, edge.rotation))
        else:
            other = True
        centres.append(shape.centre)
    if other or len(rims) > 1 or len(holes) > 1 or len(set(centres)) > 1:
        raise model.spec.error(f"optics.Camera cannot describe the edges of {name}", key, allowed=_EDGES)
    rim, hole, centre = (*rims, np.inf)[0], (*holes, 0.0)[0], (*centres, (0.0, 0.0))[0]
    return float(rim), hole, tuple(vanes), centre


_END_COLOURS = (BLUE, GREEN, VERMILION)
"""Colours of the negative end of the field, its middle and its positive end."""

INCOMING = 0.16
"""Length of the incoming rays in the drawing, as a fraction of the layout's length."""

_CHARACTER, _LEVEL, _LEVELS = 0.07, 0.155, 3
"""Width of a character and height of a line of labels, inches, and the number of lines of labels above each other."""

_VIEWS = ((1, "y", "Side view, in the plane of symmetry"), (0, "x", "Top view, along the line"))


def layout_figure(model: CameraModel, backend: Backend) -> Figure:
    """Draw chief and marginal rays of three fields, mirrors, stop and focal plane in both views, to the same scale."""
    boxes = [_extent(model, backend, axis) for axis, _, _ in _VIEWS]
    low, high = min(b[0] for b in boxes), max(b[1] for b in boxes)
    heights = [b[3] - b[2] for b in boxes]
    scale = 9.6 / (high - low)  # inches of the page per metre
    figure = new_figure(min(scale * sum(heights) + 1.5, 12.0))
    sizes = _sizes(model)
    axes = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": heights})
    for panel, (axis, name, title), box in zip(axes, _VIEWS, boxes, strict=True):
        _view(panel, model, backend, axis, low, scale)
        panel.set_xlim(low, high)
        panel.set_ylim(box[2], box[3])
        panel.set_aspect("equal")
        panel.set_title(title, loc="left")
        panel.set_ylabel(f"{name} [m]")
        _measure(panel, sizes[axis], sizes[2])
        plain_axes(panel)
    axes[1].set_xlabel("z along the parent axis [m]")
    return figure


def _measure(axes: Axes, across: np.ndarray, along: np.ndarray) -> None:
    """Write the overall length and height of the parts in a view, with arrows from end to end, metres."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    below, beside = low + 0.03 * (high - low), right - 0.012 * (right - left)
    for upright, ends in ((0, [(end, below) for end in along]), (90, [(beside, end) for end in across])):
        x, y = np.mean(ends, axis=0)
        text = f"{plain(float(np.linalg.norm(np.diff(ends, axis=0))), 4)} m"
        style = {"arrowstyle": "<->", "color": GREY, "lw": 0.7, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", ends[0], ends[1], arrowprops=style)
        label = axes.text(
            float(x), float(y), text, rotation=upright, ha="center", va="center", fontsize=7.5, color=GREY
        )
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.6})


def _fields(axis: int) -> list[tuple[float, float]]:
    """Return both ends and the middle of the field along ``axis`` as three fields, in fractions of the half fields.

    Axis 0 is along the line, axis 1 along the track.
    """
    return [(s, 0.0) if axis == 0 else (0.0, s) for s in (-1.0, 0.0, 1.0)]


def section_rays(
    model: CameraModel, backend: Backend, axis: int, fields: Sequence[tuple[float, float]] | None = None
) -> np.ndarray:
    """Trace chief, lower and upper marginal ray of F fields to K surfaces, (1 + K, F, 3, 3), metres.

    The axes are launch point and surfaces, fields, rays and coordinates x, y, z. The plane of the rays is along
    ``axis``: 0 for the line, 1 for the track. By default the fields are both ends and the middle along ``axis``.
    """
    stop = np.zeros((3, 2))
    stop[1:, axis] = -INSIDE, INSIDE
    return ray_paths(model, backend, _fields(axis) if fields is None else fields, stop).points


def _extent(model: CameraModel, backend: Backend, axis: int) -> tuple[float, float, float, float]:
    """Return the limits of a drawing: smallest and largest z and transverse coordinate, with a margin, metres."""
    rays = section_rays(model, backend, axis)
    points = rays[1:]
    z = points[..., 2]
    length = float(np.ptp(z))
    room = 0.05 * length
    first = float(z.min()) - INCOMING * length
    beams = np.ravel(points[..., axis]), np.ravel(begun(rays, first)[0, ..., axis])
    across = np.concatenate([*beams, _sizes(model)[axis]])
    return (first, float(z.max()) + 2.0 * room, float(across.min()) - 1.5 * room, float(across.max()) + room)


def begun(points: np.ndarray, first: float) -> np.ndarray:
    """Return rays, (1 + K, ..., 3) points on K surfaces, extended to begin at z = ``first`` metres."""
    start, then = points[0], points[1]
    share = (first - start[..., 2:]) / (then - start)[..., 2:]
    return np.concatenate([(start + share * (then - start))[None], points[1:]])


def _view(axes: Axes, model: CameraModel, backend: Backend, axis: int, first: float, scale: float) -> None:
    """Draw the side view or the top view of the layout with its rays, from z = ``first``, inches per metre."""
    points = begun(section_rays(model, backend, axis), first)
    half = np.degrees((model.spec.field.x, model.spec.field.y)[axis])
    for share, colour in zip((-1.0, 0.0, 1.0), _END_COLOURS, strict=True):
        axes.plot([], [], color=colour, label=f"field {plain(share * half)}\N{DEGREE SIGN}")
    axes.plot([], [], color=GREY, ls=(0, (5, 2)), lw=1.0, label="chief ray")
    axes.plot([], [], color=GREY, lw=0.7, label="marginal rays")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, borderaxespad=0.1, fontsize=7.5)
    for k, colour in enumerate(_END_COLOURS):
        for ray, width in ((1, 0.7), (2, 0.7), (0, 1.0)):
            line = points[:, k, ray]
            style = (0, (5, 2)) if ray == 0 else "-"
            axes.plot(line[:, 2], line[:, axis], color=colour, lw=width, ls=style, alpha=0.9)
    edges = obstacles(model)
    _label(axes, model, section_lines(model, axis), axis, scale)
    for name, drawn in section_lines(model, axis, 401, holes=True).items():
        if name not in edges and name != IMAGE and model.spec.mirrors[name].light == "passes":  # no body is there
            axes.plot(drawn[:, 2], drawn[:, axis], color=GREY, lw=0.8, ls=(0, (1, 2)), zorder=3)
        else:
            axes.plot(drawn[:, 2], drawn[:, axis], color=INK, lw=2.6, solid_capstyle="butt", zorder=3)
    axes.axhline(0.0, color=LIGHT, lw=0.7, ls=(0, (8, 3, 2, 3)), zorder=0)


def _sizes(model: CameraModel) -> np.ndarray:
    """Return the least and the largest x, y and z of mirrors, lenses and line CCDs, (3, 2), metres."""
    bodies = obstacles(model)
    sections = (section_lines(model, axis) for axis in (0, 1))
    drawn = np.concatenate([points for lines in sections for name, points in lines.items() if name in bodies])
    return np.stack([drawn.min(axis=0), drawn.max(axis=0)], axis=-1)


def dimensions(model: CameraModel) -> list[tuple[str, str, float]]:
    """Return the distances between the vertices of a camera and its overall sizes: from, to, metres.

    Overall sizes are those of the clear apertures and the focal plane, along z, y and x.
    """
    names = [*model.mirrors, IMAGE]
    places = [*(model.vertex(name) for name in model.mirrors), model.image_body.translation]
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    out = [(a, _title(b), float(gap)) for a, b, gap in zip(names, names[1:], gaps, strict=False)]
    sizes = np.ptp(_sizes(model), axis=-1)
    ends = (("length", 2), ("height, y", 1), ("width, x", 0))
    return [*out, *(("overall", text, float(sizes[axis])) for text, axis in ends)]


def _title(name: str) -> str:
    """Return the name of a surface for readers."""
    return "focal plane" if name == IMAGE else name


def section_lines(model: CameraModel, axis: int, points: int = 80, holes: bool = False) -> dict[str, np.ndarray]:
    """Return surface, or ``IMAGE`` -> its section along ``axis`` (0: line, 1: track), (points, 3) points in metres.

    With ``holes`` points of a mirror within a circle that blocks are nan.
    """
    edges, lines = obstacles(model), {}
    for name in (*model.mirrors, IMAGE):
        edge = edges.get(name, model.apertures.get(name))
        assert edge is not None
        across = np.linspace(edge.bounds[2 * axis], edge.bounds[2 * axis + 1], points)
        other = np.full(points, edge.centre[1 - axis])
        x, y = (across, other) if axis == 0 else (other, across)
        pose = model.image_body if name == IMAGE else model.mirror_pose(name)
        sag = np.zeros(points) if name == IMAGE else model.surfaces[name].sag(x, y)
        bored = holes and name != IMAGE and not model.spec.mirrors[name].light
        for stop in model.edges.get(name, ()) if bored else ():
            if stop.blocks and isinstance(stop.shape, Circle) and not stop.shape.inner:
                x0, y0 = stop.shape.centre
                sag = np.where(np.hypot(x - x0, y - y0) < stop.shape.radius, np.nan, sag)
        lines[name] = pose.apply(np.stack([x, y, sag], axis=-1))
    return lines


def _label(axes: Axes, model: CameraModel, lines: Mapping[str, np.ndarray], axis: int, scale: float) -> None:
    """Write the names of the surfaces beside their drawings, clear of each other.

    ``lines`` are the sections along ``axis``, and ``scale`` is the size of the drawing, inches per metre.
    """
    taken: list[np.ndarray] = []
    for name, section in lines.items():
        drawn = section[:, [2, axis]]
        text = f"{name}, stop" if name == model.spec.stop else _title(name)
        # beyond the end that is farther from the axis; in the top view all ends are alike, and neighbours alternate
        alternate = name == IMAGE or model.mirrors.index(name) == 0
        first = int(np.argmax(np.abs(drawn[[0, -1], 1]))) if axis == 1 else int(alternate)
        right = isinstance(model.apertures.get(name), Circle) or name == IMAGE
        for level, end in itertools.product(range(_LEVELS), (drawn[-first], drawn[first - 1])):
            up = 1 if end[1] >= np.mean(drawn[:, 1]) else -1
            size = np.array([_CHARACTER * len(text), _LEVEL]) / scale
            middle = end + np.array([-0.5 if right else 0.5, up * (0.5 + level)]) * size
            if not any(np.all(np.abs(middle - other[0]) < 0.5 * (size + other[1])) for other in taken):
                break
        taken.append(np.stack([middle, size]))
        axes.annotate(
            text,
            (float(end[0]), float(end[1])),
            (-4 if right else 4, up * (4 + 72 * _LEVEL * level)),
            textcoords="offset points",
            ha="right" if right else "left",
            va="bottom" if up > 0 else "top",
            color=INK,
            fontsize=8.5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8},
        )
