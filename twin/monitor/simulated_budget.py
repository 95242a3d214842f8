"""Error budget of a monitor by simulation: random states due to each cause, rendered, measured, converted to angles.

The first line of the budget is the noise of the centroid; each other line is one cause of a disturbances file. A line
is the error of one spot's position as an angle, displacement / principal distance, at 3 sigma: three times the rms over
random states, all spots and both axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.monitor_formulas import coefficients
from analysis.monitor.recovery import Recovery, measure_spots
from optics.geometry.tree import State
from optics.numerics.backend import Backend, cores, one_blas_thread
from optics.thermal.heat import Temperature
from scenes.models.disturbances import states_of
from scenes.specs.disturbances import ErrorBudgetSpec
from scenes.specs.instrument import BASE
from scenes.specs.resolved import ResolvedJob
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe, shared_detector
from twin.monitor.truth import Truth

_CENTROID = "centroid"
"""Name of the budget line for the noise of the image alone."""

ALLOWED = 0.1 * ARCSEC
"""Angle error at three standard deviations, in radians, for which each line's allowed input is computed."""
_SEARCH_STEPS = 4

_PARAMETER_FIELDS = ("d_alpha_rad", "d_beta_rad", "d_gamma_rad", "d_f_m")

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class BudgetLine:
    """One line of the error budget: the effect of one cause on the position of a spot, as an angle.

    Attributes
    ----------
    name : str
        ``centroid`` for the noise of the image, or the name of a cause in the disturbances file.
    three_sigma : float
        Three times the rms of a spot's angle error per axis, in radians.
    sigma : float
        Standard deviation of ``three_sigma``, in radians.
    by_axis : tuple of float
        Three times the rms for the spots' rows (along Y) and columns (along X), in radians.
    value : float
        Three standard deviations of the cause (input of the line); 1 if the components of a cause have different
        sigmas.
    unit : str
        Unit of the input; "times the prior" if the components of a cause have different sigmas.
    allowed : float
        Input that causes an error of 0.1 arcsec (3 sigma), in the unit of ``value``.
    """

    name: str
    three_sigma: float
    sigma: float
    by_axis: tuple[float, float]
    value: float
    unit: str
    allowed: float


@dataclass(frozen=True, eq=False)
class CombinedErrors:
    """Errors due to all causes together, from T random trials.

    Attributes
    ----------
    spot : tuple of float
        Three sigma of a spot's angle error per axis, and its standard deviation, in radians.
    parameters : mapping
        Estimator -> parameter -> (three sigma, its standard deviation) of estimate - truth, in radians and metres, over
        trials and both cameras. The change of the camera itself when the focal plane's temperature expands its line CCD
        does not count as an error of the estimate.
    """

    spot: tuple[float, float]
    parameters: Mapping[str, Mapping[str, tuple[float, float]]]


class ErrorBudget:
    """Simulation of a monitor's error budget.

    Parameters
    ----------
    spec
        Inputs of the budget.
    resolved
        Job on the instrument without perturbation, with its disturbances (``resolve_budget``); the budget's light and
        angle errors are applied here.
    backend
        Backend of the ray trace.
    seed
        Seed of all random numbers.

    Raises
    ------
    InputError
        The disturbances do not belong to this instrument, or one of their causes has the name of a fixed line.
    """

    def __init__(self, spec: ErrorBudgetSpec, resolved: ResolvedJob, backend: Backend, seed: int) -> None:
        self.spec = spec
        self.resolved = resolved.model_copy(update={"instrument": spec.applied_to(resolved.instrument)})
        self.experiment = MonitorExperiment(self.resolved, backend)
        prior = self.experiment.prior
        assert prior is not None  # resolve_budget refuses a budget without them
        assert self.resolved.disturbances is not None
        self.prior = prior
        if _CENTROID in self.causes:
            text = f"{_CENTROID} is the line of the centroid's own noise"
            raise self.resolved.disturbances.error(text, ("causes", _CENTROID), allowed="another name for the cause")
        self.seed = seed

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the causes in the order of the disturbances file, without those whose sigma is zero."""
        return tuple(dict.fromkeys(c.cause for c in self.prior.components))

    @property
    def lines(self) -> tuple[str, ...]:
        """Names of all lines of the budget: the centroid's noise, then the causes."""
        return (_CENTROID, *self.causes)

    @cached_property
    def radians_per_pixel(self) -> float:
        """Angle error of a spot per pixel of its displacement: pixel pitch divided by principal distance."""
        distances = list(self.experiment.nominal_truth.principal_distance.values())
        return self.experiment.path.pitch / float(np.mean(distances))

    def line(self, name: str, progress: Progress = lambda fraction, text: None) -> BudgetLine:
        """Simulate one line of the budget: the noise of the centroid, or one cause.

        Raises
        ------
        ValueError
            There is no such line.
        """
        if name == _CENTROID:
            return self._centroid_line()
        value, unit = self.input_of(name)
        progress(0.0, f"{name}: states")
        states = self.states((name,), self.spec.trials, self.lines.index(name))
        progress(0.3, f"{name}: render and measure")
        return self._line(name, _shifts(self.experiment, states), value, unit)

    def input_of(self, cause: str) -> tuple[float, str]:
        """Return three standard deviations of a cause and their unit; raise ValueError if there is no such cause."""
        components = self.prior.of_causes((cause,)).components
        if not components:
            raise ValueError(f"error budget: no cause {cause!r}; there are {', '.join(self.causes)}")
        first = components[0]
        if any((c.sigma, c.unit) != (first.sigma, first.unit) for c in components):
            return 1.0, "times the prior"
        return 3.0 * first.sigma / first.unit_size, first.unit

    def states(self, causes: Sequence[str], trials: int, stream: int) -> list[State]:
        """Return random states in which the named causes act, each drawn independently from its prior.

        Parameters
        ----------
        causes : sequence of str
            Causes that act.
        trials : int
            Number of states.
        stream : int
            Number of the random stream.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(7, stream)))
        prior = self.prior.of_causes(causes)
        amounts = prior.draw(rng, trials)
        return states_of(amounts, prior.components, self.experiment.thermal)

    def warmed_focal_planes(self, warmer: float) -> tuple[float, float]:
        """Return the true change of principal distance due to warmer focal planes, and its estimate, in metres.

        The estimate is by eq. (7) of paper 001 (Wang et al. 2018).

        Parameters
        ----------
        warmer : float
            Temperature change, in kelvin.
        """
        experiment, change = self.experiment, Temperature(warmer)
        names = list(experiment.instrument.cameras)
        state = experiment.thermal.state({f"{BASE}/{camera}/focal_plane": change for camera in names})
        true = experiment.sight.truth([state]).cameras[names[0]].d_f[0]
        shift = _shifts(experiment, [state])[0, :2].ravel()
        geometry = experiment.calibration.cameras[names[0]].geometry
        return float(true), float(coefficients("paper_single", geometry)[3] @ shift)

    def halved_glass(self, slope: float) -> tuple[float, float, float]:
        """Compare the spots' response to a temperature gradient before and after halving the 180-deg prisms' glass.

        In the second instrument, longer rhomboid prisms take over half of the sideways shift of the light by the
        180-deg prisms. The same gradients across the 180-deg prisms, once along their y and once along their z, act on
        both instruments.

        Parameters
        ----------
        slope : float
            Temperature gradient, in K/m.

        Returns
        -------
        tuple of float
            Glass path before and after, in metres (mean over the channels), and the ratio of the rms spot
            displacements.
        """
        whole = self.experiment
        monitor = whole.instrument.spec.autocollimator
        transfer = [float(np.hypot(*s[:2])) for s in self._transfers()]
        shift = monitor.prism_0.shift + 0.5 * float(np.mean(transfer))
        longer = monitor.model_copy(update={"prism_0": monitor.prism_0.model_copy(update={"shift": shift})})
        instrument = whole.instrument.spec.model_copy(update={"monitor": longer})
        resolved = self.resolved.model_copy(update={"instrument": instrument})
        # the longer rhomboids block other beams; only the glass is compared here, not a layout
        half = MonitorExperiment(resolved, whole.backend, free_beams=False)
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
        """Return for every 180-deg prism the vector from where light enters to where it leaves, in its own frame."""
        tree = self.experiment.instrument.assembly.tree
        out = []
        for channel in self.experiment.instrument.channels:
            window = f"{channel.prism_body('prism_180')}/window"
            out.append(tree[f"{window}/exit"].pose.translation - tree[f"{window}/entry"].pose.translation)
        return out

    def _centroid_line(self) -> BudgetLine:
        """Return the budget line for the noise of the energy centroid in single frames.

        The allowed input is the light at which that noise is 0.1 arcsec.

        Between shot noise and read noise the scatter is no power law of the light, so the allowed light is found by a
        numerical search.
        """
        scatter = self._centroid_scatter(1.0)
        target = np.log(ALLOWED / (3.0 * self.radians_per_pixel))
        share, size = [0.0, -np.log(2.0)], [np.log(np.std(scatter))]
        for _ in range(_SEARCH_STEPS):  # secants in the logarithms
            size.append(np.log(np.std(self._centroid_scatter(float(np.exp(share[-1]))))))
            slope = (size[-1] - size[-2]) / (share[-1] - share[-2])
            share.append(share[-1] + (target - size[-1]) / slope)
        light = self.spec.photons_per_frame
        return self._line(_CENTROID, scatter, light, "photons per frame", light * float(np.exp(share[-1])))

    def _centroid_scatter(self, light: float) -> np.ndarray:
        """Return the energy centroids of single frames minus their mean, (frames, C, 2) px for C channels.

        ``light`` is the light as a fraction of the nominal light.
        """
        count = max(self.spec.trials, 2)
        setup, stream = self.experiment, np.random.SeedSequence(self.seed, spawn_key=(8,))
        pattern = setup.pattern(self.seed)
        frames = setup.detector.expose(light * setup.nominal_photons, pattern, count, setup.exposure, stream)
        spots = len(frames)
        # frame by frame, with all spots of a frame in sequence, as the estimators need them
        flat = np.swapaxes(frames, 0, 1).reshape(-1, *frames.shape[2:]).astype(np.float64)
        with one_blas_thread():
            position = measure_spots(flat, 1, setup.calibration, "energy", cores()).position.reshape(count, spots, 2)
        return np.asarray((position - position.mean(axis=0)) * np.sqrt(count / (count - 1.0)))

    def _line(self, name: str, shifts: np.ndarray, value: float, unit: str, allowed: float | None = None) -> BudgetLine:
        """Return a line of the budget from spot displacements (S, C, 2) for S states and C channels, px.

        Without ``allowed`` the allowed input follows from an error proportional to the input.
        """
        angle = self.radians_per_pixel * shifts
        three_sigma, sigma = _three_sigma(angle)
        axes = 3.0 * np.sqrt(np.mean(angle**2, axis=(0, 1)))
        allowed = value * ALLOWED / three_sigma if allowed is None else allowed
        return BudgetLine(name, three_sigma, sigma, (float(axes[0]), float(axes[1])), value, unit, float(allowed))

    def together(self, progress: Progress = lambda fraction, text: None) -> CombinedErrors:
        """Simulate all causes together, with noisy images that every estimator evaluates.

        Each image is the mean of as many frames as the key ``frames`` of the budget specifies.
        """
        progress(0.0, "all causes: states")
        states = self.states(self.causes, self.spec.all_together, len(self.lines))
        record = shared_detector(self.experiment, self.spec.frames, self.seed)
        pieces: list[tuple[Truth, Recovery]] = []
        for observation in observe(self.experiment, states, ObservationOptions(record, "energy", 25, use_prior=False)):
            pieces.append((observation.truth, observation.recovery))
            progress(0.1 + 0.9 * (observation.numbers[-1] + 1) / len(states), "all causes: render and measure")
        angle = self.radians_per_pixel * np.concatenate([p.after - p.before for _, p in pieces])
        parameters: dict[str, dict[str, tuple[float, float]]] = {}
        cameras = self.experiment.instrument.cameras
        for estimator in next(iter(pieces[0][1].parameters.values())):
            errors = [[p.parameters[c][estimator].vector - true.vector(c) for true, p in pieces] for c in cameras]
            differences = np.stack([np.concatenate(parts) for parts in errors], axis=-1)
            parameters[estimator] = {name: _three_sigma(differences[:, k]) for k, name in enumerate(_PARAMETER_FIELDS)}
        return CombinedErrors(_three_sigma(angle), parameters)


def _shifts(experiment: MonitorExperiment, states: Sequence[State]) -> np.ndarray:
    """Return the measured displacement of every spot in noise-free images, (S, C, 2), row and column in pixels.

    Dimensions: S states, C channels.
    """
    before = experiment.expected_frames(experiment.nominal_photons)

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return before, experiment.expected_frames(photons)

    observations = observe(experiment, states, ObservationOptions(record, chunk=32, use_prior=False, frames=1))
    return np.concatenate([observation.recovery.after - observation.recovery.before for observation in observations])


def _three_sigma(values: np.ndarray) -> tuple[float, float]:
    """Return three times the rms of values (S, ...) about zero, and the standard deviation of that number.

    The standard deviation follows from the scatter between the S states.
    """
    square = np.mean(values.reshape(len(values), -1) ** 2, axis=1)
    mean = float(np.mean(square))
    spread = float(np.std(square, ddof=1)) / np.sqrt(len(square))
    root = np.sqrt(mean)
    return 3.0 * float(root), 3.0 * 0.5 * spread / float(root)
