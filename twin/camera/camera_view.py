"""A camera to be looked at by hand: what ``CameraOptics`` says of it, with a picture of each.

>>> camera = CameraView.alone(load_camera("gf7"), load_backend("llvm"))
>>> camera.wavefront(field=(1, 0)).plot()

Of a job's perturbed instrument it is made by

>>> experiment = MonitorExperiment(resolved, backend)
>>> CameraView.within(experiment.instrument, "forward", backend, experiment.state(resolved.job))
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from twin.camera.camera_optics import CameraOptics, Field, Mtf, Spot, Wavefront
from twin.camera.view_plots import draw_mtf, draw_spot, draw_wavefront, field_text
from twin.run.svg import look

SIZE = (4.6, 4.0)
"""Of a picture, inches."""


@dataclass(frozen=True, eq=False)
class WavefrontView(Wavefront):
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


@dataclass(frozen=True, eq=False)
class SpotView(Spot):
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


@dataclass(frozen=True, eq=False)
class MtfView(Mtf):
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


class CameraView(CameraOptics):
    """``CameraOptics`` of which wavefront, spot and MTF have ``plot()``; made by ``alone`` or ``within``, as that."""

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
