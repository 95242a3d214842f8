"""One camera on which tolerances are tried: exact traces of many cameras at once, with their adjustments.

All wavefronts are those of the beams that the designed camera images at the merits' fields, traced through the same
points of the stop. What bodies and edges take of a beam is that of the designed camera, at its design wavelength, but
where it is itself the merit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.physical_error import PhysicalError, UnphysicalError
from optics.numerics.threads import one_blas_thread
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.line_of_sight import line_change, line_tangents
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.pupil_terms import products, to_terms
from optics.waves.wavefront import path_to_sphere
from scenes.models.camera_model import LAUNCH_DISTANCE, glass_steps, in_glass, lenses
from scenes.specs.tolerance import OF_MONITOR, ToleranceSetup
from scenes.yaml.errors import names_text, unknown
from twin.camera.camera_optics import CameraOptics
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import LINE_POINTS, line_points
from twin.targets.band_light import wavelengths_enough
from twin.tolerance.adjustments import Adjustments, told
from twin.tolerance.designed_light import Errors, LitRoots, fixed_transfers, light_of
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
FIRST_RULE, LARGEST_RULE = 3, 17
"""Wavelengths of the first and of the last rule over a spectrum."""
RESIDUAL = 1e-3
"""Rms of a wavefront that its polynomials may leave, waves."""
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
        paths: optical paths of the beams' rays less those of the chief rays, of all traced wavelengths, (S, F, K N),
            metres; None if not asked for.
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
        colours, shares: wavelengths of the light of the wavefronts and MTFs, metres, and their shares, (C,) each.

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
        self._moves_stop = self._adjusts_before_stop()
        self.colours, self.shares = np.array([self.wavelength]), np.ones(1)
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

    def _adjusts_before_stop(self) -> bool:
        """Whether adjustments change where light meets the stop, so that rays have to be aimed anew after them."""
        path = self.optics.path
        chain = [path.assembly.elements[name] for name in path.assembly.sequences[f"{path.name}/to_stop"]]
        bodies = {body for one in chain for body in (one.body, one.solid) if body is not None}
        moved = {body for number in self.compensators for body in number.moves}
        return any(body == own or body.startswith(f"{own}/") for body in bodies for own in moved)

    # what does not change from camera to camera

    @one_blas_thread()
    def _prepare(self) -> None:
        """Look at the designed camera in the light of the budget, by as many wavelengths as its merits take."""
        self.directions = self.optics.directions(self.fields)
        test, spectrum = self.setup.test, light_of(self.setup.test, self.optics.model.spec)
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
            raise test.error(f"merits over the light: {error}", ("light",), allowed="light: design") from error

    def _designed_values(self) -> np.ndarray:
        """Rms wavefront errors and MTFs of the designed camera in its light, as it stands."""
        squares = np.sum(self._residuals(self.designed[None]).reshape(len(self.fields), -1) ** 2, axis=-1)
        mtfs = [one.known for rows in self._transfers.values() for row in rows for one in row]
        return np.concatenate([np.sqrt(squares), mtfs])

    def _prepare_in(self, colours: np.ndarray, shares: np.ndarray) -> None:
        """Work out what does not change from camera to camera.

        Args:
            colours: wavelengths of the light, metres, (C,).
            shares: of them, which sum to 1, (C,).
        """
        path, model = self.optics.path, self.optics.model
        self.colours, self.shares = colours, shares
        # mirrors image all wavelengths alike: one is traced for all, and their light differs in the MTF alone
        traced = colours if lenses(model.spec) else np.array([self.wavelength])
        self.traced_shares = shares if len(traced) == len(colours) else np.ones(1)
        self._glass = [glass_steps(model.spec, path.root, float(colour)) for colour in traced]
        for rings, degree in GRIDS:
            self.nodes, self.degree = quadrature.disk(rings), degree
            self.points = np.concatenate([np.zeros((1, 2)), np.stack([self.nodes.x, self.nodes.y], axis=-1)])
            self._aim_nominal()
            self.radius = float(model.first_order.exit_pupil_distance[0])
            (position, direction, paths, valid), _ = self._rays([{}])
            if not valid.all():
                problem = "the beams of the fields are cut by what is not the stop and has no edges of its own"
                raise self.setup.test.error(problem, ("merits",), allowed="fields whose light comes through whole")
            self.designed = self._paths(position, direction, paths, self.radius)[0]
            self.designed_eikonals = self._paths(position, direction, paths, np.inf)[0]
            self.chief = self._chiefs(direction)[0]
            self.solve = to_terms(self.nodes, degree)
            own = self.designed.reshape(len(self.fields), len(traced), -1)
            rest = own - own @ self.solve.T @ products(self.nodes.x, self.nodes.y, degree).T
            self.residual = float(np.sqrt(np.max(rest**2 @ self.nodes.share))) / self.wavelength
            if self.residual <= RESIDUAL:
                break
        else:
            problem = f"wavefronts that polynomials do not follow: they leave {self.residual:.2g} waves"
            raise self.setup.test.error(problem, ("merits",), allowed="a sharper camera, or fields where it is")
        self._roots = LitRoots.of(path.shadows_on_stop({}, self.directions)[0], self.degree)
        cosines, light = direction[0, :, :, 1:, 1::-1], (colours, shares)
        self._transfers = fixed_transfers(
            self.optics, self.setup.test, self.merits, self.fields, light, cosines, self.degree
        )
        self._adjust = Adjustments(self.ranges, self.grid_steps, self.accuracies, self._adjustment_slope())

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
        systems = assemble(path.assembly, [f"{path.name}/to_stop"], self._coloured([{}])).take(self._owners(1))
        middle, slope = aim(self.backend, systems, self._fan_for(1), np.zeros((1, 2)))
        near = middle + np.einsum("fnij,nj->fni", np.linalg.inv(slope), self._target)
        slopes = np.broadcast_to(slope, (*near.shape, 2))
        self._aimed = aim(self.backend, systems, self._fan_for(1), self._target, near, slopes, AIM_TOLERANCE)

    def _adjustment_slope(self) -> np.ndarray:
        """Derivatives of the residuals by the compensators, (R, C), waves per SI unit; 0 where the range is zero."""
        used = np.flatnonzero(self.ranges)
        slope = np.zeros((self._residuals(self.designed[None]).shape[1], len(self.ranges)))
        if not used.size:
            return slope
        step = _MOVE * self.ranges[used]
        amounts = np.zeros((2 * len(used), len(self.ranges)))
        amounts[np.arange(len(used)), used] = step
        amounts[len(used) + np.arange(len(used)), used] = -step
        residuals = self._residuals(self._errors(states_of(self.compensators, amounts)).paths)
        ahead, behind = residuals[: len(used)], residuals[len(used) :]
        slope[:, used] = ((ahead - behind) / (2.0 * step[:, None])).T
        return slope

    # exact traces

    def _aimed_at_stop(self, states: Sequence[State], placed: PlacedBodies) -> np.ndarray:
        """Where rays start that meet their points of the stop in coloured states, (S * K * F, N, 3).

        Raises:
            AimError: the light of some state does not reach the stop.
        """
        path, count = self.optics.path, len(states) // len(self._glass)
        to_stop = assemble(path.assembly, [f"{path.name}/to_stop"], states, placed=placed)
        near, slope = (np.tile(one, (count, *[1] * (one.ndim - 1))) for one in self._aimed)
        systems, fan = to_stop.take(self._owners(count)), self._fan_for(count)
        return fan.at(aim(self.backend, systems, fan, self._target, near, slope, AIM_TOLERANCE)[0])[0]

    def _rays(
        self, states: Sequence[State], aimed: np.ndarray | None = None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Position and direction (S, K, F, N, 3), path and validity (S, K, F, N) of the beams at the line CCD, in light
        of K traced wavelengths, and where their rays start, (S, K, F, N, 3), which is found where it is not given.

        Raises:
            AimError: the light of some state does not reach the stop.
        """
        path, count = self.optics.path, len(states)
        coloured = self._coloured(states)
        placed = path.assembly.place(coloured)
        aimed = self._aimed_at_stop(coloured, placed) if aimed is None else aimed
        imaging = assemble(path.assembly, [f"{path.name}/imaging"], coloured, placed=placed).take(self._owners(count))
        along = np.tile(self.directions[:, None], (count * len(self._glass), 1, 1))
        rays = make_rays(self.backend, aimed.reshape(len(along), -1, 3), along)
        traced = trace(self.backend, imaging, rays).numpy()
        shape = (count, len(self._glass), len(self.fields), len(self.points))
        told = tuple(one.reshape(*shape, *one.shape[2:]) for one in traced)
        return told, aimed.reshape(*shape, 3)  # type: ignore[return-value]

    def _coloured(self, states: Sequence[State]) -> list[State]:
        """The states as each traced wavelength meets them, camera by camera, S * K."""
        return [in_glass(state, steps) for state in states for steps in self._glass]

    def _owners(self, count: int) -> np.ndarray:
        """Number of the coloured state of each beam of so many cameras, (S * K * F,)."""
        return np.repeat(np.arange(count * len(self._glass)), len(self.fields))

    def _fan_for(self, count: int) -> RayFan:
        """The fan of all beams of so many cameras."""
        times = count * len(self._glass)

        def every(array: np.ndarray) -> np.ndarray:
            return np.tile(array, (times, *[1] * (array.ndim - 1)))

        return RayFan(every(self._fan.position), every(self._fan.direction), every(self._fan.axes), True)

    def _paths(self, position: np.ndarray, direction: np.ndarray, paths: np.ndarray, radius: float) -> np.ndarray:
        """Optical paths to the spheres of a radius about the images of the chief rays, of all wavelengths about the
        mean of these, less those of the chief rays, (S, F, K (N - 1)).
        """
        middle = np.einsum("k,skfx->sfx", self.traced_shares, position[:, :, :, 0])
        to_sphere = path_to_sphere(position, direction, paths, middle[:, None, :, None], radius)
        longer = to_sphere[..., 1:] - to_sphere[..., :1]
        return np.asarray(np.moveaxis(longer, 1, 2).reshape(len(paths), len(self.fields), -1))

    def _chiefs(self, direction: np.ndarray) -> np.ndarray:
        """Chief rays' directions, their mean over the light, (S, F, 3)."""
        return np.asarray(np.einsum("k,skfx->sfx", self.traced_shares, direction[:, :, :, 0]))

    @one_blas_thread()
    def _errors(self, states: Sequence[State], aimed: np.ndarray | None = None) -> Errors:
        """What the light of states comes to at the line CCD.

        Args:
            states: S of them.
            aimed: where their rays start, as of ``Errors``; None to aim them.

        Raises:
            PhysicalError: the light of some state is lost.
        """
        found, step = [], max(1, AT_ONCE // len(self._glass))
        for start in range(0, len(states), step):
            some = slice(start, start + step)
            traced, own = self._rays(states[some], None if aimed is None else aimed[some])
            position, direction, path, valid = traced
            if not valid.all():
                raise UnphysicalError("a surface's edge stops light of a field")
            paths = self._paths(position, direction, path, self.radius)
            plane = "mtf" in self._wanted and np.isfinite(self.radius)
            eikonals = self._paths(position, direction, path, np.inf) if plane else paths
            found.append(Errors(paths, eikonals, self._chiefs(direction), own))
        return Errors(*(np.concatenate(own) for own in zip(*found, strict=True)))

    def _residuals(self, paths: np.ndarray) -> np.ndarray:
        """Residuals (S, R) whose squares sum to the mean squares of the wavefronts over all fields and over the light,
        waves of the design wavelength.
        """
        terms = paths.reshape(len(paths), len(self.fields), len(self.traced_shares), -1) @ self.solve.T
        return self._roots.residuals(terms / self.wavelength, self.traced_shares)

    # adjustments

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
                paths = np.full((1, *self.designed.shape), np.nan) if len(self.fields) else None
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

        def state(moves: np.ndarray, which: np.ndarray | slice = slice(None)) -> list[State]:
            own = np.concatenate([amounts[which], moves[which]], axis=1)
            return states_of((*self.numbers, *self.compensators), own)

        if not len(self.fields):
            return Tried(moves, self._parts(state(moves), amounts, moves, None), ("",) * count, settled)
        states = state(moves)
        light = self._errors(states)

        def again(own: Sequence[State], which: np.ndarray) -> Errors:
            """Those of cameras that were adjusted, whose rays start where they did if no adjustment aims them anew."""
            return self._errors(own, None if self._moves_stop else light.aimed[which])

        if np.any(self.ranges > 0.0):
            every = np.ones(len(self.ranges), dtype=bool)
            residuals = self._residuals(light.paths)
            slopes = np.tile(self._adjust.slope, (count, 1, 1))
            for _ in range(MOST_STEPS):
                target = self._adjust.best(slopes, residuals, moves, every)
                expected = told(slopes, target - moves)
                settled = np.sqrt(np.sum(expected**2, axis=1) / len(self.fields))
                # what has settled stays, so that a camera's numbers do not depend on the others
                going = settled > SETTLED * 1e-2
                if not going.any():
                    break
                some = np.flatnonzero(going)
                change, moves = target[some] - moves[some], np.where(going[:, None], target, moves)
                own = state(moves, some)
                for k, one in zip(some, own, strict=True):
                    states[k] = one
                anew = again(own, some)
                for known, new in zip(light[:3], anew[:3], strict=True):
                    known[some] = new
                arrived = self._residuals(anew.paths)
                miss = arrived - residuals[some] - expected[some]
                slopes[some], residuals[some] = self._adjust.corrected(slopes[some], change, miss), arrived
            if errors is not None and not self._adjust.exact:
                moves = self._adjust.made(slopes, residuals, moves, errors)
                states = state(moves)
                light = again(states, np.arange(count))
        return Tried(moves, self._parts(states, amounts, moves, light), ("",) * count, settled, light.paths)

    # merits

    def parts_of(self, states: Sequence[State]) -> np.ndarray:
        """Parts of all merits (S, P) of cameras in any states, as they are. Raises PhysicalError: the light is lost."""
        return self._parts(states, *self._still(states), self._errors(states) if len(self.fields) else None)

    def _still(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray]:
        """Amounts and moves of the bench's own numbers in states that say all themselves: none."""
        return np.zeros((len(states), len(self.numbers))), np.zeros((len(states), len(self.ranges)))

    def numbers_of(self, states: Sequence[State]) -> np.ndarray:
        """Numbers (S, R) of cameras whose squares sum to their merits' mean squares over fields or points, each in
        units of its requirement; an MTF counts as the wavefront at its fields, a quarter of the wavelength rms as one.

        They change linearly with small motions. Raises PhysicalError: the light is lost.
        """
        count = len(states)
        light = self._errors(states) if len(self.fields) else None
        terms = None if light is None else self._residuals(light.paths).reshape(count, len(self.fields), -1)
        parts = self._parts(states, *self._still(states), light)
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
            slopes: of the optical paths by the numbers, metres, (L, F, K N).
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
        self, states: Sequence[State], amounts: np.ndarray, moves: np.ndarray, light: Errors | None
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
        if light is not None and "wavefront" in self._wanted:
            terms = self._residuals(light.paths).reshape(len(states), len(self.fields), -1)
            squares = np.sum(terms**2, axis=-1)
        line = self._line(states)
        for k, merit in enumerate(self.merits):
            kind = merit.spec.kind
            if kind == "wavefront":
                assert squares is not None
                own = squares[:, merit.fields]
            elif kind == "mtf":
                assert light is not None
                own = self._modulations(k, merit, light.eikonals)
            elif kind == "chief_ray":
                assert light is not None
                turn = light.chiefs[:, merit.fields, :2] - self.chief[merit.fields, :2]
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

    def _modulations(self, k: int, merit: Merit, eikonals: np.ndarray) -> np.ndarray:
        longer = eikonals - self.designed_eikonals
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
