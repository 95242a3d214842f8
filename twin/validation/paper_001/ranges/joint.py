"""All four parameters changed at once: the corners of a box, and random changes within it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from optics.tree import Motion, State
from scenes.channel import BASE
from twin.experiment import MonitorExperiment
from twin.validation.paper_001.ranges.bench import FORMS, Bench
from twin.validation.paper_001.ranges.curves import Domain, sampled
from twin.validation.paper_001.ranges.singles import CLAIMED, FINE, NAMES, beam_end, motion_of

BOX = np.array([4.0, 4.0, 24.0, 950.0])
"""Half widths in d_alpha, d_beta, d_gamma (arcsec) and d_f (um): all at once, the spots just stay on the area CCD."""
CORNERS = np.array(list(product((-1.0, 1.0), repeat=4)))
_FAR = 200.0


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
    end, why = beam_end(bench, states, 1.05, _FAR)
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
    parts = [bench.readings(found.before, found.after) for _, found in experiment.measure(states, bench.frames, seed)]
    return {c: {form: np.concatenate([part[c][form] for part in parts]) for form in FORMS} for c in bench.cameras}
