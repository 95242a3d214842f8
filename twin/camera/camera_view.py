"""Camera for interactive use: ``CameraOptics`` with plots of maps, spots and MTF curves.

>>> camera = CameraView.alone(load_camera("gf7"), load_backend("llvm"))
>>> camera.wavefront(field=(1, 0)).plot()

For the perturbed instrument of a job use

>>> experiment = MonitorExperiment(resolved, backend)
>>> CameraView.within(experiment.instrument, "forward", backend, experiment.state(resolved.job))
"""

from __future__ import annotations

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
from scenes.models.camera_model import CameraModel
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import KeyPath
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field, FieldText, Frequencies, Mtf, Spot, Wavefront
from twin.framework.svg import BLUE, DIVERGING, GREY, INK, LIGHT, VERMILION, look, plain_axes, to_svg

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
    reach = 1e6 * (spot.half_width if half is None else half)
    axes.plot(rays[:, 0], rays[:, 1], ".", ms=2.2, color=BLUE, mew=0.0)
    axes.add_patch(patches.Circle((0.0, 0.0), 1e6 * spot.airy, fill=False, lw=0.8, color=INK))
    axes.axhline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.axvline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)


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
        from twin.camera.layout_plot import layout_figure

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
        if self.cut is not None:
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
