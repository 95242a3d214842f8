"""Readings of noise-free images along a change, and where they leave a tolerance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.monitor import monitoring
from analysis.monitor.monitoring import PER_SI, MonitorGeometry
from analysis.monitor.recovery import measure_spots
from optics.geometry import zernike
from optics.geometry.tree import State
from optics.numerics.backend import cores
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from twin.monitor.monitor_experiment import MonitorExperiment

PRINTED, JOINT, CORRECTED, CALIBRATED = "printed", "Table 1", "corrected", "calibrated"
FORMS = (PRINTED, JOINT, CORRECTED, CALIBRATED)
"""(2), (3), (5), (7) with the arctangent; Table 1's joint forms; the same with f_x for d_alpha, half of d_gamma times
f/f_x, no cos^2, and (7); those with the two calibrated gradients over the field as well."""
SHARE = 24
"""Images of 96 x 96 pixels that are rendered at once: bounds the memory."""
ROUNDS, NEAR = 3, 1e-3
"""Refinement steps at most; and how near a point to a limit, relative to the size, makes another one needless."""

Sample = Callable[[np.ndarray], Mapping[str, np.ndarray]]
"""Sizes (N,) -> name -> values (N,), not negative; 1 is the limit."""


class Bench:
    """Spot positions, readings and truth of one instrument's monitor, without noise.

    Args:
        experiment: the instrument.
        like: a bench on the same cameras: its geometry is taken over.
        shapes: whether its spot shapes are taken over as well; needed for larger CCDs, of which only a window around
            each spot is read out, as large as the CCDs of ``like``.
    """

    def __init__(self, experiment: MonitorExperiment, like: Bench | None = None, shapes: bool = False) -> None:
        self.experiment = experiment
        self._measure = like.experiment if like is not None and shapes else experiment
        self.cameras = tuple(experiment.instrument.cameras)
        self._geometry: dict[str, MonitorGeometry] = {}
        if like is not None:
            self._geometry = {name: like.geometry(name) for name in self.cameras}
        self.frames = experiment.instrument.spec.autocollimator.frames

    def geometry(self, camera: str) -> MonitorGeometry:
        """What the formulas are given of a camera."""
        if camera not in self._geometry:
            self._geometry[camera] = self.experiment.geometry(camera)
        return self._geometry[camera]

    def positions(self, states: Sequence[State]) -> np.ndarray:
        """Centres of the spots in rendered images, (S, C, 2) (row, column), px.

        Raises:
            SpotError, BeamMissedError: a spot is too near its CCD's edge or outside it, or its beam is lost.
        """
        path = self.experiment.path
        rows, columns = path.shape
        chunk = max(1, SHARE * 96 * 96 // (rows * columns))
        out = np.empty((len(states), len(path.channels), 2))
        calibration = self._measure.calibration
        for piece, photons in path.iterate_photons(states, chunk=chunk):
            mean = self.experiment.expected_frames(photons).reshape(-1, rows, columns)
            windows, corner = _windows(mean, self._measure.path.shape)
            found = measure_spots(windows, self.frames, calibration, "ml", cores())
            place = np.stack([found.row, found.column], axis=-1) + corner
            out[piece] = place.reshape(-1, len(path.channels), 2)
        return out

    def traced(self, states: Sequence[State]) -> np.ndarray:
        """Means of the traced spots over the return face, (S, C, 2) (row, column) px from the CCD's middle, wherever
        they fall.

        Raises:
            BeamMissedError, AimError: a beam is lost, or a part of it.
        """
        path = self.experiment.path
        known, scout = path.coarse_trace(states), path.scout
        basis = zernike.basis(known.turn.shape[-1], scout.nodes.x, scout.nodes.y)
        start = np.repeat(scout.nominal.parameters, len(states), axis=0)
        launch = known.fan.at(start + np.moveaxis(known.turn @ basis.T, 0, -1))
        rays = trace(self.experiment.backend, known.back, make_rays(self.experiment.backend, *launch)).numpy()
        if not rays[3].all():
            raise BeamMissedError("a clear aperture cuts a monitor beam")
        return np.moveaxis(known.place, 0, 1)

    def readings(self, start: np.ndarray, end: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """Camera -> form -> (S, 4) in the units of ``monitoring.PARAMETERS``, from positions (S, C, 2)."""
        start = np.broadcast_to(start, end.shape)
        nothing = np.zeros((4, 4))
        out = {}
        for k, name in enumerate(self.cameras):
            pair = slice(2 * k, 2 * k + 2)
            before, after, geometry = start[:, pair], end[:, pair], self.geometry(name)
            found = {
                PRINTED: monitoring.paper_single(before, after, nothing, geometry),
                JOINT: monitoring.paper_joint(before, after, nothing, geometry),
                CORRECTED: monitoring.derived(before, after, nothing, bare(geometry)),
                CALIBRATED: monitoring.derived(before, after, nothing, geometry),
            }
            out[name] = {form: parameters.vector * PER_SI for form, parameters in found.items()}
        return out

    def truth(self, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Camera -> (S, 4) traced changes in the units of ``monitoring.PARAMETERS``."""
        found = self.experiment.sight.truth(states)
        return {
            name: np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f], axis=-1) * PER_SI
            for name, c in found.cameras.items()
        }


def bare(geometry: MonitorGeometry) -> MonitorGeometry:
    """Without the calibrated gradients over the field."""
    return replace(geometry, d_f_per_alpha_m=0.0, d_gamma_per_beta=0.0)


def _windows(images: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Windows of that shape around the brightest pixel of each image (B, H, W), and (B, 2) how far their first pixels
    are from those of a window in the middle.
    """
    if images.shape[1:] == shape:
        return images, np.zeros((len(images), 2))
    brightest = np.stack(np.unravel_index(images.reshape(len(images), -1).argmax(axis=1), images.shape[1:]), axis=-1)
    spare = np.array(images.shape[1:]) - shape
    corner = np.clip(brightest - np.array(shape) // 2, 0, spare)
    out = np.stack([image[r : r + shape[0], c : c + shape[1]] for image, (r, c) in zip(images, corner, strict=True)])
    return out, corner - spare / 2


@dataclass(frozen=True, eq=False)
class Curves:
    """Quantities over the size of a change.

    Attributes:
        size: (N,), ascending, > 0.
        value: name -> (N,), as shares of what is allowed.
    """

    size: np.ndarray
    value: Mapping[str, np.ndarray]

    def bracket(self, name: str) -> int | None:
        """Index of the first size at which the limit is passed, None where it is not."""
        beyond = np.flatnonzero(self.value[name] > 1.0)
        return int(beyond[0]) if len(beyond) else None

    def crossing(self, name: str) -> float | None:
        """Size at which the limit is first passed, interpolated on logarithmic axes; None where it is not.

        0 where it is passed at the smallest size already.
        """
        k = self.bracket(name)
        if k is None:
            return None
        if k == 0:
            return 0.0
        (low, high), (a, b) = np.log(self.size[k - 1 : k + 1]), self.value[name][k - 1 : k + 1]
        start, end = math.log(max(a, 1e-9)), math.log(b)
        return math.exp(low - start * (high - low) / (end - start))

    def merged(self, size: np.ndarray, value: Mapping[str, np.ndarray]) -> Curves:
        """With more points."""
        every = np.concatenate([self.size, size])
        order = np.argsort(every)
        return Curves(every[order], {n: np.concatenate([v, value[n]])[order] for n, v in self.value.items()})


@dataclass(frozen=True, eq=False)
class Domain:
    """How far something holds: followed in images as far as they go, traced on from there, until the beam is lost.

    Attributes:
        images, traced: curves over the size; both have the same names.
        lost: size beyond which the beam is lost or not followed.
        lost_why: which of the two.
    """

    images: Curves
    traced: Curves
    lost: float
    lost_why: str

    def limit(self, name: str) -> tuple[float, str]:
        """Largest size within a limit, and whence it is known: "images", "trace" or why there is none."""
        for curves, whence in ((self.images, "images"), (self.traced, "trace")):
            found = curves.crossing(name)
            if found is not None:
                return found, whence
        return self.lost, self.lost_why


def sampled(sample: Sample, sizes: Sequence[float], names: Sequence[str] | None = None) -> Curves:
    """Curves at given sizes, with points added where they pass the limit.

    Args:
        sample: what is sampled.
        sizes: to begin with, ascending.
        names: whose limits are refined; all by default.
    """
    first = np.array(sizes, dtype=float)
    curves = Curves(first, sample(first))
    wanted = tuple(curves.value) if names is None else names
    for _ in range(ROUNDS):
        new: list[float] = []
        for x in sorted(x for x in (curves.crossing(name) for name in wanted) if x):
            if np.min(np.abs(curves.size / x - 1.0)) > NEAR and (not new or x > (1.0 + NEAR) * new[-1]):
                new.append(x)
        if not new:
            break
        curves = curves.merged(np.array(new), sample(np.array(new)))
    return curves
