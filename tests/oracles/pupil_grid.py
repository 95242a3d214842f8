"""A traced exit pupil on a square grid, as other people's diffraction software wants it, and poppy's image of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.diffraction import Grid, PupilField
from optics.waves.imaging import aim_collimated, imaging_rays, pupil_field
from optics.waves.pupil_stack import PupilFunction, fit_pupils
from scenes.models.camera_model import CameraModel, field_direction

WAVELENGTH = 650e-9
_FIT = quadrature.disk(16, 64)
_MARGIN = 1.02
"""Half width of the grid over the farthest point of the pupil's edge."""


class FarPoint:
    """The light of a far point through a camera in some state, in the prescription frame."""

    def __init__(self, backend: Backend, model: CameraModel, x: float, y: float, state: State) -> None:
        bare = model.bare_assembly()
        self.backend, self.stop = backend, model.apertures[model.spec.stop]
        self.systems = assemble(bare, ["imaging"], [state])
        self.to_stop = assemble(bare, [model.mirrors[: model.mirrors.index(model.spec.stop) + 1]], [state])
        self.direction = field_direction(model.spec, x, y)
        self.launch = -3.0 * self.direction
        start, _ = aim_collimated(backend, self.to_stop, self.direction, self.launch, np.zeros((1, 2)))
        chief = make_rays(backend, start[0], self.direction)
        self.centre = trace(backend, self.systems, chief).numpy()[0][0, 0]

    def field(self, nodes: PupilNodes) -> PupilField:
        """Plane waves about the chief ray's image."""
        beam = self.systems, self.to_stop, self.direction, self.launch, self.stop, nodes
        return pupil_field(imaging_rays(self.backend, *beam), WAVELENGTH, self.centre)


@dataclass(frozen=True, eq=False)
class PupilGrid:
    """Samples on a square grid of direction cosines, rows v, columns u.

    Attributes:
        u, v: direction cosines, (n, n).
        wave: amplitude density times exp(i k eikonal) times the share of the cell inside the pupil, (n, n).
        eikonal: metres, (n, n).
        width: of the whole grid in direction cosines.
    """

    u: np.ndarray
    v: np.ndarray
    wave: np.ndarray
    eikonal: np.ndarray
    width: float

    def field(self) -> PupilField:
        """The lit samples as plane waves of the twin."""
        lit = self.wave != 0.0
        cell = (self.width / len(self.u)) ** 2
        amplitude = np.abs(self.wave[lit]) * cell
        return PupilField(self.u[lit][None], self.v[lit][None], self.eikonal[lit][None], amplitude[None], WAVELENGTH)

    def largest_phase(self, axis: Grid) -> float:
        """Phase from the pupil's middle to its edge at the corners of an image, radians."""
        corner = np.hypot(*(2 * (0.5 * axis.count * axis.step,)))
        return float(np.pi * self.width / _MARGIN * corner / WAVELENGTH)

    def poppy_irradiance(self, axis: Grid) -> np.ndarray:
        """Irradiance on a grid centred at 0, by poppy's matrix Fourier transform, 1/m^2 for unit power."""
        wave = poppy_wave(self.wave, axis, self.width)
        size, count = len(self.u), axis.count
        extent = count * axis.step * self.width / WAVELENGTH
        unit = extent / (size * count)  # poppy's own norm, which keeps the power of square samples
        cell = (self.width / size) ** 2
        return np.asarray(np.abs(wave) ** 2 * (cell / (unit * WAVELENGTH)) ** 2)


def poppy_wave(pupil: np.ndarray, axis: Grid, width: float) -> Any:
    """poppy's field of a pupil whose grid is ``width`` wide in direction cosines, on a grid centred at 0."""
    from poppy.matrixDFT import matrix_dft

    assert abs(axis.start + 0.5 * (axis.count - 1) * axis.step) < 1e-15
    return matrix_dft(pupil, axis.count * axis.step * width / WAVELENGTH, axis.count, centering="SYMMETRIC")


def pupil_grid(pupil: PupilFunction, size: int, parts: int = 8) -> PupilGrid:
    """A fitted pupil on size x size cells; a cell at the edge counts with its share inside, from parts^2 samples."""
    rim, _ = pupil.edge.boundary(np.linspace(0.0, 2.0 * np.pi, 4096, endpoint=False))
    u_rim, v_rim, _ = pupil.cosines(rim)
    width = 2.0 * _MARGIN * float(max(np.max(np.abs(u_rim - pupil.centre[0])), np.max(np.abs(v_rim - pupil.centre[1]))))

    def normalised(count: int) -> np.ndarray:
        place = width * ((np.arange(count) + 0.5) / count - 0.5)
        return pupil.normalised(*np.meshgrid(place, place))

    fine = normalised(size * parts)
    order = np.argsort(np.angle(rim))
    reach = np.interp(np.angle(fine), np.angle(rim)[order], np.abs(rim)[order], period=2.0 * np.pi)
    share = (np.abs(fine) <= reach).reshape(size, parts, size, parts).mean(axis=(1, 3))
    p = normalised(size)
    eikonal, amplitude = pupil.values(p)
    u, v, _ = pupil.cosines(p)
    eikonal = np.where(share > 0.0, eikonal, 0.0)
    wave = np.where(share > 0.0, share * amplitude, 0.0) * np.exp(2j * np.pi / WAVELENGTH * eikonal)
    return PupilGrid(u, v, wave, eikonal, width)


def fitted(point: FarPoint) -> PupilFunction:
    """Its exit pupil as a smooth function."""
    (pupil,) = fit_pupils(point.field(_FIT), _FIT)
    return pupil
