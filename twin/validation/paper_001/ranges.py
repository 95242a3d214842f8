"""Ranges of validity of the formulas of paper 001 (Wang et al. 2018).

The errors of estimates from noise-free images are computed for increasing single and joint changes, under defocus, and
for other pupil offsets, fields and kinds of return reflector, up to where they exceed a tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import monitor_formulas
from analysis.monitor.monitor_formulas import PER_SI, MonitorGeometry
from analysis.monitor.recovery import measure_spots
from optics.geometry import zernike
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.numerics.backend import Backend, cores
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE
from scenes.specs.resolved import ResolvedJob
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import ObservationOptions, observe, shared_detector
from twin.monitor.truth import ElementaryMotion, line_family
from twin.validation.group import load_printed
from twin.validation.paper_001.formulas import PARAMETERS as NAMES
from twin.validation.paper_001.formulas import focal_lengths

PRINTED, JOINT, CORRECTED, CALIBRATED = "printed", "Table 1", "corrected", "calibrated"
FORMS = (PRINTED, JOINT, CORRECTED, CALIBRATED)
"""Names of the four sets of formulas that are compared.

They are eqs. (2), (3), (5), (7) with the arctangent; Table 1's joint forms; the joint forms corrected: with f_x for
d_alpha, half of d_gamma times f/f_x, no cos^2, and (7) for d_f; and the corrected forms with the two calibrated
gradients over the field as well. f and f_x are the focal lengths along and across the line.
"""
SHARE = 24
"""Number of images of 96 x 96 pixels that are rendered at once, to limit memory."""
ROUNDS, NEAR = 3, 1e-3
"""Refinement of the crossings of an error curve with its limit.

The first is the largest number of refinement steps; the second the relative distance in size within which an existing
point makes another one unnecessary.
"""

Sample = Callable[[np.ndarray], Mapping[str, np.ndarray]]
"""Function from N sizes of a change, (N,), to name -> (N,) errors divided by the allowed error.

The values are not negative; at 1 the limit is reached.
"""


class Bench:
    """Spot positions, estimates and true changes of one instrument's monitor, without noise.

    Parameters
    ----------
    experiment
        Monitoring experiment with the instrument.
    like
        Another bench with the same cameras, whose geometry is used.
    shapes
        True to use the spot shapes of ``like`` as well; needed for larger CCDs, of which only a window around each spot
        is read out, as large as the CCDs of ``like``.
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
        """Return a camera's geometry for the formulas of paper 001 (Wang et al. 2018).

        It contains principal distance, field angles and distances.
        """
        if camera not in self._geometry:
            self._geometry[camera] = self.experiment.geometry(camera)
        return self._geometry[camera]

    def positions(self, states: Sequence[State]) -> np.ndarray:
        """Return the spot centres in rendered images of S states and C channels, (S, C, 2) (row, column), in pixels.

        Raises
        ------
        SpotError, BeamMissedError
            A spot is too near its CCD's edge or outside it, or its beam is lost.
        """
        path = self.experiment.path
        rows, columns = path.shape
        chunk = max(1, SHARE * 96 * 96 // (rows * columns))
        out = np.empty((len(states), len(path.channels), 2))
        calibration = self._measure.calibration
        for piece, photons in path.iterate_photons(states, chunk=chunk):
            mean = self.experiment.expected_frames(photons).reshape(-1, rows, columns)
            windows, corner = _windows(mean, self._measure.path.shape)
            spots = measure_spots(windows, self.frames, calibration, "ml", cores())
            position = np.stack([spots.row, spots.column], axis=-1) + corner
            out[piece] = position.reshape(-1, len(path.channels), 2)
        return out

    def traced(self, states: Sequence[State]) -> np.ndarray:
        """Return the mean of each spot's traced rays, also for spots outside the CCD.

        The positions are (S, C, 2) (row, column) for S states and C channels, in pixels from the CCD's middle.

        Raises
        ------
        BeamMissedError, AimError
            A beam is lost, or a part of it.
        """
        path = self.experiment.path
        known, scout = path.coarse_trace(states), path.scout
        basis = zernike.basis(known.aim_change.shape[-1], scout.nodes.x, scout.nodes.y)
        start = np.repeat(scout.nominal.parameters, len(states), axis=0)
        launch = known.fan.at(start + np.moveaxis(known.aim_change @ basis.T, 0, -1))
        rays = trace(self.experiment.backend, known.back, make_rays(self.experiment.backend, *launch)).numpy()
        if not rays[3].all():
            raise BeamMissedError("a clear aperture cuts a monitor beam")
        return np.moveaxis(known.centre, 0, 1)

    def readings(self, start: np.ndarray, end: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """Return the estimated changes in S states, (S, 4), in arcsec and um, by camera and set of formulas.

        The estimates of the four parameters are computed from spot positions before and after the change, (S, C, 2) for
        C channels.
        """
        start = np.broadcast_to(start, end.shape)
        nothing = np.zeros((4, 4))
        out = {}
        for k, name in enumerate(self.cameras):
            pair = slice(2 * k, 2 * k + 2)
            before, after, geometry = start[:, pair], end[:, pair], self.geometry(name)
            # without the calibrated gradients over the field
            bare = replace(geometry, d_f_per_alpha_m=0.0, d_gamma_per_beta=0.0)
            readings = {
                PRINTED: monitor_formulas.paper_single(before, after, nothing, geometry),
                JOINT: monitor_formulas.paper_joint(before, after, nothing, geometry),
                CORRECTED: monitor_formulas.derived(before, after, nothing, bare),
                CALIBRATED: monitor_formulas.derived(before, after, nothing, geometry),
            }
            out[name] = {form: parameters.vector * PER_SI for form, parameters in readings.items()}
        return out

    def truth(self, states: Sequence[State]) -> dict[str, np.ndarray]:
        """Return the traced changes of each camera's four parameters in S states, (S, 4), in arcsec and um."""
        changes = self.experiment.sight.truth(states)
        return {
            name: np.stack([c.d_alpha, c.d_beta, c.d_gamma, c.d_f], axis=-1) * PER_SI
            for name, c in changes.cameras.items()
        }


def _windows(images: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return windows around the brightest pixel of each of B images, (B, H, W), and their offsets from the middle.

    The offsets are (B, 2), in pixels.
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
    """Errors as functions of the size of a change.

    Attributes
    ----------
    size : np.ndarray
        The N sizes, (N,), ascending, > 0.
    value : Mapping[str, np.ndarray]
        Name -> (N,) errors divided by the allowed error.
    """

    size: np.ndarray
    value: Mapping[str, np.ndarray]

    def bracket(self, name: str) -> int | None:
        """Return the index of the first size at which the limit is exceeded, None if it never is.

        The limit is a value of 1.
        """
        beyond = np.flatnonzero(self.value[name] > 1.0)
        return int(beyond[0]) if len(beyond) else None

    def crossing(self, name: str) -> float | None:
        """Return the size at which the limit (a value of 1) is first exceeded, interpolated on logarithmic axes.

        It is None if the limit is never exceeded, 0 if it is exceeded at the smallest size already.
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
        """Return the error curves with further points added, sorted by the size of the change."""
        sizes = np.concatenate([self.size, size])
        order = np.argsort(sizes)
        return Curves(sizes[order], {n: np.concatenate([v, value[n]])[order] for n, v in self.value.items()})


@dataclass(frozen=True, eq=False)
class Domain:
    """Range of sizes of a change over which formulas are valid, from images and, for larger sizes, from ray traces.

    The traces go on until the beam is lost.

    Attributes
    ----------
    images, traced : Curves
        Errors over the size; both have the same names.
    lost : float
        Size beyond which the beam is lost or not followed.
    lost_why : str
        Which of these two applies.
    """

    images: Curves
    traced: Curves
    lost: float
    lost_why: str

    def limit(self, name: str) -> tuple[float, str]:
        """Return the largest size with an error within its limit, and the source of this size as text.

        The source is "images", "trace", or the reason why there is no limit.
        """
        for curves, whence in ((self.images, "images"), (self.traced, "trace")):
            crossing = curves.crossing(name)
            if crossing is not None:
                return crossing, whence
        return self.lost, self.lost_why


def sampled(sample: Sample, sizes: Sequence[float], names: Sequence[str] | None = None) -> Curves:
    """Evaluate error curves at given sizes of a change, and add points where they cross the limit.

    Parameters
    ----------
    sample : Sample
        Function that computes the errors.
    sizes : sequence of float
        Initial sizes, ascending.
    names : sequence of str or None
        Curves whose limits are refined; all by default.
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


EQUATIONS = {"d_alpha": "(3)", "d_beta": "(2)", "d_gamma": "(5)", "d_f": "(7)"}
UNITS = {"d_alpha": "arcsec", "d_beta": "arcsec", "d_gamma": "arcsec", "d_f": "um"}
_TABLE = load_printed("001")
CLAIMED = {
    "d_alpha": 0.1,
    "d_beta": 0.1,
    "d_gamma": _TABLE.number("table5.d_gamma_arcsec"),
    "d_f": 1e3 * _TABLE.number("table5.d_f_mm"),
}
"""Parameter -> error that section 3.3 and Table 5 of the paper claim, in arcsec and um."""
FINE = {"d_alpha": 0.1, "d_beta": 0.1, "d_gamma": 0.1, "d_f": 40.0}
"""Parameter -> tighter tolerance: 0.1 arcsec for all angles, and Table 5's 0.04 mm for d_f."""
RELATIVE = 0.01
WINDOW, VIGNETTED = "leaves the area CCD", "an aperture cuts the beam"
EDGE_PX = 11.0
"""Smallest allowed distance of a spot from the outermost pixel centres, pixels.

Half a pixel nearer, the fit's template ends on one side; one pixel nearer, the centroid refuses the spot.
"""
WIDE_PX = 384
"""Rows and columns of the larger CCD with which errors are followed beyond the edge of the instrument's own CCD."""
_START = {"d_alpha": 0.02, "d_beta": 0.02, "d_gamma": 0.02, "d_f": 8.0}
_FAR = {"d_alpha": 3600.0, "d_beta": 3600.0, "d_gamma": 36000.0, "d_f": 600e3}
"""Parameter -> largest change that the ray trace is extended to, in arcsec and um."""
_WIDE_SHARE = 0.76
_Raw = dict[str, list[np.ndarray]]
KINDS = ("1 %", "fine", "claimed")
BOX = np.array([4.0, 4.0, 24.0, 950.0])
"""Half widths in d_alpha, d_beta, d_gamma (arcsec) and d_f (um) of the box of joint changes.

With all at once, the spots just stay on the area CCD.
"""
BOX_TEXT = f"±({BOX[0]:g}″, {BOX[1]:g}″, {BOX[2]:g}″, {1e-3 * BOX[3]:g} mm)"
CORNERS = np.array(list(product((-1.0, 1.0), repeat=4)))
_FAR_BOX = 200.0


@dataclass(frozen=True, eq=False)
class Range(Domain):
    """Range of validity of the formulas for one parameter changed in one direction.

    The size of a change is its true value in arcsec (angles) or um (principal distance). There is an error curve for
    each set of formulas and kind of limit (``criterion``), and one for the distance of the spots from the edge of the
    area CCD (WINDOW).

    Attributes
    ----------
    parameter : str
        One of NAMES.
    sign : int
        Sign of the change, +1 or -1.
    raw : mapping of str to ndarray
        Set of formulas -> N pairs of true change and error from images, (N, 2), for the figure.
    raw_traced : mapping of str to ndarray
        Pairs of true change and error from the ray trace, as ``raw``.
    trace_gap : float
        Largest difference of a traced spot shift from the rendered one, in pixels.
    """

    parameter: str
    sign: int
    raw: Mapping[str, np.ndarray]
    raw_traced: Mapping[str, np.ndarray]
    trace_gap: float

    @property
    def window(self) -> float:
        """True change at which the first spot comes too near the area CCD's edge, in arcsec or um."""
        return self.limit(WINDOW)[0]


def criterion(form: str, kind: str) -> str:
    """Return the name of the error curve of a set of formulas for one kind of limit: "1 %", "0.1" or "claimed".

    The error is divided by that limit.
    """
    return f"{form} {kind}"


def motion_of(camera: str, parameter: str, geometry: MonitorGeometry) -> tuple[ElementaryMotion, float]:
    """Return the motion that changes one parameter alone, and its amount (SI units) per arcsec or um of change."""
    k = NAMES.index(parameter)
    f, f_x = focal_lengths(geometry)
    amount = (-f_x * ARCSEC, f * ARCSEC, ARCSEC * f_x / f, 1e-6 / f)[k]
    return line_family(camera)[k], amount


def single_range(bench: Bench, wide: Bench, parameter: str, sign: int, count: int) -> Range:
    """Compute errors for increasing changes of one parameter in one direction, up to where the beam is lost.

    Parameters
    ----------
    bench : Bench
        Bench with the instrument's own area CCDs, for the edge of the CCD.
    wide : Bench
        Bench with larger CCDs and the same camera.
    parameter : str
        One of NAMES.
    sign : int
        Sign of the change.
    count : int
        Number of initial sizes.
    """
    camera = bench.cameras[0]
    geometry = bench.geometry(camera)
    motion, unit = motion_of(camera, parameter, geometry)
    k = NAMES.index(parameter)
    half = 0.5 * (min(bench.experiment.path.shape) - 1) - EDGE_PX
    far = 0.5 * _WIDE_SHARE * WIDE_PX

    def states(size: np.ndarray) -> list[State]:
        return [motion.state(sign * unit * x) for x in size]

    origin = bench.positions([{}])
    traced_origin = bench.traced([{}])
    middle = 0.5 * (np.array(bench.experiment.path.shape) - 1)
    raw: _Raw = {form: [] for form in FORMS}
    gap = [0.0]
    truths: dict[float, float] = {}

    def shares(size: np.ndarray, start: np.ndarray, end: np.ndarray, into: _Raw) -> Mapping[str, np.ndarray]:
        truth = bench.truth(states(size))[camera][:, k]
        truths.update(zip(size.tolist(), np.abs(truth).tolist(), strict=True))
        readings = bench.readings(start, end)[camera]
        out = {WINDOW: np.max(np.abs(end - start + origin - middle), axis=(1, 2)) / half}
        for form in FORMS:
            error = readings[form][:, k] - truth
            into[form].append(np.stack([np.abs(truth), error], axis=-1))
            allowed = (RELATIVE * np.abs(truth), FINE[parameter], CLAIMED[parameter])
            for kind, limit in zip(KINDS, allowed, strict=True):
                out[criterion(form, kind)] = np.abs(error) / limit
        return out

    def rendered(size: np.ndarray) -> Mapping[str, np.ndarray]:
        all_states = states(size)
        position = wide.positions(all_states)
        moved = bench.traced(all_states) - traced_origin
        gap[0] = max(gap[0], float(np.max(np.abs(position - origin - moved))))
        return shares(size, origin, position, raw)

    begin = _START[parameter]
    end, why = beam_end(bench, states, begin, _FAR[parameter])
    # the shift is proportional but for a few parts in a thousand
    shift = float(np.max(np.abs(bench.traced(states(np.array([begin]))) - traced_origin)))
    largest = min(begin * far / shift, 0.9 * end)
    images = sampled(rendered, np.geomspace(begin, largest, count).tolist())
    raw_traced: _Raw = {form: [] for form in FORMS}
    traced = sampled(
        lambda size: shares(size, traced_origin, bench.traced(states(size)), raw_traced),
        np.geomspace(largest, end, 12).tolist(),
    )

    def over_truth(curves: Curves) -> Curves:
        return Curves(np.array([truths[x] for x in curves.size.tolist()]), curves.value)

    lost = truths[float(traced.size[-1])]
    return Range(
        over_truth(images), over_truth(traced), lost, why, parameter, sign, _joined(raw), _joined(raw_traced), gap[0]
    )


def _joined(parts: Mapping[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    """Return N pairs of true change and error, (N, 2), of each set of formulas, in ascending order of the change."""
    out = {}
    for form, pieces in parts.items():
        joined = np.concatenate(pieces)
        out[form] = joined[np.argsort(joined[:, 0])]
    return out


def beam_end(bench: Bench, states: Callable[[np.ndarray], list[State]], start: float, far: float) -> tuple[float, str]:
    """Return the largest size of a change at which no part of a beam is lost, to 1 %, and the reason of the limit.

    The size is searched between ``start`` and ``far``.
    """

    def fault(size: float) -> str:
        try:
            trial_states = states(np.array([size]))
            bench.traced(trial_states)
        except BeamMissedError:
            return VIGNETTED
        except (AimError, np.linalg.LinAlgError):
            return "no ray is found"
        return ""

    good, bad, why = start, far, fault(far)
    if not why:
        return far, "not followed farther"
    while bad / good > 1.01:
        middle = math.sqrt(good * bad)
        reason = fault(middle)
        good, bad, why = (good, middle, reason) if reason else (middle, bad, why)
    return good, why


def joint_states(bench: Bench, changes: Mapping[str, np.ndarray]) -> list[State]:
    """Return S states in which every camera has given changes, (S, 4), in arcsec and um, to the motions' accuracy."""
    states: list[dict[str, Motion]] = [{} for _ in next(iter(changes.values()))]
    for camera, wanted in changes.items():
        units = [motion_of(camera, name, bench.geometry(camera))[1] for name in NAMES]
        for state, (x, y, rotation, scale) in zip(states, wanted * np.array(units), strict=True):
            state[f"{BASE}/{camera}/focal_plane"] = Motion(rotate=(0.0, 0.0, rotation), shift=(x, y, 0.0))
            state[f"{BASE}/{camera}"] = Motion(scale=scale)
    return list(states)


@dataclass(frozen=True, eq=False)
class Corners(Domain):
    """Largest errors at the 16 corners of the box of joint changes, for boxes of increasing size.

    The size is a fraction of the full box. The names of the curves consist of set of formulas and parameter; the values
    are the largest error of all corners and cameras divided by the error that the paper claims.
    """

    def text(self, name: str) -> str:
        """Return the size of the box at which an error reaches its limit, as a fraction of the full box, as text."""
        share, whence = self.limit(name)
        return f"{share:.3g}" + (" (beam cut)" if whence == self.lost_why else "")


def key(form: str, parameter: str, fine: bool = False) -> str:
    """Return the name of the error curve of a set of formulas and a parameter.

    The error is divided by what Table 5 claims or, if ``fine``, by 0.1 arcsec or 0.04 mm.
    """
    return f"{form} {parameter}{' fine' if fine else ''}"


def corners(bench: Bench, count: int) -> Corners:
    """Compute the errors at the corners of boxes, from a thousandth of the full size until beams are vignetted."""
    origin, traced_origin = bench.positions([{}]), bench.traced([{}])

    def states(share: np.ndarray) -> list[State]:
        wanted = (share[:, None, None] * CORNERS * BOX).reshape(-1, 4)
        return joint_states(bench, dict.fromkeys(bench.cameras, wanted))

    def worst(share: np.ndarray, start: np.ndarray, end: np.ndarray) -> dict[str, np.ndarray]:
        truth, readings = bench.truth(states(share)), bench.readings(start, end)
        out = {}
        for form in FORMS:
            error = np.max([np.abs(readings[c][form] - truth[c]) for c in bench.cameras], axis=0)
            error = error.reshape(len(share), len(CORNERS), 4).max(axis=1)
            for k, name in enumerate(NAMES):
                out[key(form, name)] = error[:, k] / CLAIMED[name]
                out[key(form, name, fine=True)] = error[:, k] / FINE[name]
        return out

    images = sampled(
        lambda share: worst(share, origin, bench.positions(states(share))), np.geomspace(0.002, 1.0, count).tolist()
    )
    end, why = beam_end(bench, states, 1.05, _FAR_BOX)
    traced = sampled(
        lambda share: worst(share, traced_origin, bench.traced(states(share))), np.geomspace(1.0, end, 6).tolist()
    )
    return Corners(images, traced, end, why)


@dataclass(frozen=True, eq=False)
class Separation:
    """Regression of the estimates on the true changes over many random joint changes.

    Attributes
    ----------
    gain : Mapping[str, Mapping[str, np.ndarray]]
        Set of formulas -> camera -> (4, 4) matrix: estimate of the first parameter per unit of true change of the
        second.
    sigma : Mapping[str, Mapping[str, np.ndarray]]
        Standard deviations of ``gain``.
    scatter : Mapping[str, np.ndarray]
        Set of formulas -> (4,) rms residual of the regression over all cameras, in arcsec and um.
    trials : int
        Number of states.
    """

    gain: Mapping[str, Mapping[str, np.ndarray]]
    sigma: Mapping[str, Mapping[str, np.ndarray]]
    scatter: Mapping[str, np.ndarray]
    trials: int

    def mean(self, form: str, read: str, changed: str) -> tuple[float, float]:
        """Return the change of one estimated parameter per unit of true change of another, and its sigma.

        It is the regression coefficient for a set of formulas, averaged over the cameras.
        """
        p, q = NAMES.index(read), NAMES.index(changed)
        values = [self.gain[form][c][p, q] for c in self.gain[form]]
        sigmas = [self.sigma[form][c][p, q] for c in self.sigma[form]]
        return float(np.mean(values)), float(np.sqrt(np.sum(np.square(sigmas))) / len(sigmas))


def separation(experiment: MonitorExperiment, bench: Bench, trials: int, seed: int) -> Separation:
    """Regress estimates from noisy frames on random changes of all four parameters, uniform in the box.

    Both cameras change.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1001,)))
    wanted = {c: rng.uniform(-1.0, 1.0, (trials, 4)) * BOX for c in bench.cameras}
    states = joint_states(bench, wanted)
    truth = bench.truth(states)
    how = ObservationOptions(shared_detector(experiment, bench.frames, seed), use_prior=False)
    seen = [observation.recovery for observation in observe(experiment, states, how)]
    parts = [bench.readings(observation.before, observation.after) for observation in seen]
    readings = {c: {form: np.concatenate([part[c][form] for part in parts]) for form in FORMS} for c in bench.cameras}
    gain: dict[str, dict[str, np.ndarray]] = {form: {} for form in FORMS}
    sigma: dict[str, dict[str, np.ndarray]] = {form: {} for form in FORMS}
    scatter = {}
    for form in FORMS:
        rests = []
        for camera in bench.cameras:
            # the constant takes up the noise of the one nominal measurement
            design = np.column_stack([truth[camera], np.ones(trials)])
            solved, *_ = np.linalg.lstsq(design, readings[camera][form], rcond=None)
            rest = readings[camera][form] - design @ solved
            rests.append(rest)
            variance = np.sum(rest**2, axis=0) / (trials - design.shape[1])
            spread = np.diag(np.linalg.inv(design.T @ design))
            gain[form][camera] = solved[:4].T
            sigma[form][camera] = np.sqrt(variance[:, None] * spread[None, :4])
        scatter[form] = np.sqrt(np.mean(np.concatenate(rests) ** 2, axis=0))
    return Separation(gain, sigma, scatter, trials)


RETURNS: Mapping[str, tuple[tuple[float, float] | None, str]] = {
    "plane": (None, "as built"),
    "roof": (None, "as built; the ridge lies across the line"),
    "roof along": ((0.0, 3e-3), "the ridge lies along the line; the area CCD is beside its pinhole along the line"),
    "corner": ((0.0, 0.0), "the spot falls on its own pinhole: the area CCD must see it through a beam splitter"),
}
"""Kind of return reflector -> position of the area CCD for it, and a remark.

The kinds are a mirror facet; a roof whose ridge lies across the line, or along it; a corner cube. The position is
relative to the pinhole, in metres; None if the one in the instrument's file can be used.
"""
SHIFT = 60e-6
"""Shift of the line CCD for the comparison of return reflectors, metres."""
CONFOCAL = load_printed("004").number("alignment.confocal_mm") / 1e3
"""Accuracy with which paper 004 (Li et al. 2020) sets the line CCD to the focus, metres."""
SMALL = {"d_alpha": 2.0, "d_beta": 2.0, "d_gamma": 40.0, "d_f": 1500.0}
"""Parameter -> single change for the comparison of defocused cameras and other fields, in arcsec and um.

The spots move by a third of the area CCD.
"""


def variant(
    resolved: ResolvedJob,
    backend: Backend,
    camera: str,
    pixels: int | None = None,
    pupil_offset: tuple[float, float] | None = None,
    field: float | None = None,
    ccd_offset: tuple[float, float] | None = None,
) -> MonitorExperiment:
    """Return a new experiment with one camera of an instrument, in which the given properties are changed.

    Parameters
    ----------
    resolved : ResolvedJob
        Instrument as specified in its file.
    backend : Backend
        Backend of the ray trace.
    camera : str
        Camera that remains.
    pixels : int or None
        Rows and columns of the area CCDs.
    pupil_offset : (float, float) or None
        Centre (X, Y) of the monitor's sub-aperture in the entrance pupil, metres.
    field : float or None
        Field angle of the area CCDs, radians.
    ccd_offset : (float, float) or None
        Vector (X, Y) from the pinhole to the area CCD's centre, metres.

    Raises
    ------
    InputError
        The prisms cannot be placed in this way.
    """
    spec = resolved.instrument
    site = spec.cameras[camera]
    if pupil_offset is not None:
        site = site.model_copy(update={"pupil_offset": pupil_offset})
    of_ccd: dict[str, Any] = {} if pixels is None else {"rows": pixels, "columns": pixels}
    if ccd_offset is not None:
        of_ccd["offset"] = ccd_offset
    of_monitor: dict[str, Any] = {"area_ccd": spec.autocollimator.area_ccd.model_copy(update=of_ccd)}
    if field is not None:
        of_monitor["field"] = field
    changed = {
        "cameras": FrozenMap({camera: site}),
        "monitor": spec.autocollimator.model_copy(update=of_monitor),
        "baffles": FrozenMap({}),
    }
    return MonitorExperiment(resolved.model_copy(update={"instrument": spec.model_copy(update=changed)}), backend)


def with_return(experiment: MonitorExperiment, kind: str) -> MonitorExperiment:
    """Return the experiment with a return reflector of another kind.

    The facet becomes an opening of the same size, behind which two or three mutually perpendicular mirrors meet in its
    middle. Rays meet them in one order; the other orders give the same ray, because rotations by 180 deg commute here.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the plane return facet.
    kind : str
        One of RETURNS.

    Raises
    ------
    ValueError
        The kind is not one of RETURNS.
    """
    if kind not in RETURNS:
        raise ValueError(f"no return {kind!r}; there are {', '.join(RETURNS)}")
    if kind == "plane":
        return experiment
    instrument = experiment.instrument
    return experiment.with_instrument(replace(instrument, assembly=_returning(instrument, kind)))


def _returning(instrument: Instrument, kind: str) -> Assembly:
    """Return the instrument's assembly with mutually perpendicular mirrors behind the opening of every return facet."""
    old = instrument.assembly
    bodies, elements, sequences = list(old.tree.bodies), dict(old.elements), dict(old.sequences)
    for channel in instrument.channels:
        name = f"{channel.key}/return_face"
        elements[name] = replace(old.elements[name], interaction=Interaction.PASS)
        added = []
        for k, pose in enumerate(_mirrors(kind)):
            body, mirror = Body(f"{channel.face_body}/mirror_{k}", pose), f"{name}/mirror_{k}"
            bodies.append(body)
            elements[mirror] = Element(mirror, body.path, plane(), Interaction.REFLECT)
            added.append(mirror)
        path = old.sequences[f"{channel.key}/monitor"]
        at = path.index(name)
        sequences[f"{channel.key}/monitor"] = (*path[: at + 1], *added, *path[at + 1 :])
    return Assembly(RigidTree(tuple(bodies)), elements, sequences, old.media)


def _mirrors(kind: str) -> list[Pose]:
    """Return the poses of the mirrors in the facet's frame (x along the line, y across it, z to the light)."""
    if kind.startswith("roof"):
        ridge = 1 if kind == "roof" else 0
        return [Pose(about_axis(ridge, side * math.pi / 4)) for side in (1.0, -1.0)]
    lean = math.acos(1.0 / math.sqrt(3.0))  # of a cube's faces to its diagonal
    return [Pose(about_axis(2, 2.0 * math.pi * k / 3.0) @ about_axis(0, lean)) for k in range(3)]


@dataclass(frozen=True, eq=False)
class Response:
    """Response of the spots to motions of the line CCD with one kind of return reflector.

    Attributes
    ----------
    kind : str
        One of RETURNS.
    across, along : (2,) ndarray
        Motion of the spots (left, right) divided by the motion of the line CCD, across and along the line.
    gain : (4,) ndarray
        Estimate by the corrected formulas divided by the true change, for single changes of the four parameters.
    """

    kind: str
    across: np.ndarray
    along: np.ndarray
    gain: np.ndarray


def responses(resolved: ResolvedJob, backend: Backend, like: Bench) -> list[Response]:
    """Return the response of every kind of return reflector, from rendered images."""
    camera, pitch = like.cameras[0], resolved.instrument.autocollimator.area_ccd.pitch
    out = []
    for kind, (offset, _) in RETURNS.items():
        built = with_return(variant(resolved, backend, camera, ccd_offset=offset), kind)
        bench = Bench(built, like)
        states = [{}, piston(camera, 0.0, along=(SHIFT, 0.0)), piston(camera, 0.0, along=(0.0, SHIFT))]
        position = bench.positions(states)
        moved = (position[1:] - position[0]) * pitch / SHIFT
        # columns run along -X, rows along +Y
        out.append(Response(kind, -moved[0, :, 1], moved[1, :, 0], gains(bench)[CORRECTED]))
    return out


def depth_of_focus(resolved: ResolvedJob, camera: str) -> float:
    """Return 2 λ N² with wavelength λ and F-number N, at which defocus reaches a quarter wave, in metres.

    The wavelength is that of the monitor.
    """
    spec = resolved.cameras[resolved.instrument.cameras[camera].camera]
    return 2.0 * resolved.instrument.autocollimator.wavelength * (spec.focal_length / spec.entrance_pupil) ** 2


def piston(camera: str, amount: float, *, along: tuple[float, float] = (0.0, 0.0), rotation: float = 0.0) -> State:
    """Return the state with the line CCD moved along Z (and along X and Y, and rotated about Z), metres and radians."""
    return {f"{BASE}/{camera}/focal_plane": Motion(rotate=(0.0, 0.0, rotation), shift=(*along, amount))}


def false_slopes(bench: Bench, form: str, pistons: Sequence[float]) -> np.ndarray:
    """Return the false change of each parameter per metre of piston of the line CCD, (4,).

    The unit is arcsec or um per metre.

    It is the estimate minus the true change, from rendered images before and after the piston.
    """
    camera = bench.cameras[0]
    states = [piston(camera, z) for z in pistons]
    readings = bench.readings(bench.positions([{}]), bench.positions(states))[camera][form]
    false = readings - bench.truth(states)[camera]
    z = np.array(pistons)
    return np.asarray(z @ false / (z @ z))


@dataclass(frozen=True, eq=False)
class PupilStudy:
    """False changes due to piston of the line CCD, over the position of the monitor's sub-aperture in the pupil.

    A false change is an estimate minus the true change, in arcsec or um.

    Attributes
    ----------
    offset : np.ndarray
        (N, 2) X and Y of the N sub-apertures, metres.
    slope : np.ndarray
        (N, 4) false change of each parameter per metre of piston, by the corrected formulas.
    gradient : np.ndarray
        (4, 2) derivatives of the slope with respect to X and Y, arcsec or um per m^2.
    rest : np.ndarray
        (4,) rms of the slopes about that plane, arcsec or um per metre.
    """

    offset: np.ndarray
    slope: np.ndarray
    gradient: np.ndarray
    rest: np.ndarray


def pupil_study(
    resolved: ResolvedJob, backend: Backend, like: Bench, offsets: Sequence[tuple[float, float]], depth: float
) -> PupilStudy:
    """Return the false changes due to piston for several positions of the monitor's sub-aperture.

    The instrument is built again for each position.
    """
    slopes = []
    for offset in offsets:
        bench = Bench(variant(resolved, backend, like.cameras[0], pupil_offset=offset), like)
        slopes.append(false_slopes(bench, CORRECTED, (-depth, depth)))
    position, slope = np.array(offsets), np.array(slopes)
    design = np.column_stack([np.ones(len(position)), position])
    solved, *_ = np.linalg.lstsq(design, slope, rcond=None)
    rest = np.sqrt(np.mean((slope - design @ solved) ** 2, axis=0))
    return PupilStudy(position, slope, solved[1:].T, rest)


def piston_curves(bench: Bench, count: int) -> Curves:
    """Return the false changes by the corrected formulas over the piston (m), divided by FINE and by CLAIMED.

    Of the two directions of the piston, the one with the larger error counts.
    """
    camera, origin = bench.cameras[0], bench.positions([{}])

    def shares(size: np.ndarray) -> dict[str, np.ndarray]:
        states = [piston(camera, sign * z) for sign in (1.0, -1.0) for z in size]
        readings = bench.readings(origin, bench.positions(states))[camera][CORRECTED]
        false = np.abs(readings - bench.truth(states)[camera]).reshape(2, len(size), 4).max(axis=0)
        out = {}
        for k, name in enumerate(NAMES):
            out[f"{name} fine"] = false[:, k] / FINE[name]
            out[f"{name} claimed"] = false[:, k] / CLAIMED[name]
        return out

    return sampled(shares, np.geomspace(10e-6, 4e-3, count).tolist())


def gains(bench: Bench, constant: float = 0.0) -> dict[str, np.ndarray]:
    """Return the estimate divided by the true change, (4,), of each set of formulas for the four changes SMALL.

    The same piston, ``constant`` metres, is present before and after.
    """
    camera = bench.cameras[0]
    states: list[State] = [piston(camera, constant)]
    for name in NAMES:
        motion, unit = motion_of(camera, name, bench.geometry(camera))
        amount = unit * SMALL[name]
        if name == "d_f":
            states.append({**piston(camera, constant), motion.body: motion.motion(amount)})
        elif name == "d_gamma":
            states.append(piston(camera, constant, rotation=amount))
        else:
            along = (amount, 0.0) if name == "d_alpha" else (0.0, amount)
            states.append(piston(camera, constant, along=along))
    position, truth = bench.positions(states), bench.truth(states)[camera]
    change = np.diag(truth[1:] - truth[:1])
    readings = bench.readings(position[:1], position[1:])[camera]
    return {form: np.diag(readings[form]) / change for form in FORMS}


@dataclass(frozen=True, eq=False)
class FieldPoint:
    """Accuracy of the formulas with the area CCDs at another field angle.

    Attributes
    ----------
    field : float
        Field angle of the area CCDs, radians.
    separation : float
        Distance between the area CCDs, metres.
    gains : dict[str, np.ndarray]
        Set of formulas -> (4,) estimate divided by true change.
    slope : np.ndarray
        (4,) false change per metre of piston by the corrected formulas, in arcsec or um.
    """

    field: float
    separation: float
    gains: dict[str, np.ndarray]
    slope: np.ndarray


def field_study(
    resolved: ResolvedJob, backend: Backend, camera: str, fields: Sequence[float], depth: float
) -> list[FieldPoint]:
    """Return the accuracy of the formulas for area CCDs at several field angles, radians.

    The instrument is built again for each field angle.
    """
    out = []
    for field in fields:
        bench = Bench(variant(resolved, backend, camera, field=field))
        slope = false_slopes(bench, CORRECTED, (-depth, depth))
        out.append(FieldPoint(field, bench.geometry(camera).separation_m, gains(bench), slope))
    return out
