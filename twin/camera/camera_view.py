"""A camera to be looked at interactively: what ``CameraOptics`` says of it, with maps, spots and MTF curves.

>>> camera = CameraView.alone(load_camera("gf7"), load_backend("llvm"))
>>> camera.wavefront(field=(1, 0)).plot()

Of a job's perturbed instrument it is made by

>>> experiment = MonitorExperiment(resolved, backend)
>>> CameraView.within(experiment.instrument, "forward", backend, experiment.state(resolved.job))
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from html import escape
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_results import Field, Mtf, Spot, Wavefront
from twin.framework.svg import BLUE, DIVERGING, GREY, INK, LIGHT, VERMILION, look, plain_axes, to_svg

LINE, TRACK = BLUE, VERMILION
"""Colours of the direction along the line, and along the track."""

WAVES = DIVERGING
"""Colour map of wavefront errors, white where there is none."""


def field_text(field: tuple[float, float]) -> str:
    """A field for a title."""
    along, across = field
    return f"({along:+.2g}, {across:+.2g})".replace("+0)", "0)").replace("(+0,", "(0,").replace("-", "\N{MINUS SIGN}")


def draw_wavefront(axes: Axes, wavefront: Wavefront, most: float | None = None) -> QuadMesh:
    """A map over the stop; ``most``: waves at both ends of the colours, default the map's own largest."""
    values = wavefront.map
    end = float(np.nanmax(np.abs(values))) if most is None else most
    mesh = axes.pcolormesh(
        wavefront.x, wavefront.y, values, cmap=WAVES, vmin=-end, vmax=end, shading="nearest", rasterized=True
    )
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, lw=0.7, color=GREY))
    axes.set_aspect("equal")
    axes.set_xlim(-1.06, 1.06)
    axes.set_ylim(-1.06, 1.06)
    return mesh


def draw_spot(axes: Axes, spot: Spot, half: float | None = None) -> None:
    """Rays about their centroid in a box, um, with the Airy disk; ``half``: of the box's width, metres."""
    rays = 1e6 * (spot.rays - spot.centroid)
    reach = 1e6 * (max(1.15 * spot.airy, 1.1 * spot.farthest) if half is None else half)
    axes.plot(rays[:, 0], rays[:, 1], ".", ms=2.2, color=BLUE, mew=0.0)
    axes.add_patch(Circle((0.0, 0.0), 1e6 * spot.airy, fill=False, lw=0.8, color=INK))
    axes.axhline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.axvline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)


def draw_mtf(axes: Axes, mtf: Mtf, label: bool = True) -> None:
    """Both directions over cycles/mm, with the limit of diffraction and Nyquist's frequency."""
    frequency = 1e-3 * mtf.frequency
    for values, limit, colour, name in zip(
        mtf.values, mtf.limit, (LINE, TRACK), ("along the line", "along the track"), strict=True
    ):
        axes.plot(frequency, values, color=colour, lw=1.4, label=name if label else None)
        axes.plot(frequency, limit, color=INK, lw=0.7, ls=(0, (4, 3)), zorder=4)
    if label:
        axes.plot([], [], color=INK, lw=0.7, ls=(0, (4, 3)), label="diffraction limit")
    axes.axvline(1e-3 * mtf.nyquist, color=GREY, lw=0.8, ls=":")
    axes.annotate(
        "Nyquist", (1e-3 * mtf.nyquist, 0.98), (3, 0), textcoords="offset points", va="top", color=GREY, fontsize=7.5
    )
    axes.set_xlim(0.0, float(frequency[-1]))
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("cycles/mm")
    plain_axes(axes)


class Pictured:
    """What a notebook shows as its words and its figure."""

    def plot(self) -> Figure:
        """The figure."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        figure = self.plot()
        # an svg has no size of its own here, and would be as wide as the notebook
        width = f"{figure.get_figwidth():.1f}in"
        return f'<p>{escape(repr(self))}</p><div style="max-width: {width}">{to_svg(figure)}</div>'


SIZE = (4.6, 4.0)
"""Width and height of a picture, inches."""


@dataclass(frozen=True, eq=False, repr=False)
class WavefrontView(Wavefront, Pictured):
    """A wavefront error that can be drawn."""

    def plot(self) -> Figure:
        """Map over the stop, waves."""
        with look("wavefront"):
            figure = Figure(figsize=SIZE, layout="constrained")
            axes = figure.subplots()
            mesh = draw_wavefront(axes, self)
            axes.set_title(f"field {field_text(self.field)}: {self.rms:.3g} waves rms, {self.peak_to_valley:.3g} PV")
            axes.set_xlabel("x / stop radius (along the line)")
            axes.set_ylabel("y / stop radius (along the track)")
            figure.colorbar(mesh, ax=axes, label=f"waves of {1e9 * self.wavelength:.0f} nm", shrink=0.85)
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class SpotView(Spot, Pictured):
    """A spot that can be drawn."""

    def plot(self) -> Figure:
        """Rays and the Airy disk."""
        with look("spot"):
            figure = Figure(figsize=(SIZE[1], SIZE[1]), layout="constrained")
            axes = figure.subplots()
            draw_spot(axes, self)
            axes.set_title(f"field {field_text(self.field)}: rms radius {1e6 * self.rms:.3g} \N{MICRO SIGN}m")
            axes.set_xlabel("along the line [\N{MICRO SIGN}m]")
            axes.set_ylabel("along the track [\N{MICRO SIGN}m]")
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class MtfView(Mtf, Pictured):
    """An MTF that can be drawn."""

    def plot(self) -> Figure:
        """Both directions, the limit of diffraction, Nyquist's frequency."""
        with look("mtf"):
            figure = Figure(figsize=SIZE, layout="constrained")
            axes = figure.subplots()
            draw_mtf(axes, self)
            axes.set_title(f"MTF of the optics, field {field_text(self.field)}")
            axes.legend()
        return figure


class CameraView(CameraOptics, Pictured):
    """``CameraOptics`` of which wavefront, spot and MTF have ``plot()``; made by ``alone`` or ``within``, as that."""

    def plot(self) -> Figure:
        """The layout as designed with rays of three fields, in the plane of symmetry and from above."""
        # it draws with what the reports draw with
        from twin.camera.layout_plot import layout_figure

        with look("layout"):
            return layout_figure(self.model, self.path.backend)

    def wavefront(self, field: Field = (0.0, 0.0), points: int = 129) -> WavefrontView:
        """Wavefront error at a field (shares of the half field along the line, along the track); ``points`` of its map
        on each axis. Raises as ``CameraOptics.rays``.
        """
        return _shown(WavefrontView, super().wavefront(field, points))

    def spot(self, field: Field = (0.0, 0.0), defocus: float = 0.0) -> SpotView:
        """Spot at a field, on the line CCD moved by ``defocus`` metres downstream. Raises as ``CameraOptics.rays``."""
        return _shown(SpotView, super().spot(field, defocus))

    def mtf(self, field: Field = (0.0, 0.0), frequency: np.ndarray | None = None) -> MtfView:
        """MTF at a field and frequencies (cycles/m). Raises as ``CameraOptics.pupils``."""
        return _shown(MtfView, super().mtf(field, frequency))


Shown = TypeVar("Shown")


def _shown(kind: type[Shown], value: Any) -> Shown:
    return kind(**{own.name: getattr(value, own.name) for own in fields(value)})
