"""Camera of a tolerance budget: exact traces of many perturbed cameras at once, with their adjustments.

All wavefronts are those of the beams that the nominal camera images at the merits' fields, traced through the same
points of the stop. Vignetting and obstruction of a beam are those of the nominal camera at its design wavelength,
except in merits about obstruction.

The adjustments of a camera are the compensator moves that minimise the wavefront error, executed with finite steps and
errors.

Spectrum in which a budget evaluates wavefronts and MTFs, and matrices that all its random cameras share.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optics.geometry.tree import State
from optics.numerics.array_math import PhysicalError, UnphysicalError
from optics.numerics.backend import Backend, one_blas_thread
from optics.raytrace.assembly import Element
from optics.raytrace.first_order import line_change, line_tangents
from optics.waves.optical_transfer import VariedTransfer, polychromatic_transfer
from optics.waves.pupil_terms import products
from scenes.models.camera_model import lenses
from scenes.models.instrument_model import Instrument
from scenes.specs.asbuilt import AsBuiltSpec
from scenes.specs.camera import CameraSpec
from scenes.specs.spectrum import SpectrumSpec
from scenes.specs.tolerance import OF_MONITOR, SPECTRUM, ToleranceBudgetSpec, ToleranceSetup
from scenes.yaml.errors import names_text, unknown
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import AT_ONCE, BeamLight, RoughWavefrontError, VariedBeams, VignettedBeamError
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import LINE_POINTS, line_points
from twin.targets.target_images import wavelengths_enough
from twin.tolerance.monitor_merit import Merit, MonitorMerit, merits_of, obstructed_shares, require_bodies
from twin.tolerance.variations import ParameterMaker, VariedParameter, states_of

TRANSFER = 1e-3
"""Largest allowed error of the nominal pupil's MTF when it is computed at fixed points of the pupil."""


def budget_spectrum(test: ToleranceBudgetSpec, camera: CameraSpec) -> SpectrumSpec | None:
    """Return the spectrum in which a budget evaluates a camera; None for its design wavelength.

    Raises
    ------
    InputError
        The budget requests a spectrum that the camera does not have.
    """
    if test.light == "spectrum" and camera.light is None:
        raise test.error(
            "the camera has no spectrum", ("light",), allowed="light: design, or a `spectrum` of the camera"
        )
    if test.light == "design" or (test.light is None and not lenses(camera)):
        return None
    return camera.light


@dataclass(frozen=True, eq=False)
class WavefrontNorm:
    """Matrices that map wavefront coefficients to residuals whose squares sum to the mean square wavefront.

    The mean square is over the illuminated pupil. Array dimensions: T polynomial coefficients, F fields.

    Attributes
    ----------
    rest : (F, T, T) ndarray
        Matrices for the wavefront without piston and tilt: the squares of their product with the coefficients sum to
        its mean square.
    tilt : (F, 2, T) ndarray
        Matrices that give the two components of the tilt in the same way.
    """

    rest: np.ndarray
    tilt: np.ndarray

    @classmethod
    def of(cls, fields: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], degree: int) -> WavefrontNorm:
        """Compute the matrices for the illuminated pupils of F fields.

        Parameters
        ----------
        fields : sequence of tuple
            For each field the nodes x, y and the weights of a quadrature over the illuminated pupil.
        degree : int
            Degree of the polynomials over the stop.
        """
        rest, tilt = [], []
        for x, y, share in fields:
            table = products(x, y, degree)
            level = np.stack([np.ones_like(x), x, y], axis=-1)
            weighted = level * share[:, None]
            normal = level.T @ weighted
            # the plane through a wavefront, in functions that are orthonormal over the light; the first is piston
            tilt.append(np.linalg.solve(np.linalg.cholesky(normal), weighted.T @ table)[1:])
            table = table - level @ np.linalg.solve(normal, weighted.T @ table)
            value, vector = np.linalg.eigh(table.T @ (table * share[:, None]))
            rest.append(np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T)
        return cls(np.stack(rest), np.stack(tilt))

    def residuals(self, terms: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Return residuals whose squares sum to the mean square wavefront over all fields and the spectrum.

        The mean tilt of all wavelengths is removed; a tilt that differs between wavelengths blurs the image and stays.

        Array dimensions: S cameras, F fields, K wavelengths, T polynomial coefficients, R residuals.

        Parameters
        ----------
        terms : (S, F, K, T) ndarray
            Polynomial coefficients of the wavefronts about a common image point.
        shares : (K,) ndarray
            Weights of the wavelengths in the spectrum; they sum to 1.

        Returns
        -------
        (S, R) ndarray
            Residuals in the unit of the coefficients.
        """
        out = terms @ np.swapaxes(self.rest, 1, 2)
        if len(shares) > 1:
            tilt = terms @ np.swapaxes(self.tilt, 1, 2)
            tilt = tilt - np.einsum("k,sfkj->sfj", shares, tilt)[:, :, None]
            out = np.concatenate([out, tilt], axis=-1) * np.sqrt(shares)[:, None]
        return np.asarray(out.reshape(len(terms), -1))


def fixed_transfers(
    optics: CameraOptics,
    test: ToleranceBudgetSpec,
    merits: Sequence[Merit],
    fields: np.ndarray,
    light: tuple[np.ndarray, np.ndarray],
    cosines: np.ndarray,
    degree: int,
) -> dict[int, list[list[VariedTransfer]]]:
    """Return the operators that give the MTF of every merit of kind ``mtf`` from the wavefront.

    Array dimensions: F fields, C wavelengths, N rays.

    Parameters
    ----------
    optics : CameraOptics
        Nominal camera.
    test : ToleranceBudgetSpec
        Budget, for messages.
    merits : sequence of Merit
        Merits of the budget.
    fields : (F, 2) ndarray
        Field points of the budget.
    light : tuple of ndarray
        Wavelengths, metres, and their weights in the spectrum, (C,) each.
    cosines : (C or 1, F, N, 2) ndarray
        Direction cosines of the traced rays.
    degree : int
        Degree of the polynomials over the stop.

    Returns
    -------
    dict
        Index of the merit -> operators by field and direction.

    Raises
    ------
    InputError
        The nominal camera has no MTF, or none at the requested frequency.
    """
    asked = [(k, merit) for k, merit in enumerate(merits) if merit.spec.kind == "mtf"]
    if not asked:
        return {}
    try:
        pupils = optics.colour_pupils(fields, light[0])
    except UnphysicalError as error:
        raise test.error(f"the designed camera has no MTF: {error}", ("merits", asked[0][1].name)) from error
    out = {}
    for k, merit in asked:
        spec = merit.spec
        size = optics.nyquist if spec.frequency is None else 1e3 * spec.frequency
        axes = {"line": (0,), "track": (1,), "worse": (0, 1)}[spec.direction]
        rows = []
        for f in merit.fields:
            row = []
            for axis in axes:
                frequency = size * np.eye(2)[axis]
                fixed = VariedTransfer.of(pupils[f], frequency, *light, cosines[:, f], degree)
                if fixed is None:
                    problem = f"{1e-3 * size:.4g} cycles per mm lie beyond the cut-off at a field"
                    raise test.error(problem, ("merits", merit.name, "frequency"), allowed="a lower frequency")
                pupil = pupils[f] if len(pupils[f]) > 1 else pupils[f][0]
                problem, allowed = (
                    "the MTF of the designed camera has not converged",
                    "a sharper camera, or another merit",
                )
                try:
                    whole = abs(polychromatic_transfer(pupil, frequency[None], *light, np.zeros(1))[0, 0])
                except UnphysicalError as error:
                    raise test.error(f"{problem}: {error}", ("merits", merit.name), allowed=allowed) from error
                if abs(fixed.known - whole) > TRANSFER:
                    raise test.error(problem, ("merits", merit.name), allowed=allowed)
                row.append(fixed)
            rows.append(row)
        out[k] = rows
    return out


def residual_change(slopes: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the linear change of the wavefront residuals due to a change of the compensator moves, (S, R).

    ``change`` (S, C) is the change of the moves and ``slopes`` (S, R, C) are the derivatives of the residuals with
    respect to them, for S cameras, R residuals and C compensators.
    """
    return np.asarray((slopes @ change[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Adjustments:
    """Compensators and their effect on the wavefront residuals, whose squares sum to the mean square error.

    Array dimensions: C compensators, R residuals.

    Attributes
    ----------
    ranges : (C,) ndarray
        Largest moves in either direction, SI units; zero fixes a compensator.
    steps : (C,) ndarray
        Step sizes of the moves, SI units; 0 for continuous moves.
    accuracies : (C,) ndarray
        Standard deviations of the moves, SI units.
    slope : (R, C) ndarray
        Derivatives of the nominal camera's residuals with respect to the moves, waves per SI unit; 0 where the range is
        zero.
    """

    ranges: np.ndarray
    steps: np.ndarray
    accuracies: np.ndarray
    slope: np.ndarray

    def best(self, slopes: np.ndarray, residuals: np.ndarray, moves: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return the moves within their ranges that minimise the linearised residuals.

        Array dimensions: S cameras, R residuals, C compensators.

        Parameters
        ----------
        slopes : (S, R, C) ndarray
            Derivatives of each camera's residuals with respect to the moves, waves per SI unit.
        residuals : (S, R) ndarray
            Wavefront residuals at the current moves, waves.
        moves : (S, C) ndarray
            Current moves, SI units.
        free : (C,) ndarray of bool
            True for the compensators that may move.

        Returns
        -------
        (S, C) ndarray
            Moves, SI units.
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        slope = slopes * size
        across = np.swapaxes(slope, -1, -2)
        normal = across @ slope
        normal = normal + 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[:, None, None] * np.eye(len(size))
        pull = -(across @ residuals[..., None])[..., 0]
        start = moves / size
        fixed = np.broadcast_to(~free | (self.ranges == 0.0), start.shape).copy()
        target = start.copy()
        for _ in range(len(size) + 1):
            # the change of the fixed compensators is known, and the others compensate it
            known = np.where(fixed, target - start, 0.0)
            rest = np.where(fixed, 0.0, pull - (normal @ known[..., None])[..., 0])
            mask = ~fixed
            matrix = normal * mask[:, :, None] * mask[:, None, :] + np.eye(len(size)) * fixed[:, :, None]
            change = known + np.linalg.solve(matrix, rest[..., None])[..., 0] * mask
            target = np.clip(start + change, -1.0, 1.0)
            beyond = mask & (np.abs(start + change) > 1.0)
            if not beyond.any():
                break
            fixed |= beyond
        return np.asarray(target * size)

    def corrected(self, slopes: np.ndarray, change: np.ndarray, miss: np.ndarray) -> np.ndarray:
        """Return the residuals' derivatives (S, R, C) after Broyden's rank-one update with the outcome of a step.

        Array dimensions: S cameras, R residuals, C compensators.

        Parameters
        ----------
        slopes : (S, R, C) ndarray
            Derivatives of the residuals with respect to the moves before the step, waves per SI unit.
        change : (S, C) ndarray
            Change of the moves, SI units.
        miss : (S, R) ndarray
            Residuals after the step minus those predicted by the derivatives, waves.
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        step = change / size
        norm = np.sum(step**2, axis=-1)
        direction = step / np.where(norm > 0.0, norm, 1.0)[:, None] / size
        return np.asarray(slopes + miss[..., None] * direction[:, None])

    @property
    def exact(self) -> bool:
        """True if the compensators move continuously and without errors."""
        return not np.any((self.steps > 0.0) | (self.accuracies > 0.0))

    def made(self, slopes: np.ndarray, residuals: np.ndarray, moves: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the moves as executed one after the other, in whole steps and with errors.

        Each move compensates the errors of those before it.

        Array dimensions: S cameras, R residuals, C compensators.

        Parameters
        ----------
        slopes : (S, R, C) ndarray
            Derivatives of the residuals with respect to the moves, waves per SI unit.
        residuals : (S, R) ndarray
            Wavefront residuals at ``moves``, waves.
        moves : (S, C) ndarray
            Ideal moves, SI units.
        errors : (S, C) ndarray
            Errors of the executed moves, in standard deviations.
        """
        free = np.ones(len(self.ranges), dtype=bool)
        wanted, executed = moves.copy(), moves.copy()
        for c, (step, accuracy) in enumerate(zip(self.steps, self.accuracies, strict=True)):
            if self.ranges[c] == 0.0:
                continue
            move = wanted[:, c]
            move = np.round(move / step) * step if step else move
            executed = wanted.copy()
            executed[:, c] = move + accuracy * errors[:, c]
            free[c] = False
            residuals = residuals + residual_change(slopes, executed - wanted)
            wanted = self.best(slopes, residuals, executed, free)
            residuals = residuals + residual_change(slopes, wanted - executed)
        return wanted


SETTLED = 1e-3
"""Largest change of a camera's rms wavefront error by a further adjustment step, waves, for it to count as converged.
"""
MOST_STEPS = 12
"""Largest number of iterations of a camera's adjustments, three times as many as any library camera has needed."""

FIRST_RULE, LARGEST_RULE = 3, 17
"""Numbers of wavelengths of the first and of the largest quadrature rule over a spectrum that is tried."""
STRIDE = 4
"""Distortion is evaluated at every ``STRIDE``-th of the points along the line."""
_MOVE = 1e-3
"""Step of the numerical derivatives with respect to a compensator, as a fraction of its range."""


@dataclass(frozen=True, eq=False)
class AdjustedCameras:
    """Perturbed cameras after their adjustments.

    Array dimensions: S cameras, C compensators, P parts of the merits (smooth quantities, such as the MTF at one
    field), F fields, K wavelengths, N rays.

    Attributes
    ----------
    moves : (S, C) ndarray
        Compensator moves, SI units.
    parts : (S, P) ndarray
        Parts of all merits; NaN where the light is lost.
    problems : tuple of str
        Reason why the light is lost, (S,); empty where it is not.
    settled : (S,) ndarray
        Change of the rms wavefront error by a further step of the adjustments, waves; it shows convergence.
    paths : (S, F, K N) ndarray or None
        Optical paths of the beams' rays minus those of the chief rays, for all traced wavelengths, metres; None if not
        requested.
    """

    moves: np.ndarray
    parts: np.ndarray
    problems: tuple[str, ...]
    settled: np.ndarray
    paths: np.ndarray | None = None

    @classmethod
    def joined(cls, results: Sequence[AdjustedCameras]) -> AdjustedCameras:
        """Return the results of several groups of perturbed cameras, concatenated in order."""
        paths = [result.paths for result in results if result.paths is not None]
        return cls(
            np.concatenate([result.moves for result in results]),
            np.concatenate([result.parts for result in results]),
            tuple(text for result in results for text in result.problems),
            np.concatenate([result.settled for result in results]),
            np.concatenate(paths) if len(paths) == len(results) else None,
        )


def judged_camera(test: ToleranceBudgetSpec | AsBuiltSpec, instrument: Instrument) -> str:
    """Return the name of the camera that a test judges; raise InputError if it is unknown or one of several."""
    names = tuple(instrument.cameras)
    if test.camera is None and len(names) > 1:
        raise test.error("the instrument has several cameras", ("camera",), allowed=names_text(names))
    if test.camera is not None and test.camera not in names:
        raise test.error(unknown("no such camera", test.camera, names), ("camera",))
    return test.camera or names[0]


class ToleranceBench:
    """Nominal camera of a tolerance budget, with its varied parameters, compensators and merits.

    It traces and adjusts perturbed cameras. Array dimensions: F fields, C wavelengths.

    Parameters
    ----------
    setup : ToleranceSetup
        Tolerance budget.
    backend : Backend
        Array backend of the ray trace.
    experiment : MonitorExperiment, optional
        Instrument of the budget, if it has been built already.

    Attributes
    ----------
    numbers : tuple of VariedParameter
        Varied parameters.
    compensators : tuple of VariedParameter
        Adjusted parameters.
    merits : tuple of Merit
        Merits of the budget.
    fields : (F, 2) ndarray
        Fields of the wavefronts.
    monitor : MonitorMerit or None
        Monitor of the instrument; None if no merit is about it.
    colours, shares : (C,) ndarray
        Wavelengths of wavefronts and MTFs, metres, and their weights.

    Raises
    ------
    InputError
        A name does not exist, the camera cannot have a merit, or it has no light.
    """

    def __init__(self, setup: ToleranceSetup, backend: Backend, experiment: MonitorExperiment | None = None) -> None:
        self.setup, self.backend = setup, backend
        test = setup.test
        self.experiment = experiment or MonitorExperiment(setup.base, backend)
        instrument = self.instrument = self.experiment.instrument
        self.camera = judged_camera(setup.test, self.instrument)
        self.line = line_points(instrument, self.camera)
        thermal = self.experiment.thermal
        maker = ParameterMaker(test, instrument, thermal)
        self.numbers: tuple[VariedParameter, ...] = tuple(
            number for name, tolerance in test.tolerances.items() for number in maker.tolerance(name, tolerance)
        )
        self.compensators = tuple(maker.compensator(name, spec) for name, spec in test.compensators.items())
        self.merits, self.fields = merits_of(dict(test.merits), len(self._along), tuple(instrument.cameras))
        if not len(self.fields) and self.compensators:
            allowed = "a merit of kind wavefront, mtf or chief_ray, at whose fields the wavefront is made least"
            raise test.error("compensators need merits with fields", ("merits",), allowed=allowed)
        self.ranges = np.array([compensator.range_si for compensator in test.compensators.values()])
        self.grid_steps = np.array([compensator.step_si for compensator in test.compensators.values()])
        self.accuracies = np.array([compensator.accuracy_si for compensator in test.compensators.values()])
        self.parts = self.merits[-1].parts.stop
        self.optics = CameraOptics.within(instrument, self.camera, backend)
        self.wavelength = float(self.optics.model.spec.wavelength)
        self._moves_stop = self._adjusts_before_stop()
        self.colours, self.shares = np.array([self.wavelength]), np.ones(1)
        self._wanted = {merit.spec.kind for merit in self.merits}
        require_bodies(setup, self.optics.path)
        if len(self.fields):
            self._prepare()
        self.monitor = MonitorMerit.of(
            setup, self.experiment, self.camera, (*self.numbers, *self.compensators), self.ranges
        )

    @property
    def figure_faces(self) -> dict[str, Element]:
        """Name of each tolerance that is a figure error -> its surface."""
        bodies = {number.entry: next(iter(number.moves)) for number in self.numbers if number.kind == SPECTRUM}
        return {name: self.instrument.assembly.face(body) for name, body in bodies.items()}

    def _adjusts_before_stop(self) -> bool:
        """Return True if adjustments change the light before the stop, so that rays must be aimed at the stop again."""
        path = self.optics.path
        chain = [path.assembly.elements[name] for name in path.assembly.sequences[f"{path.name}/to_stop"]]
        bodies = {body for element in chain for body in (element.body, element.solid) if body is not None}
        moved = {body for number in self.compensators for body in number.moves}
        return any(body == moved_body or body.startswith(f"{moved_body}/") for body in bodies for moved_body in moved)

    # quantities common to all cameras

    @one_blas_thread()
    def _prepare(self) -> None:
        """Trace the nominal camera in the spectrum of the budget, with as many wavelengths as its merits need."""
        test, spectrum = self.setup.test, budget_spectrum(self.setup.test, self.optics.model.spec)
        if spectrum is None:
            self._prepare_in(np.array([self.wavelength]), np.ones(1))
            return

        def values(count: int) -> np.ndarray:
            self._prepare_in(*spectrum.rule(count))
            return self._designed_values()

        try:
            if wavelengths_enough(spectrum, FIRST_RULE, values, LARGEST_RULE) == FIRST_RULE:
                self._prepare_in(*spectrum.rule(FIRST_RULE))
        except UnphysicalError as error:
            raise test.error(f"merits over the spectrum: {error}", ("light",), allowed="light: design") from error

    def _designed_values(self) -> np.ndarray:
        """Return rms wavefront errors and MTFs of the nominal camera in the current spectrum, before adjustment."""
        squares = np.sum(self._residuals(self.beams.designed.paths).reshape(len(self.fields), -1) ** 2, axis=-1)
        mtfs = [transfer.known for rows in self._transfers.values() for row in rows for transfer in row]
        return np.concatenate([np.sqrt(squares), mtfs])

    def _prepare_in(self, colours: np.ndarray, shares: np.ndarray) -> None:
        """Compute the data that all perturbed cameras share, for C wavelengths.

        Parameters
        ----------
        colours : (C,) ndarray
            Wavelengths, metres.
        shares : (C,) ndarray
            Weights of the wavelengths in the spectrum; they sum to 1.
        """
        model = self.optics.model
        self.colours, self.shares = colours, shares
        # mirrors image all wavelengths alike: one is traced for all, and their light differs in the MTF alone
        traced = colours if lenses(model.spec) else np.array([self.wavelength])
        self.traced_shares = shares if len(traced) == len(colours) else np.ones(1)
        try:
            self.beams = VariedBeams(self.optics, self.fields, traced, self.traced_shares, "mtf" in self._wanted)
        except (VignettedBeamError, RoughWavefrontError) as error:
            raise self.setup.test.error(str(error), ("merits",), allowed=error.allowed) from error
        self._roots = WavefrontNorm.of(self.beams.illuminated_nodes(), self.beams.degree)
        beams, light = (self.beams.cosines, self.beams.degree), (colours, shares)
        self._transfers = fixed_transfers(self.optics, self.setup.test, self.merits, self.fields, light, *beams)
        self._adjust = Adjustments(self.ranges, self.grid_steps, self.accuracies, self._adjustment_slope())

    def _adjustment_slope(self) -> np.ndarray:
        """Return the derivatives of R wavefront residuals with respect to C compensators, (R, C), waves per SI unit.

        They are 0 where a compensator's range is zero.
        """
        used = np.flatnonzero(self.ranges)
        slope = np.zeros((self._residuals(self.beams.designed.paths).shape[1], len(self.ranges)))
        if not used.size:
            return slope
        step = _MOVE * self.ranges[used]
        amounts = np.zeros((2 * len(used), len(self.ranges)))
        amounts[np.arange(len(used)), used] = step
        amounts[len(used) + np.arange(len(used)), used] = -step
        residuals = self._residuals(self.beams.light(states_of(self.compensators, amounts)).paths)
        ahead, behind = residuals[: len(used)], residuals[len(used) :]
        slope[:, used] = ((ahead - behind) / (2.0 * step[:, None])).T
        return slope

    def _residuals(self, paths: np.ndarray) -> np.ndarray:
        """Return residuals whose squares sum to the mean square wavefront errors of all fields, (S, R), in waves.

        The unit is the design wavelength. Array dimensions: S cameras, R residuals.
        """
        terms = paths.reshape(len(paths), len(self.fields), len(self.traced_shares), -1) @ self.beams.solve.T
        return self._roots.residuals(terms / self.wavelength, self.traced_shares)

    # adjustments

    def adjust_cameras(
        self, amounts: np.ndarray, errors: np.ndarray | None = None, paths: bool = False
    ) -> AdjustedCameras:
        """Trace perturbed cameras, adjust them with the compensators, and compute their merits.

        Array dimensions: S cameras, K varied parameters, C compensators.

        Parameters
        ----------
        amounts : (S, K) ndarray
            Amounts of the varied parameters, SI units.
        errors : (S, C) ndarray, optional
            Errors of the compensator moves in standard deviations. With them each compensator moves by whole steps with
            its error, in order, and each move compensates the errors of those before it. None for the ideal adjustment.
        paths : bool
            True to return the optical paths of the rays as well.

        Returns
        -------
        AdjustedCameras
            The adjusted cameras; one whose light is lost does not affect the others.
        """
        starts = range(0, len(amounts), AT_ONCE)
        results = [
            self._try(amounts[s : s + AT_ONCE], None if errors is None else errors[s : s + AT_ONCE]) for s in starts
        ]
        return AdjustedCameras.joined(results if paths else [replace(result, paths=None) for result in results])

    def _try(self, amounts: np.ndarray, errors: np.ndarray | None) -> AdjustedCameras:
        try:
            return self._adjusted(amounts, errors)
        except PhysicalError as error:
            if len(amounts) == 1:
                nan_parts = np.full((1, self.parts), np.nan)
                paths = np.full((1, *self.beams.designed.paths.shape[1:]), np.nan) if len(self.fields) else None
                moves = np.full((1, len(self.ranges)), np.nan)
                return AdjustedCameras(moves, nan_parts, (str(error) or "lost",), np.full(1, np.nan), paths)
        half = len(amounts) // 2
        halves = slice(0, half), slice(half, None)
        return AdjustedCameras.joined(
            [self._try(amounts[rows], None if errors is None else errors[rows]) for rows in halves]
        )

    @one_blas_thread()
    def _adjusted(self, amounts: np.ndarray, errors: np.ndarray | None) -> AdjustedCameras:
        """Adjust cameras and compute their merits; raise PhysicalError if the light of any is lost."""
        count = len(amounts)
        moves, settled = np.zeros((count, len(self.ranges))), np.zeros(count)

        def state(moves: np.ndarray, rows: np.ndarray | slice = slice(None)) -> list[State]:
            moved = np.concatenate([amounts[rows], moves[rows]], axis=1)
            return states_of((*self.numbers, *self.compensators), moved)

        if not len(self.fields):
            return AdjustedCameras(moves, self._parts(state(moves), amounts, moves, None), ("",) * count, settled)
        states = state(moves)
        light = self.beams.light(states)

        def again(moved: Sequence[State], rows: np.ndarray) -> BeamLight:
            """Trace cameras once more after an adjustment.

            Rays keep their starting points unless the adjustment moves the beam at the stop.
            """
            return self.beams.light(moved, None if self._moves_stop else light.aimed[rows])

        if np.any(self.ranges > 0.0):
            all_free = np.ones(len(self.ranges), dtype=bool)
            residuals = self._residuals(light.paths)
            slopes = np.tile(self._adjust.slope, (count, 1, 1))
            for _ in range(MOST_STEPS):
                target = self._adjust.best(slopes, residuals, moves, all_free)
                expected = residual_change(slopes, target - moves)
                settled = np.sqrt(np.sum(expected**2, axis=1) / len(self.fields))
                # converged cameras stay, so that a camera's numbers do not depend on the others
                going = settled > SETTLED * 1e-2
                if not going.any():
                    break
                active = np.flatnonzero(going)
                change, moves = target[active] - moves[active], np.where(going[:, None], target, moves)
                moved = state(moves, active)
                for k, new_state in zip(active, moved, strict=True):
                    states[k] = new_state
                traced = again(moved, active)
                for known, new in zip(light[:3], traced[:3], strict=True):
                    known[active] = new
                arrived = self._residuals(traced.paths)
                miss = arrived - residuals[active] - expected[active]
                slopes[active], residuals[active] = self._adjust.corrected(slopes[active], change, miss), arrived
            if errors is not None and not self._adjust.exact:
                moves = self._adjust.made(slopes, residuals, moves, errors)
                states = state(moves)
                light = again(states, np.arange(count))
        return AdjustedCameras(moves, self._parts(states, amounts, moves, light), ("",) * count, settled, light.paths)

    # merits

    def parts_of(self, states: Sequence[State]) -> np.ndarray:
        """Return the parts of all merits (S, P) in given states; raise PhysicalError if the light is lost.

        Array dimensions: S cameras, P parts of the merits (smooth quantities, such as the MTF at one field).
        """
        amounts, moves = np.zeros((len(states), len(self.numbers))), np.zeros((len(states), len(self.ranges)))
        return self._parts(states, amounts, moves, self.beams.light(states) if len(self.fields) else None)

    def residuals_of(self, states: Sequence[State]) -> np.ndarray:
        """Return residuals (S, R) whose squares sum to the merits' mean squares, in units of the requirements.

        They change linearly with small motions. An MTF is represented by the wavefront at its fields, in units of a
        quarter of a wavelength rms. Obstruction and monitor merits have no residuals.

        Array dimensions: S cameras, R residuals.

        Raises
        ------
        PhysicalError
            The light of a camera is lost.
        """
        count = len(states)
        light = self.beams.light(states) if len(self.fields) else None
        terms = None if light is None else self._residuals(light.paths).reshape(count, len(self.fields), -1)
        line = self._line(states)
        out = []
        for merit in self.merits:
            if merit.spec.kind in ("obstruction", *OF_MONITOR):
                continue
            if merit.spec.kind in ("wavefront", "mtf"):
                assert terms is not None
                values = terms[:, merit.fields].reshape(count, -1) / np.sqrt(len(merit.fields))
                size = merit.spec.requirement if merit.spec.kind == "wavefront" else 0.25
            else:
                values = self._change(merit, line, light) / np.sqrt(merit.parts.stop - merit.parts.start)
                size = merit.spec.requirement
            out.append(values / size)
        return np.concatenate(out, axis=1) if out else np.zeros((count, 0))

    def pair_curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Return the second derivatives of the merits' parts that follow from the wavefronts' first derivatives.

        They are a (P, K, K) array.

        Parts are smooth quantities, such as the MTF at one field. Mean squares and MTFs are quadratic in a wavefront
        that itself is nearly linear in the parameters. Parts that are no function of a wavefront get 0.

        Array dimensions: P parts, K varied parameters, F fields, C wavelengths, N rays.

        Parameters
        ----------
        slopes : (K, F, C N) ndarray
            Derivatives of the optical paths with respect to the varied parameters, metres per unit.
        """
        out = np.zeros((self.parts, len(slopes), len(slopes)))
        residuals = self._residuals(slopes).reshape(len(slopes), len(self.fields), -1) if len(self.fields) else None
        for k, merit in enumerate(self.merits):
            if merit.spec.kind == "wavefront":
                assert residuals is not None
                for part, f in enumerate(merit.fields, merit.parts.start):
                    out[part] = 2.0 * residuals[:, f] @ residuals[:, f].T
            elif merit.spec.kind == "mtf":
                transfers = [
                    (f, transfer) for f, row in zip(merit.fields, self._transfers[k], strict=True) for transfer in row
                ]
                for part, (f, transfer) in enumerate(transfers, merit.parts.start):
                    out[part] = transfer.curvature(slopes[:, f])
        return out

    def _parts(
        self, states: Sequence[State], amounts: np.ndarray, moves: np.ndarray, light: BeamLight | None
    ) -> np.ndarray:
        """Return the parts of all merits, (S, P).

        Array dimensions: S cameras, P parts of the merits (smooth quantities, such as the MTF at one field).
        """
        out = np.empty((len(states), self.parts))
        known: dict[str, np.ndarray] = {}
        if self.monitor is not None:
            known = self.monitor.variances(np.concatenate([amounts, moves], axis=1), states)
        taken = None
        if "obstruction" in self._wanted:
            taken = obstructed_shares(self.optics.path, states, self.beams.directions, self.beams.start)
        squares = None
        if light is not None and "wavefront" in self._wanted:
            terms = self._residuals(light.paths).reshape(len(states), len(self.fields), -1)
            squares = np.sum(terms**2, axis=-1)
        line = self._line(states)
        for k, merit in enumerate(self.merits):
            kind = merit.spec.kind
            if kind == "wavefront":
                assert squares is not None
                columns = squares[:, merit.fields]
            elif kind == "mtf":
                assert light is not None
                columns = self._modulations(k, merit, light.eikonals)
            elif kind == "obstruction":
                assert taken is not None
                columns = taken[:, merit.fields]
            elif kind in OF_MONITOR:
                columns = known[merit.name]
            else:
                columns = self._change(merit, line, light)
            out[:, merit.parts] = columns
        return out

    def _change(self, merit: Merit, line: dict[str, np.ndarray], light: BeamLight | None) -> np.ndarray:
        """Return the parts of a merit that is a change of the line of sight or of chief rays.

        The change is that from the nominal camera.
        """
        if merit.spec.kind != "chief_ray":
            return line[merit.spec.kind]
        assert light is not None
        rotation = light.chiefs[:, merit.fields, :2] - self.beams.designed.chiefs[0, merit.fields, :2]
        return np.asarray(rotation.reshape(len(rotation), -1))

    def _modulations(self, k: int, merit: Merit, eikonals: np.ndarray) -> np.ndarray:
        longer = eikonals - self.beams.designed.eikonals[0]
        pairs = zip(merit.fields, self._transfers[k], strict=True)
        return np.stack([part.modulation(longer[:, f]) for f, row in pairs for part in row], axis=-1)

    def _line(self, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Return the parts of the merits about the camera's image line (boresight, roll, distortion, ...), by kind."""
        if not self._wanted & {"boresight", "roll", "principal_distance", "distortion"}:
            return {}
        sight, axes = self.experiment.sight, self.experiment.sight.axes[self.camera]
        index = list(self.instrument.cameras).index(self.camera)
        directions = np.concatenate([sight.nominal[index], sight.trace(states)[index]])
        change = line_change(directions, self.line, axes)
        _, _, tangent = line_tangents(directions, self.line, axes)
        # a shift and a change of the principal distance are not distortion
        moved = (tangent[1:] - tangent[0]) * change.nominal_distance
        level = np.stack([np.ones_like(self.line), self.line], axis=-1)
        rest = (moved - moved @ np.linalg.pinv(level).T @ level.T)[:, self._along]
        return {
            "boresight": np.stack([change.d_alpha, change.d_beta], axis=-1),
            "roll": change.d_gamma[:, None],
            "principal_distance": change.d_f[:, None],
            "distortion": rest,
        }

    @property
    def _along(self) -> np.ndarray:
        """Indices of the points of the line at which distortion is evaluated."""
        return np.arange(0, LINE_POINTS, STRIDE)

    def scaled(self, scales: np.ndarray) -> ToleranceBench:
        """Return the same budget and camera with the limit of each of E tolerances multiplied by ``scales`` (E,)."""
        other = copy(self)
        by_entry = dict(zip(self.entries, scales.tolist(), strict=True))
        other.numbers = tuple(replace(number, size=number.size * by_entry[number.entry]) for number in self.numbers)
        vars(other).pop("sizes", None)
        return other

    @cached_property
    def entries(self) -> dict[str, tuple[int, ...]]:
        """Tolerance -> indices of its varied parameters, of which a figure error has one for each Zernike term."""
        out: dict[str, tuple[int, ...]] = {}
        for k, number in enumerate(self.numbers):
            out[number.entry] = (*out.get(number.entry, ()), k)
        return out

    @cached_property
    def sizes(self) -> np.ndarray:
        """SI amount of one unit of each of the K varied parameters, (K,).

        The unit is the limit of a tolerance, or the standard deviation of a figure term.
        """
        return np.array([number.size for number in self.numbers])

    def values(self, parts: np.ndarray) -> np.ndarray:
        """Return the values of all merits, (..., M), from their parts (..., P).

        Array dimensions: M merits, P parts of the merits (smooth quantities, such as the MTF at one field).
        """
        return np.stack([merit.values(parts) for merit in self.merits], axis=-1)

    def worst_margins(self, values: np.ndarray) -> np.ndarray:
        """Return the worst margin of each of S cameras, (S,), from M merits, (S, M); infinite without light.

        A margin is the excess of a merit over its requirement, relative to the requirement; negative where it is met.
        """
        margins = np.stack([merit.margin(values[:, k]) for k, merit in enumerate(self.merits)])
        return np.asarray(np.where(np.isnan(margins), np.inf, margins).max(axis=0))

    def passing(self, values: np.ndarray) -> np.ndarray:
        """Return True where merits (..., M) meet their requirements.

        Array dimensions: M merits.
        """
        passes: Iterable[np.ndarray] = (merit.passes(values[..., k]) for k, merit in enumerate(self.merits))
        return np.stack(list(passes), axis=-1)
