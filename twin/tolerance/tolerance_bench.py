"""One camera on which tolerances are tried: exact traces of many cameras at once, with their adjustments.

All wavefronts are those of the beams that the designed camera images at the merits' fields, traced through the same
points of the stop. What bodies and edges take of a beam is that of the designed camera, but where it is itself the
merit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optics.geometry.polygon import area
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.physical_error import PhysicalError, UnphysicalError
from optics.numerics.threads import one_blas_thread
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.line_of_sight import line_change, line_tangents
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.lit_stop import LitStop
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_terms import products, to_terms
from optics.waves.transfer import transfer
from optics.waves.varied_pupil import VariedTransfer
from optics.waves.wavefront import path_to_sphere
from scenes.models.camera_model import LAUNCH_DISTANCE
from scenes.specs.tolerance import OF_MONITOR, ToleranceSetup
from scenes.yaml.errors import names_text, unknown
from twin.camera.camera_optics import CameraOptics
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import LINE_POINTS, line_points
from twin.tolerance.merits import Merit, merits_of
from twin.tolerance.monitor_merit import MonitorMerit
from twin.tolerance.obstruction_merit import obstructed_shares, require_bodies
from twin.tolerance.variations import VariedNumber, compensator_numbers, states_of, tolerance_numbers

AT_ONCE = 200
"""Cameras traced in one launch, to bound memory."""

AIM_TOLERANCE = 1e-8
"""Distance of a ray from its point of the stop, metres: a wavefront error of ten waves changes by 1e-6 of one there."""

SETTLED = 1e-3
"""Rms wavefront error that the next step of the adjustments would still change, waves; in the worst of three times as
many steps as any camera of the library has needed."""
MOST_STEPS = 12

GRIDS = ((5, 8), (7, 10), (10, 14))
"""Rings of the stop's quadrature and degree of the polynomials for the wavefront, the coarsest first."""
RESIDUAL = 1e-3
"""Rms of a wavefront that its polynomials may leave, waves."""
TRANSFER = 1e-3
"""By how much an MTF at fixed nodes may differ from that of the designed pupil by itself."""
EVERY = 4
"""Distortion is told of each fourth point of the line."""
_MOVE = 1e-3
"""Step of the derivatives by compensators, as a share of their range."""


@dataclass(frozen=True, eq=False)
class Tried:
    """Cameras that were tried.

    Attributes:
        moves: amounts of the compensators, SI, (S, C).
        parts: of all merits, (S, P); NaN where the light is lost.
        problems: why it is lost, empty where it is not, (S,).
        settled: rms by which one further step would change the wavefront, waves, (S,).
        paths: optical paths of the beams' rays less those of the chief rays, (S, F, N), metres; None if not asked for.
    """

    moves: np.ndarray
    parts: np.ndarray
    problems: tuple[str, ...]
    settled: np.ndarray
    paths: np.ndarray | None = None

    @classmethod
    def joined(cls, several: Sequence[Tried]) -> Tried:
        """Several, one after the other."""
        paths = [one.paths for one in several if one.paths is not None]
        return cls(
            np.concatenate([one.moves for one in several]),
            np.concatenate([one.parts for one in several]),
            tuple(text for one in several for text in one.problems),
            np.concatenate([one.settled for one in several]),
            np.concatenate(paths) if len(paths) == len(several) else None,
        )


class ToleranceBench:
    """A camera with what varies, what is adjusted and what is asked.

    Args:
        setup: the budget.
        backend: where to trace.

    Attributes:
        numbers: that vary.
        compensators: that are adjusted.
        merits: that are asked.
        fields: of the wavefronts, (F, 2).
        monitor: of the instrument; None where no merit is about it.

    Raises:
        InputError: names that do not exist, a merit that the camera cannot have, or a camera without light.
    """

    def __init__(self, setup: ToleranceSetup, backend: Backend) -> None:
        self.setup, self.backend = setup, backend
        test = setup.test
        self.experiment = MonitorExperiment(setup.base, backend)
        instrument = self.instrument = self.experiment.instrument
        self.camera = self._camera_name()
        self.line = line_points(instrument, self.camera)
        thermal = self.experiment.thermal
        self.numbers: tuple[VariedNumber, ...] = tolerance_numbers(setup, instrument, thermal)
        self.compensators: tuple[VariedNumber, ...] = compensator_numbers(setup, instrument, thermal)
        self.merits, self.fields = merits_of(dict(test.merits), len(self._along), tuple(instrument.cameras))
        if not len(self.fields) and self.compensators:
            allowed = "a merit of kind wavefront, mtf or chief_ray, at whose fields the wavefront is made least"
            raise test.error("compensators need fields", ("merits",), allowed=allowed)
        self.ranges = np.array([one.range_si for one in test.compensators.values()])
        self.grid_steps = np.array([one.step_si for one in test.compensators.values()])
        self.accuracies = np.array([one.accuracy_si for one in test.compensators.values()])
        self.parts = self.merits[-1].parts.stop
        self.optics = CameraOptics.within(instrument, self.camera, backend)
        self.wavelength = float(self.optics.model.spec.wavelength)
        self._wanted = {merit.spec.kind for merit in self.merits}
        require_bodies(setup, self.optics.path)
        if len(self.fields):
            self._prepare()
        self.monitor = MonitorMerit.of(
            setup, self.experiment, self.camera, (*self.numbers, *self.compensators), self.ranges
        )

    def _camera_name(self) -> str:
        test, names = self.setup.test, tuple(self.instrument.cameras)
        if test.camera is None and len(names) > 1:
            raise test.error("the instrument has several cameras", ("camera",), allowed=names_text(names))
        if test.camera is not None and test.camera not in names:
            raise test.error(unknown("no such camera", test.camera, names), ("camera",))
        return test.camera or names[0]

    # what does not change from camera to camera

    @one_blas_thread()
    def _prepare(self) -> None:
        path, model = self.optics.path, self.optics.model
        self.directions = self.optics.directions(self.fields)
        for rings, degree in GRIDS:
            self.nodes, self.degree = quadrature.disk(rings), degree
            self.points = np.concatenate([np.zeros((1, 2)), np.stack([self.nodes.x, self.nodes.y], axis=-1)])
            self._aim_nominal()
            self.radius = float(model.first_order.exit_pupil_distance[0])
            position, direction, paths, valid = self._rays([{}])
            if not valid.all():
                problem = "the beams of the fields are cut by what is not the stop and has no edges of its own"
                raise self.setup.test.error(problem, ("merits",), allowed="fields whose light comes through whole")
            self.designed = self._paths(position, direction, paths)[0]
            self.chief = direction[0, :, 0]
            self.solve = to_terms(self.nodes, degree)
            rest = self.designed - self.designed @ self.solve.T @ products(self.nodes.x, self.nodes.y, degree).T
            self.residual = float(np.sqrt(np.max(rest**2 @ self.nodes.share))) / self.wavelength
            if self.residual <= RESIDUAL:
                break
        else:
            problem = f"wavefronts that polynomials do not follow: they leave {self.residual:.2g} waves"
            raise self.setup.test.error(problem, ("merits",), allowed="a sharper camera, or fields where it is")
        self._roots = self._lit_roots(path.shadows_on_stop({}, self.directions)[0])
        self._transfers = self._fixed_transfers(direction[0])
        self._slope = self._adjustment_slope()

    def _aim_nominal(self) -> None:
        """Launch points and aiming of the designed camera's rays, from which all others are aimed."""
        path = self.optics.path
        start = np.asarray(
            path.assembly.nominal_pose(f"{path.root}/{path.model.mirrors[0]}").translation
            - LAUNCH_DISTANCE * self.directions
        )
        least = np.eye(3)[np.argmin(np.abs(self.directions), axis=-1)]
        axes = transverse_axes(self.directions, least)
        self._fan = RayFan(start[:, None], self.directions[:, None], axes[:, None], moves_position=True)
        self._target = path.stop.radius * self.points + np.array(path.stop.centre)
        systems = assemble(path.assembly, [f"{path.name}/to_stop"]).take(np.zeros(len(start), dtype=int))
        middle, slope = aim(self.backend, systems, self._fan, np.zeros((1, 2)))
        near = middle + np.einsum("fnij,nj->fni", np.linalg.inv(slope), self._target)
        slopes = np.broadcast_to(slope, (*near.shape, 2))
        self._aimed = aim(self.backend, systems, self._fan, self._target, near, slopes, AIM_TOLERANCE)

    def _lit_roots(self, pieces: np.ndarray) -> np.ndarray:
        """Matrices (F, K, K) of which the squares of products with a wavefront's coefficients are its mean square,
        piston and tilt taken out over the light.
        """
        out = []
        free = not pieces.shape[1] or not np.any(area(pieces) > SMALLEST)
        for own in pieces if not free else [None] * len(self.fields):
            if own is None:
                nodes = quadrature.disk(self.degree)
                x, y, share = nodes.x, nodes.y, nodes.share
            else:
                lit = LitStop.of(own[None], self.degree, max(6, self.degree // 2 + 2))
                x, y, share = lit.x[0], lit.y[0], lit.weight[0] / np.sum(lit.weight)
            table = products(x, y, self.degree)
            level = np.stack([np.ones_like(x), x, y], axis=-1)
            weighted = level * share[:, None]
            table = table - level @ np.linalg.solve(level.T @ weighted, weighted.T @ table)
            value, vector = np.linalg.eigh(table.T @ (table * share[:, None]))
            out.append(np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T)
        return np.stack(out)

    def _fixed_transfers(self, direction: np.ndarray) -> dict[int, list[list[VariedTransfer]]]:
        """For every merit of kind mtf its transfer functions, field by field and direction by direction."""
        asked = [(k, merit) for k, merit in enumerate(self.merits) if merit.spec.kind == "mtf"]
        if not asked:
            return {}
        test = self.setup.test
        try:
            pupils = self.optics.pupils(self.fields)
        except UnphysicalError as error:
            raise test.error(f"the designed camera has no MTF: {error}", ("merits", asked[0][1].name)) from error
        cosines = direction[:, 1:, 1::-1]
        out = {}
        for k, merit in asked:
            spec = merit.spec
            size = self.optics.nyquist if spec.frequency is None else 1e3 * spec.frequency
            axes = {"line": (0,), "track": (1,), "worse": (0, 1)}[spec.direction]
            rows = []
            for f in merit.fields:
                row = []
                for axis in axes:
                    frequency = size * np.eye(2)[axis]
                    fixed = VariedTransfer.of(pupils[f], frequency, self.wavelength, cosines[f], self.degree)
                    if fixed is None:
                        problem = f"{1e-3 * size:.4g} cycles per mm lie beyond the cut-off at a field"
                        raise test.error(problem, ("merits", merit.name, "frequency"), allowed="a lower frequency")
                    whole = abs(transfer(pupils[f], frequency[None], self.wavelength, np.zeros(1))[0, 0])
                    if abs(abs(np.sum(fixed.phasors)) - whole) > TRANSFER:
                        problem = "the MTF of the designed camera is not settled"
                        raise test.error(problem, ("merits", merit.name), allowed="a sharper camera, or another merit")
                    row.append(fixed)
                rows.append(row)
            out[k] = rows
        return out

    def _adjustment_slope(self) -> np.ndarray:
        """Derivatives of the residuals by the compensators, (R, C), waves per SI unit; 0 where the range is zero."""
        used = np.flatnonzero(self.ranges)
        slope = np.zeros((self._roots.shape[0] * self._roots.shape[1], len(self.ranges)))
        if not used.size:
            return slope
        step = _MOVE * self.ranges[used]
        amounts = np.zeros((2 * len(used), len(self.ranges)))
        amounts[np.arange(len(used)), used] = step
        amounts[len(used) + np.arange(len(used)), used] = -step
        residuals = self._residuals(self._errors(states_of(self.compensators, amounts))[0])
        ahead, behind = residuals[: len(used)], residuals[len(used) :]
        slope[:, used] = ((ahead - behind) / (2.0 * step[:, None])).T
        return slope

    # exact traces

    def _rays(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position and direction (S, F, N, 3), path and validity (S, F, N) of the beams at the line CCD.

        Raises:
            AimError: the light of some state does not reach the stop.
        """
        path, count, fields = self.optics.path, len(states), len(self.fields)
        placed = path.assembly.place(states)
        every = np.repeat(np.arange(count), fields)
        imaging, to_stop = (
            assemble(path.assembly, [f"{path.name}/{way}"], states, placed=placed).take(every)
            for way in ("imaging", "to_stop")
        )

        def all_of(array: np.ndarray) -> np.ndarray:
            return np.tile(array, (count, *[1] * (array.ndim - 1)))

        fan = RayFan(all_of(self._fan.position), all_of(self._fan.direction), all_of(self._fan.axes), True)
        near, slope = (all_of(one) for one in self._aimed)
        q, _ = aim(self.backend, to_stop, fan, self._target, near, slope, AIM_TOLERANCE)
        traced = trace(self.backend, imaging, make_rays(self.backend, *fan.at(q))).numpy()
        shape = (count, fields, len(self.points))
        return tuple(one.reshape(*shape, *one.shape[2:]) for one in traced)  # type: ignore[return-value]

    def _paths(self, position: np.ndarray, direction: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """Optical paths (S, F, N - 1) to the spheres about the chief rays' images, less those of the chief rays."""
        to_sphere = path_to_sphere(position, direction, paths, position[..., :1, :], self.radius)
        return np.asarray(to_sphere[..., 1:] - to_sphere[..., :1])

    @one_blas_thread()
    def _errors(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray]:
        """Optical paths (S, F, N - 1), metres, and chief rays' directions (S, F, 3) at the line CCD.

        Raises:
            PhysicalError: the light of some state is lost.
        """
        paths, chiefs = [], []
        for start in range(0, len(states), AT_ONCE):
            position, direction, path, valid = self._rays(states[start : start + AT_ONCE])
            if not valid.all():
                raise UnphysicalError("a surface's edge stops light of a field")
            paths.append(self._paths(position, direction, path))
            chiefs.append(direction[:, :, 0])
        return np.concatenate(paths), np.concatenate(chiefs)

    def _residuals(self, paths: np.ndarray) -> np.ndarray:
        """Residuals (S, R) whose squares sum to the mean squares of the wavefronts over all fields, waves."""
        terms = paths @ self.solve.T / self.wavelength
        return np.asarray(np.einsum("fjk,sfk->sfj", self._roots, terms).reshape(len(paths), -1))

    # adjustments

    def _stepped(self, residuals: np.ndarray, moves: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Amounts (S, C) of the compensators that make linearised residuals least, within ranges; others than those
        that are free (C,) stay.
        """
        size = np.where(self.ranges > 0.0, self.ranges, 1.0)
        slope = self._slope * size
        normal = slope.T @ slope
        normal = normal + 1e-12 * np.trace(normal) * np.eye(len(size))
        pull = -residuals @ slope
        start = moves / size
        held = np.broadcast_to(~free | (self.ranges == 0.0), start.shape).copy()
        target = start.copy()
        for _ in range(len(size) + 1):
            # of those that are held the change is known, and the others follow it
            known = np.where(held, target - start, 0.0)
            rest = np.where(held, 0.0, pull - known @ normal)
            mask = ~held
            matrix = normal * mask[:, :, None] * mask[:, None, :] + np.eye(len(size)) * held[:, :, None]
            change = known + np.linalg.solve(matrix, rest[..., None])[..., 0] * mask
            target = np.clip(start + change, -1.0, 1.0)
            beyond = mask & (np.abs(start + change) > 1.0)
            if not beyond.any():
                break
            held |= beyond
        return np.asarray(target * size)

    def try_out(self, amounts: np.ndarray, errors: np.ndarray | None = None, paths: bool = False) -> Tried:
        """Trace cameras, adjust them, and work out their merits.

        Args:
            amounts: of the numbers that vary, SI, (S, K).
            errors: of the compensators' moves in standard deviations, (S, C); then each is moved by whole steps with
                its error, in their order, the later ones following the earlier; None for the ideal adjustment.
            paths: whether their optical paths are wanted.

        Returns:
            The cameras; one whose light is lost does not change the others.
        """
        starts = range(0, len(amounts), AT_ONCE)
        found = [
            self._try(amounts[s : s + AT_ONCE], None if errors is None else errors[s : s + AT_ONCE]) for s in starts
        ]
        return Tried.joined(found if paths else [replace(one, paths=None) for one in found])

    def _try(self, amounts: np.ndarray, errors: np.ndarray | None) -> Tried:
        try:
            return self._adjusted(amounts, errors)
        except PhysicalError as error:
            if len(amounts) == 1:
                lost = np.full((1, self.parts), np.nan)
                paths = np.full((1, len(self.fields), len(self.points) - 1), np.nan) if len(self.fields) else None
                moves = np.full((1, len(self.ranges)), np.nan)
                return Tried(moves, lost, (str(error) or "lost",), np.full(1, np.nan), paths)
        half = len(amounts) // 2
        both = slice(0, half), slice(half, None)
        return Tried.joined([self._try(amounts[own], None if errors is None else errors[own]) for own in both])

    @one_blas_thread()
    def _adjusted(self, amounts: np.ndarray, errors: np.ndarray | None) -> Tried:
        """Raises PhysicalError: the light of one is lost."""
        count = len(amounts)
        moves, settled = np.zeros((count, len(self.ranges))), np.zeros(count)

        def state(moves: np.ndarray) -> list[State]:
            return states_of((*self.numbers, *self.compensators), np.concatenate([amounts, moves], axis=1))

        if not len(self.fields):
            return Tried(moves, self._parts(state(moves), amounts, moves, None, None), ("",) * count, settled)
        states = state(moves)
        paths, chiefs = self._errors(states)
        if np.any(self.ranges > 0.0):
            every = np.ones(len(self.ranges), dtype=bool)
            for _ in range(MOST_STEPS):
                residuals = self._residuals(paths)
                target = self._stepped(residuals, moves, every)
                settled = np.sqrt(np.sum(((target - moves) @ self._slope.T) ** 2, axis=1) / len(self.fields))
                # what has settled stays, so that a camera's numbers do not depend on the others
                going = settled > SETTLED * 1e-2
                if not going.any():
                    break
                moves = np.where(going[:, None], target, moves)
                some = np.flatnonzero(going)
                own = state(moves)
                for k in some:
                    states[k] = own[k]
                paths[some], chiefs[some] = self._errors([own[k] for k in some])
            if errors is not None and np.any((self.grid_steps > 0.0) | (self.accuracies > 0.0)):
                moves = self._made(self._residuals(paths), moves, errors)
                states = state(moves)
                paths, chiefs = self._errors(states)
        return Tried(moves, self._parts(states, amounts, moves, paths, chiefs), ("",) * count, settled, paths)

    def _made(self, residuals: np.ndarray, moves: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Moves as they are made: by whole steps and with errors, one after the other."""
        free = np.ones(len(self.ranges), dtype=bool)
        wanted, made = moves.copy(), moves.copy()
        for c, (step, accuracy) in enumerate(zip(self.grid_steps, self.accuracies, strict=True)):
            if self.ranges[c] == 0.0:
                continue
            own = wanted[:, c]
            own = np.round(own / step) * step if step else own
            made = wanted.copy()
            made[:, c] = own + accuracy * errors[:, c]
            free[c] = False
            residuals = residuals + (made - wanted) @ self._slope.T
            wanted = self._stepped(residuals, made, free)
            residuals = residuals + (wanted - made) @ self._slope.T
        return wanted

    # merits

    def parts_of(self, states: Sequence[State]) -> np.ndarray:
        """Parts of all merits (S, P) of cameras in any states, as they are. Raises PhysicalError: the light is lost."""
        if not len(self.fields):
            return self._parts(states, None, None)
        return self._parts(states, *self._errors(states))

    def numbers_of(self, states: Sequence[State]) -> np.ndarray:
        """Numbers (S, R) of cameras whose squares sum to their merits' mean squares over fields or points, each in
        units of its requirement; an MTF counts as the wavefront at its fields, a quarter of the wavelength rms as one.

        They change linearly with small motions. Raises PhysicalError: the light is lost.
        """
        count = len(states)
        paths, chiefs = self._errors(states) if len(self.fields) else (None, None)
        terms = None if paths is None else self._residuals(paths).reshape(count, len(self.fields), -1)
        parts = self._parts(states, paths, chiefs)
        out = []
        for merit in self.merits:
            if merit.spec.kind in ("wavefront", "mtf"):
                assert terms is not None
                own = terms[:, merit.fields].reshape(count, -1) / np.sqrt(len(merit.fields))
                size = merit.spec.requirement if merit.spec.kind == "wavefront" else 0.25
            else:
                own = parts[:, merit.parts] / np.sqrt(merit.parts.stop - merit.parts.start)
                size = merit.spec.requirement
            out.append(own / size)
        return np.concatenate(out, axis=1)

    def pair_curvature(self, slopes: np.ndarray) -> np.ndarray:
        """Second derivatives of the parts by pairs of numbers, (P, K, K), as first derivatives of the wavefronts make
        them; 0 for parts that are no function of a wavefront.

        Mean squares and MTFs bend because they are functions of a wavefront that hardly does.

        Args:
            slopes: of the optical paths by the numbers, metres, (K, F, N).
        """
        out = np.zeros((self.parts, len(slopes), len(slopes)))
        residuals = self._residuals(slopes).reshape(len(slopes), len(self.fields), -1) if len(self.fields) else None
        for k, merit in enumerate(self.merits):
            if merit.spec.kind == "wavefront":
                assert residuals is not None
                for part, f in enumerate(merit.fields, merit.parts.start):
                    out[part] = 2.0 * residuals[:, f] @ residuals[:, f].T
            elif merit.spec.kind == "mtf":
                every = [(f, one) for f, row in zip(merit.fields, self._transfers[k], strict=True) for one in row]
                for part, (f, one) in enumerate(every, merit.parts.start):
                    out[part] = one.curvature(slopes[:, f])
        return out

    def _parts(
        self,
        states: Sequence[State],
        amounts: np.ndarray,
        moves: np.ndarray,
        paths: np.ndarray | None,
        chiefs: np.ndarray | None,
    ) -> np.ndarray:
        """Parts of all merits, (S, P)."""
        out = np.empty((len(states), self.parts))
        known: dict[str, np.ndarray] = {}
        if self.monitor is not None:
            known = self.monitor.variances(np.concatenate([amounts, moves], axis=1), states)
        taken = None
        if "obstruction" in self._wanted:
            start = np.asarray(self._fan.position)[:, 0]
            taken = obstructed_shares(self.optics.path, states, self.directions, start)
        squares = None
        if paths is not None and "wavefront" in self._wanted:
            terms = self._residuals(paths).reshape(len(states), len(self.fields), -1)
            squares = np.sum(terms**2, axis=-1)
        line = self._line(states)
        for k, merit in enumerate(self.merits):
            kind = merit.spec.kind
            if kind == "wavefront":
                assert squares is not None
                own = squares[:, merit.fields]
            elif kind == "mtf":
                assert paths is not None
                own = self._modulations(k, merit, paths)
            elif kind == "chief_ray":
                assert chiefs is not None
                turn = chiefs[:, merit.fields, :2] - self.chief[merit.fields, :2]
                own = turn.reshape(len(states), -1)
            elif kind == "obstruction":
                assert taken is not None
                own = taken[:, merit.fields]
            elif kind in OF_MONITOR:
                own = known[merit.name]
            else:
                own = line[kind]
            out[:, merit.parts] = own
        return out

    def _modulations(self, k: int, merit: Merit, paths: np.ndarray) -> np.ndarray:
        longer = paths - self.designed
        return np.stack(
            [
                one.modulation(longer[:, f])
                for f, row in zip(merit.fields, self._transfers[k], strict=True)
                for one in row
            ],
            axis=-1,
        )

    def _line(self, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Parts of the merits that are about the line, by kind."""
        if not self._wanted & {"boresight", "roll", "principal_distance", "distortion"}:
            return {}
        sight, axes = self.experiment.sight, self.experiment.sight.axes[self.camera]
        own = list(self.instrument.cameras).index(self.camera)
        seen = np.concatenate([sight.nominal[own], sight.trace(states)[own]])
        change = line_change(seen, self.line, axes)
        _, _, tangent = line_tangents(seen, self.line, axes)
        # what a shift and another principal distance explain is not distortion
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
        """Points of the line at which distortion is told."""
        return np.arange(0, LINE_POINTS, EVERY)

    def scaled(self, scales: np.ndarray) -> ToleranceBench:
        """The same bench with limits that are scales (E,) times these."""
        other = copy(self)
        by_entry = dict(zip(self.entries, scales.tolist(), strict=True))
        other.numbers = tuple(replace(one, size=one.size * by_entry[one.entry]) for one in self.numbers)
        vars(other).pop("sizes", None)
        return other

    @cached_property
    def entries(self) -> dict[str, tuple[int, ...]]:
        """Name of a tolerance -> numbers that are its own."""
        out: dict[str, tuple[int, ...]] = {}
        for k, number in enumerate(self.numbers):
            out[number.entry] = (*out.get(number.entry, ()), k)
        return out

    @cached_property
    def sizes(self) -> np.ndarray:
        """SI amount of one unit of every number, (K,)."""
        return np.array([number.size for number in self.numbers])

    def values(self, parts: np.ndarray) -> np.ndarray:
        """Values of all merits, (..., M)."""
        return np.stack([merit.values(parts) for merit in self.merits], axis=-1)

    def worst_margins(self, values: np.ndarray) -> np.ndarray:
        """How far cameras of values (S, M) are beyond the requirement that they meet least, (S,); infinite without
        light.
        """
        each = np.stack([merit.margin(values[:, k]) for k, merit in enumerate(self.merits)])
        return np.asarray(np.where(np.isnan(each), np.inf, each).max(axis=0))

    def passing(self, values: np.ndarray) -> np.ndarray:
        """Whether values (..., M) meet their requirements, (..., M)."""
        each: Iterable[np.ndarray] = (merit.passes(values[..., k]) for k, merit in enumerate(self.merits))
        return np.stack(list(each), axis=-1)
