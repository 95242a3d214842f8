"""A monitor's error budget by its mechanisms: random states of each cause, rendered, measured, and turned into angles.

A line of the budget is the error of one spot's position by one cause, as an angle: displacement / principal distance.
Every line is 3 sigma: three times the rms over random states, all spots and both axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.monitor.estimators import ESTIMATORS
from analysis.monitor.monitoring import coefficients
from analysis.monitor.recovery import Recovery, measure_spots, recover
from analysis.units import ARCSEC
from optics.geometry.tree import Motion, State, compose
from optics.numerics.backend import Backend
from optics.numerics.threads import cores, one_blas_thread
from optics.thermal.heat import Temperature
from scenes.specs.channel import BASE, CENTRAL_PRISM
from scenes.specs.instrument import ErrorBudgetSpec
from scenes.specs.resolved import ResolvedJob
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import trace_truth

LINES = (
    "centroid",
    "coordinate_thermal",
    "prism_180_thermal",
    "prism_0_thermal",
    "prism_180_rotation",
    "prism_0_rotation",
    "central_prism_thermal",
)
"""The causes: noise of the centroid, then what moves or warms; in the order of paper 001, Table 3."""

ALLOWED = 0.1 * ARCSEC
"""Error of one line that the inverse view asks for, 3 sigma, radians."""
_SEARCH_STEPS = 4

PARAMETER_FIELDS = ("d_alpha_rad", "d_beta_rad", "d_gamma_rad", "d_f_m")

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class BudgetLine:
    """One line as simulated.

    Attributes:
        name: one of LINES.
        three_sigma: three times the rms of a spot's angle error per axis, radians.
        sigma: standard deviation of ``three_sigma``, radians.
        by_axis: the same for the spots' rows (along Y) and columns (along X), radians.
        value, unit: the input, 3 sigma.
        allowed: input at which the line would be 0.1 arcsec, in the unit of ``value``.
    """

    name: str
    three_sigma: float
    sigma: float
    by_axis: tuple[float, float]
    value: float
    unit: str
    allowed: float


@dataclass(frozen=True, eq=False)
class Together:
    """All causes at once, T trials.

    Attributes:
        spot: three sigma of a spot's angle error per axis and its standard deviation, radians.
        parameters: estimator -> parameter -> (three sigma, its standard deviation) of reading - truth, radians and
            metres, over trials and both cameras. Where the focal plane's temperature changes the camera itself, which
            it does as its line CCD grows, the reading of that is no error.
    """

    spot: tuple[float, float]
    parameters: Mapping[str, Mapping[str, tuple[float, float]]]


class ErrorBudget:
    """Simulates an error budget.

    Args:
        spec: its inputs.
        resolved: a job on its instrument without perturbation; the budget's light and angle errors are applied here.
        backend: where to trace.
        seed: of all random numbers.
    """

    def __init__(self, spec: ErrorBudgetSpec, resolved: ResolvedJob, backend: Backend, seed: int) -> None:
        self.spec = spec
        self.resolved = resolved.model_copy(update={"instrument": spec.applied_to(resolved.instrument)})
        self.experiment = MonitorExperiment(self.resolved, backend)
        self.seed = seed

    @cached_property
    def radians_per_pixel(self) -> float:
        """Pixel over principal distance: the unit of a spot's angle error."""
        distances = list(self.experiment.nominal_truth.principal_distance.values())
        return self.experiment.path.pitch / float(np.mean(distances))

    def line(self, name: str, progress: Progress = lambda fraction, text: None) -> BudgetLine:
        """Simulate one line.

        Raises:
            ValueError: no such line.
        """
        if name == "centroid":
            return self._centroid_line()
        progress(0.0, f"{name}: states")
        states = self.states((name,), self.spec.trials, LINES.index(name))
        progress(0.3, f"{name}: render and measure")
        value, unit = self.input_of(name)
        return self._line(name, _shifts(self.experiment, states), value, unit)

    def input_of(self, name: str) -> tuple[float, str]:
        """A line's input, 3 sigma, and its unit."""
        steady = self.spec.steadiness
        return {
            "coordinate_thermal": (steady.focal_plane_temperature, "K"),
            "prism_180_thermal": (1e3 * steady.prism_180_gradient, "mK/m"),
            "prism_0_thermal": (1e3 * steady.prism_0_gradient, "mK/m"),
            "prism_180_rotation": (steady.prism_180_rotation / ARCSEC, "arcsec"),
            "prism_0_rotation": (steady.prism_0_rotation / ARCSEC, "arcsec"),
            "central_prism_thermal": (1e3 * steady.central_prism_gradient, "mK/m"),
        }[name]

    def states(self, lines: Sequence[str], trials: int, stream: int) -> list[State]:
        """Random states in which these causes act, each body and axis by itself.

        Args:
            lines: which of LINES, without the centroid's.
            trials: how many.
            stream: number of the random stream.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(7, stream)))
        bodies = {b.path: b for b in self.experiment.instrument.assembly.tree.bodies}
        out = []
        for _ in range(trials):
            heat: dict[str, Temperature] = {}
            turns: dict[str, Motion] = {}
            for name in LINES[1:]:
                if name in lines:
                    self._draw(name, rng, heat, turns)
            thermal = self.experiment.thermal.state(heat) if heat else {}
            out.append(compose(thermal, turns, bodies))
        return out

    def _draw(
        self, name: str, rng: np.random.Generator, heat: dict[str, Temperature], turns: dict[str, Motion]
    ) -> None:
        """Draw one cause for all bodies that it acts on."""
        steady, instrument = self.spec.steadiness, self.experiment.instrument

        def triple(three_sigma: float) -> tuple[float, float, float]:
            x, y, z = three_sigma / 3.0 * rng.standard_normal(3)
            return (float(x), float(y), float(z))

        if name == "coordinate_thermal":
            for camera in instrument.cameras:
                change = steady.focal_plane_temperature / 3.0 * float(rng.standard_normal())
                heat[f"{BASE}/{camera}/focal_plane"] = Temperature(change)
        elif name == "central_prism_thermal":
            heat[CENTRAL_PRISM] = Temperature(0.0, triple(steady.central_prism_gradient))
        else:
            prism, _, kind = name.rpartition("_")
            for channel in instrument.channels:
                body = channel.prism_body(prism)
                if kind == "thermal":
                    heat[body] = Temperature(0.0, triple(getattr(steady, f"{prism}_gradient")))
                else:
                    turns[body] = Motion(rotate=triple(getattr(steady, f"{prism}_rotation")), pivot="centre")

    def grown_focal_planes(self) -> tuple[float, float]:
        """True change of d_f when every focal plane is warmer by the input, 3 sigma, and what paper 001, eq. (7)
        reads, metres.
        """
        experiment, change = self.experiment, Temperature(self.spec.steadiness.focal_plane_temperature)
        names = list(experiment.instrument.cameras)
        state = experiment.thermal.state({f"{BASE}/{camera}/focal_plane": change for camera in names})
        true = trace_truth(experiment.instrument, experiment.backend, [state]).cameras[names[0]].d_f[0]
        shift = _shifts(experiment, [state])[0, :2].ravel()
        geometry = experiment.calibration.cameras[names[0]].geometry
        return float(true), float(coefficients("paper_single", geometry)[3] @ shift)

    def halved_glass(self) -> tuple[float, float, float]:
        """What halving the 180-deg prisms' glass does to the line of their temperature gradient.

        The rhomboids take over half of the transfer. The same gradients across the prism, once along its y and once
        along its z, act on both instruments.

        Returns:
            Glass path before and after, metres (mean over the channels), and the ratio of the rms spot displacements.
        """
        whole = self.experiment
        monitor = whole.instrument.spec.monitor
        transfer = [float(np.hypot(*s[:2])) for s in self._transfers()]
        shift = monitor.prism_0.shift + 0.5 * float(np.mean(transfer))
        longer = monitor.model_copy(update={"prism_0": monitor.prism_0.model_copy(update={"shift": shift})})
        instrument = whole.instrument.spec.model_copy(update={"monitor": longer})
        resolved = self.resolved.model_copy(update={"instrument": instrument})
        half = MonitorExperiment(resolved, whole.backend)
        slope = self.spec.steadiness.prism_180_gradient
        rms, glass = [], []
        for experiment in (whole, half):
            states = [
                experiment.thermal.state(
                    {c.prism_body("prism_180"): Temperature(0.0, g) for c in experiment.instrument.channels}
                )
                for g in ((0.0, slope, 0.0), (0.0, 0.0, slope))
            ]
            rms.append(float(np.sqrt(np.mean(_shifts(experiment, states) ** 2))))
            glass.append(float(np.mean([p["prism_180"] for p in experiment.instrument.glass_path.values()])))
        return glass[0], glass[1], rms[1] / rms[0]

    def _transfers(self) -> list[np.ndarray]:
        """From the middle of the entering to that of the leaving footprint of every 180-deg prism, in its frame."""
        tree = self.experiment.instrument.assembly.tree
        out = []
        for channel in self.experiment.instrument.channels:
            window = f"{channel.prism_body('prism_180')}/window"
            out.append(tree[f"{window}/exit"].pose.translation - tree[f"{window}/entry"].pose.translation)
        return out

    def _centroid_line(self) -> BudgetLine:
        """Scatter of the energy centroid in single frames, and the light at which it is 0.1 arcsec.

        Between shot noise and read noise the scatter follows no power of the light: the allowed light is searched for.
        """
        scatter = self._centroid_scatter(1.0)
        target = np.log(ALLOWED / (3.0 * self.radians_per_pixel))
        share, size = [0.0, -np.log(2.0)], [np.log(np.std(scatter))]
        for _ in range(_SEARCH_STEPS):  # secants in the logarithms
            size.append(np.log(np.std(self._centroid_scatter(float(np.exp(share[-1]))))))
            slope = (size[-1] - size[-2]) / (share[-1] - share[-2])
            share.append(share[-1] + (target - size[-1]) / slope)
        light = self.spec.photons_per_frame
        return self._line("centroid", scatter, light, "photons per frame", light * float(np.exp(share[-1])))

    def _centroid_scatter(self, light: float) -> np.ndarray:
        """Energy centroids of single frames about their mean, px, (frames, C, 2), at a share of the light."""
        count = max(self.spec.trials, 2)
        setup, stream = self.experiment, np.random.SeedSequence(self.seed, spawn_key=(8,))
        pattern = setup.pattern(self.seed)
        frames = setup.detector.expose(light * setup.nominal_photons, pattern, count, setup.exposure, stream)
        spots = len(frames)
        # frame by frame, all spots of one after the other, as the estimators take them
        flat = np.swapaxes(frames, 0, 1).reshape(-1, *frames.shape[2:]).astype(np.float64)
        with one_blas_thread():
            position = measure_spots(flat, 1, setup.calibration, "energy", cores()).position.reshape(count, spots, 2)
        return np.asarray((position - position.mean(axis=0)) * np.sqrt(count / (count - 1.0)))

    def _line(self, name: str, shifts: np.ndarray, value: float, unit: str, allowed: float | None = None) -> BudgetLine:
        """Statistics of spot displacements (S, C, 2), px; a line without ``allowed`` is proportional to its input."""
        angle = self.radians_per_pixel * shifts
        three_sigma, sigma = _three_sigma(angle)
        axes = 3.0 * np.sqrt(np.mean(angle**2, axis=(0, 1)))
        allowed = value * ALLOWED / three_sigma if allowed is None else allowed
        return BudgetLine(name, three_sigma, sigma, (float(axes[0]), float(axes[1])), value, unit, float(allowed))

    def together(self, progress: Progress = lambda fraction, text: None) -> Together:
        """All causes at once, through noisy images and every estimator, each measurement the mean of ``frames``."""
        progress(0.0, "all causes: states")
        states = self.states(LINES[1:], self.spec.all_together, len(LINES))
        calibration = self.experiment.calibration
        before = self.experiment.frames_before(self.spec.frames, self.seed)
        truth = trace_truth(self.experiment.instrument, self.experiment.backend, states).cameras
        pieces: list[Recovery] = []
        for piece, photons in self.experiment.path.iterate_photons(states, chunk=25):
            progress(0.1 + 0.9 * piece.start / len(states), "all causes: render and measure")
            after = self.experiment.frames_after(photons, self.spec.frames, self.seed, piece.start)
            with one_blas_thread():
                pieces.append(recover(before, after, calibration, "energy", cores()))
        angle = self.radians_per_pixel * np.concatenate([p.after - p.before for p in pieces])
        parameters: dict[str, dict[str, tuple[float, float]]] = {}
        for estimator in ESTIMATORS:
            parameters[estimator] = {}
            for name in PARAMETER_FIELDS:
                values = [
                    np.concatenate([np.asarray(getattr(p.parameters[c][estimator], name)) for p in pieces])
                    - getattr(truth[c], name.rpartition("_")[0])
                    for c in self.experiment.instrument.cameras
                ]
                parameters[estimator][name] = _three_sigma(np.stack(values, axis=-1))
        return Together(_three_sigma(angle), parameters)


def _shifts(experiment: MonitorExperiment, states: Sequence[State]) -> np.ndarray:
    """Measured displacement of every spot in noise-free images, px, (S, C, 2): row, column."""
    before = experiment.expected_frames(experiment.nominal_photons)
    calibration = experiment.calibration
    start = measure_spots(before, 1, calibration).position
    out = np.empty((len(states), len(before), 2))
    for piece, photons in experiment.path.iterate_photons(states):
        frames = experiment.expected_frames(photons)
        with one_blas_thread():
            spots = measure_spots(frames.reshape(-1, *frames.shape[-2:]), 1, calibration, "ml", cores())
        out[piece] = spots.position.reshape(-1, len(before), 2) - start
    return out


def _three_sigma(values: np.ndarray) -> tuple[float, float]:
    """Three times the rms of values (S, ...) about zero, and its standard deviation from the scatter between states."""
    square = np.mean(values.reshape(len(values), -1) ** 2, axis=1)
    mean = float(np.mean(square))
    spread = float(np.std(square, ddof=1)) / np.sqrt(len(square))
    root = np.sqrt(mean)
    return 3.0 * float(root), 3.0 * 0.5 * spread / float(root)
