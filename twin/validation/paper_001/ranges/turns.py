"""How far the formulas hold for single and for joint turns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.monitoring import MonitorGeometry
from optics.geometry.tree import Motion, State
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.instrument import BASE
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.motions import ElementaryMotion, line_family
from twin.monitor.observation import Observing, observe, one_detector
from twin.validation.checks.group import load_printed
from twin.validation.paper_001.ranges.curves import FORMS, Bench, Curves, Domain, sampled

NAMES = ("d_alpha", "d_beta", "d_gamma", "d_f")
EQUATIONS = {"d_alpha": "(3)", "d_beta": "(2)", "d_gamma": "(5)", "d_f": "(7)"}
UNITS = {"d_alpha": "arcsec", "d_beta": "arcsec", "d_gamma": "arcsec", "d_f": "um"}
_TABLE = load_printed("001")
CLAIMED = {
    "d_alpha": 0.1,
    "d_beta": 0.1,
    "d_gamma": _TABLE.number("table5.d_gamma_arcsec"),
    "d_f": 1e3 * _TABLE.number("table5.d_f_mm"),
}
"""What section 3.3 and Table 5 claim of an error: arcsec and um."""
FINE = {"d_alpha": 0.1, "d_beta": 0.1, "d_gamma": 0.1, "d_f": 40.0}
"""0.1 arcsec for all angles, and Table 5's 0.04 mm."""
RELATIVE = 0.01
WINDOW, CUT = "leaves the area CCD", "an aperture cuts the beam"
EDGE_PX = 11.0
"""Spots may come this near to the outermost pixel centres: half a pixel nearer the fit's template ends on one side, one
pixel nearer the centroid refuses them on all."""
WIDE_PX = 384
"""Rows and columns of the larger CCD that shows what comes after the window's edge."""
_START = {"d_alpha": 0.02, "d_beta": 0.02, "d_gamma": 0.02, "d_f": 8.0}
_FAR = {"d_alpha": 3600.0, "d_beta": 3600.0, "d_gamma": 36000.0, "d_f": 600e3}
"""Table units: where the curves begin, and where the trace ends at the latest."""
_WIDE_SHARE = 0.76
_Raw = dict[str, list[np.ndarray]]
KINDS = ("1 %", "fine", "claimed")
BOX = np.array([4.0, 4.0, 24.0, 950.0])
"""Half widths in d_alpha, d_beta, d_gamma (arcsec) and d_f (um): all at once, the spots just stay on the area CCD."""
BOX_TEXT = f"±({BOX[0]:g}″, {BOX[1]:g}″, {BOX[2]:g}″, {1e-3 * BOX[3]:g} mm)"
CORNERS = np.array(list(product((-1.0, 1.0), repeat=4)))
_joint_FAR = 200.0


@dataclass(frozen=True, eq=False)
class Range(Domain):
    """One parameter changed in one direction; sizes are true changes in table units.

    The names of the curves are those of ``criterion`` and WINDOW.

    Attributes:
        parameter: of NAMES.
        sign: +1 or -1.
        raw: of the images, form -> error over the true change as (N, 2), for the figure.
        raw_traced: the same traced.
        trace_gap: largest difference of a traced spot shift to the rendered one, px.
    """

    parameter: str
    sign: int
    raw: Mapping[str, np.ndarray]
    raw_traced: Mapping[str, np.ndarray]
    trace_gap: float

    @property
    def window(self) -> float:
        """True change at which the first spot comes too near the area CCD's edge, table units."""
        return self.limit(WINDOW)[0]


def criterion(form: str, kind: str) -> str:
    """Name of a form's error as a share of "1 %", "0.1" or "claimed"."""
    return f"{form} {kind}"


def motion_of(camera: str, parameter: str, geometry: MonitorGeometry) -> tuple[ElementaryMotion, float]:
    """The single motion behind a parameter, and its amount (SI) for one table unit of change."""
    k = NAMES.index(parameter)
    f, f_x = geometry.principal_distance_m, geometry.principal_distance_across_m or geometry.principal_distance_m
    amount = (-f_x * ARCSEC, f * ARCSEC, ARCSEC * f_x / f, 1e-6 / f)[k]
    return line_family(camera)[k], amount


def single_range(bench: Bench, wide: Bench, parameter: str, sign: int, count: int) -> Range:
    """Follow one parameter in one direction.

    Args:
        bench: with the instrument's own area CCDs, for the window's edge.
        wide: with larger ones, same camera.
        parameter: of NAMES.
        sign: of the change.
        count: number of sizes to begin with.
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
        every = states(size)
        place = wide.positions(every)
        moved = bench.traced(every) - traced_origin
        gap[0] = max(gap[0], float(np.max(np.abs(place - origin - moved))))
        return shares(size, origin, place, raw)

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
    """Form -> (N, 2), ascending in the change."""
    out = {}
    for form, pieces in parts.items():
        every = np.concatenate(pieces)
        out[form] = every[np.argsort(every[:, 0])]
    return out


def beam_end(bench: Bench, states: Callable[[np.ndarray], list[State]], start: float, far: float) -> tuple[float, str]:
    """The largest size, from ``start`` up to ``far``, whose beams pass whole, to 1 %, and why no larger one does."""

    def fault(size: float) -> str:
        try:
            some = states(np.array([size]))
            bench.traced(some)
        except BeamMissedError:
            return CUT
        except (AimError, np.linalg.LinAlgError):
            return "no ray is found"
        return ""

    good, bad, why = start, far, fault(far)
    if not why:
        return far, "not followed farther"
    while bad / good > 1.01:
        middle = math.sqrt(good * bad)
        found = fault(middle)
        good, bad, why = (good, middle, found) if found else (middle, bad, why)
    return good, why


def joint_states(bench: Bench, changes: Mapping[str, np.ndarray]) -> list[State]:
    """States in which every camera makes changes (S, 4), table units, as far as the motions do them exactly."""
    states: list[dict[str, Motion]] = [{} for _ in next(iter(changes.values()))]
    for camera, wanted in changes.items():
        units = [motion_of(camera, name, bench.geometry(camera))[1] for name in NAMES]
        for state, (x, y, turn, scale) in zip(states, wanted * np.array(units), strict=True):
            state[f"{BASE}/{camera}/focal_plane"] = Motion(rotate=(0.0, 0.0, turn), shift=(x, y, 0.0))
            state[f"{BASE}/{camera}"] = Motion(scale=scale)
    return list(states)


@dataclass(frozen=True, eq=False)
class Corners(Domain):
    """The worst of the 16 corners over the share of the box.

    The names of the curves are form and parameter; the values the worst error of all corners and cameras as a share of
    what is claimed.
    """

    def text(self, name: str) -> str:
        """The limit in words."""
        share, whence = self.limit(name)
        return f"{share:.3g}" + (" (beam cut)" if whence == self.lost_why else "")


def key(form: str, parameter: str, fine: bool = False) -> str:
    """Name of an error as a share of what Table 5 claims, or of 0.1 arcsec and 0.04 mm."""
    return f"{form} {parameter}{' fine' if fine else ''}"


def corners(bench: Bench, count: int) -> Corners:
    """Follow the corners of the box from a thousandth of it until beams are cut."""
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
    end, why = beam_end(bench, states, 1.05, _joint_FAR)
    traced = sampled(
        lambda share: worst(share, traced_origin, bench.traced(states(share))), np.geomspace(1.0, end, 6).tolist()
    )
    return Corners(images, traced, end, why)


@dataclass(frozen=True, eq=False)
class Separation:
    """Readings of many random changes regressed on the true ones.

    Attributes:
        gain: form -> camera -> (4, 4): reading p per unit of true change q.
        sigma: likewise, standard deviations.
        scatter: form -> (4,) rms of what the regression leaves, table units, all cameras.
        trials: number of states.
    """

    gain: Mapping[str, Mapping[str, np.ndarray]]
    sigma: Mapping[str, Mapping[str, np.ndarray]]
    scatter: Mapping[str, np.ndarray]
    trials: int

    def mean(self, form: str, read: str, changed: str) -> tuple[float, float]:
        """Mean of the cameras and its standard deviation."""
        p, q = NAMES.index(read), NAMES.index(changed)
        values = [self.gain[form][c][p, q] for c in self.gain[form]]
        sigmas = [self.sigma[form][c][p, q] for c in self.sigma[form]]
        return float(np.mean(values)), float(np.sqrt(np.sum(np.square(sigmas))) / len(sigmas))


def separation(experiment: MonitorExperiment, bench: Bench, trials: int, seed: int) -> Separation:
    """Random changes of all four parameters of both cameras, uniform in the box, read from noisy frames."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1001,)))
    wanted = {c: rng.uniform(-1.0, 1.0, (trials, 4)) * BOX for c in bench.cameras}
    states = joint_states(bench, wanted)
    truth = bench.truth(states)
    readings = _measured(experiment, bench, states, seed)
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


def _measured(
    experiment: MonitorExperiment, bench: Bench, states: Sequence[State], seed: int
) -> dict[str, dict[str, np.ndarray]]:
    """Readings from noisy frames of all states."""
    how = Observing(one_detector(experiment, bench.frames, seed), stated=False)
    seen = [found.recovery for found in observe(experiment, states, how)]
    parts = [bench.readings(found.before, found.after) for found in seen]
    return {c: {form: np.concatenate([part[c][form] for part in parts]) for form in FORMS} for c in bench.cameras}
