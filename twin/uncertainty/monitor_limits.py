"""What limits the readings of an instrument under its stated disturbances, what would help, and how reports say it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import limits
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import (
    Elasticity,
    HeavyTail,
    LeastObservable,
    Quantity,
    Split,
    elasticities,
    heavy_tails,
    unobserved_bodies,
)
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.monitor.recovery import MeasuredSpots, joint, judged_spots
from analysis.spots.likelihood import EDGE_PX
from analysis.spots.spot_positions import SpotError, difference_covariance
from scenes.models.disturbances import states_of
from scenes.models.instrument_model import MisplacedError
from scenes.specs.instrument import BASE
from scenes.yaml.errors import InputError
from twin.framework.artefact import shown_unit, significant
from twin.monitor.crosstalk import estimator_gains
from twin.monitor.monitor_derivative import disturbances_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import LOST, Observing, observe
from twin.monitor.truth import half_fields

BEST = "posterior"
"""The estimator of the least variance: what it leaves only another measurement takes away."""
LINES = 10
"""Motions that are named, the rest is summed."""
FIELD = 0.1 * ARCSEC
"""Standard deviation with which a test field fixes a direction of a camera: a quarter of a metre on the ground from
500 km, what control points of that accuracy give."""
DAY = 86400.0
_MORE_FRAMES = 4
_UNMOVED = 1e-8
"""Standard deviation before any measurement, arcsec, um or m, up to which a quantity is taken as one that nothing
stated changes: what rounding makes of a trace is 1e-10."""
_DRAWS = 100_000
_STATES = 6
_PIXELS = 1 << 21  # of the images of these states that are worked on at once
"""States over which the covariance of a shift is averaged, and pixels of their images that are processed at once. The
covariance varies by some per cent between states.
"""


@dataclass(frozen=True, eq=False)
class Remedy:
    """Something that could be done.

    Attributes
    ----------
    name : str
        Short, small letters and _.
    what : str
        In words.
    sigma : np.ndarray
        (Q,) standard deviations of the posterior that it would leave.
    """

    name: str
    what: str
    sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class MonitorLimits:
    """What limits an instrument's readings.

    Attributes
    ----------
    instrument : str
        Its name.
    stated : Disturbances
        What moves.
    quantities : tuple[Quantity, ...]
        Q of them.
    noise : np.ndarray
        (D, D) of the shifts of the spots, px^2.
    frames : int
        Of each state.
    splits : Mapping[str, Split]
        Estimator -> the variances of all quantities.
    least_seen : tuple[LeastSeen, ...]
        Of every quantity.
    remedies : tuple[Remedy, ...]
        What would help.
    outside : float
        Chance that a spot leaves its CCD, or comes too near its edge, so that nothing is measured.
    without : str
        Why there is no remedy by a second monitor; empty where there is one, or nobody asked.
    """

    instrument: str
    stated: Disturbances
    quantities: tuple[Quantity, ...]
    noise: np.ndarray
    frames: int
    splits: Mapping[str, Split]
    least_seen: tuple[LeastObservable, ...]
    remedies: tuple[Remedy, ...]
    outside: float
    without: str = ""

    @cached_property
    def rows(self) -> np.ndarray:
        """(Q, 4 K) of the quantities."""
        return np.stack([quantity.row for quantity in self.quantities])

    def lines(self, estimator: str, quantity: int) -> list[tuple[str, float]]:
        """Label and share of the variance of an estimate's error, largest first, noise apart.

        Parameters
        ----------
        estimator : str
            Its name, or empty for the variance before a measurement.
        quantity : int
            Its number.
        """
        split = self.splits[estimator or BEST]
        total = (split.sigma if estimator else split.sigma_before)[quantity] ** 2
        found = self._by_label[estimator]
        return sorted(((name, float(value[quantity] / total)) for name, value in found.items()), key=lambda x: -x[1])

    @cached_property
    def _by_label(self) -> Mapping[str, dict[str, np.ndarray]]:
        """Estimator, or empty for before a measurement -> label -> (Q,) its share of the variances."""
        shares = {"": self.splits[BEST].before, **{name: split.after for name, split in self.splits.items()}}
        return {name: Split.by(share, self.stated.labels) for name, share in shares.items()}

    @cached_property
    def gain(self) -> np.ndarray:
        """(4 K, D) of the posterior."""
        return self.stated.best_gain(self.noise)

    @cached_property
    def elasticities(self) -> tuple[Elasticity, ...]:
        """How every quantity's sigma follows each stated number."""
        return elasticities(self.rows, self.stated, self.noise, self.gain)

    @cached_property
    def heavy_tail(self) -> HeavyTail:
        """What a statement with heavy tails would leave."""
        return heavy_tails(self.rows, self.stated, self.noise, self.gain)

    @cached_property
    def from_statement(self) -> np.ndarray:
        """(Q,) shares of the posterior's variances that no spot constrains, however little noise it has."""
        left, alone = (
            limits.posterior_sigma(self.rows, self.stated, noise) for noise in (self.noise, 0.0 * self.noise)
        )
        return np.minimum(np.square(alone / np.where(left > 0.0, left, np.inf)), 1.0)

    @cached_property
    def known(self) -> Mapping[str, np.ndarray]:
        """Label -> (Q,) what would be left if that motion were known, of all that the posterior's first lines name."""
        names = {name for q in range(len(self.quantities)) for name, _ in self.lines(BEST, q)[:LINES]}
        # in the order of the statement: a set has none
        labels = [label for label in dict.fromkeys(self.stated.labels) if label in names]
        left = limits.sigma_if_known(self.rows, self.stated, self.noise, [(label,) for label in labels])
        return dict(zip(labels, left, strict=True))


def expected_covariance(experiment: MonitorExperiment, frames: int) -> np.ndarray:
    """(D, D) px^2 of the shifts between two measurements of so many frames each, without drawing any noise.

    The pattern of the pixels' response cancels where a spot stays on its pixels. It is therefore worked out for some
    states of the stated disturbances, and the mean is taken; for none where their spots leave the CCDs.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    frames : int
        Of each.
    """
    centroid, calibration = experiment.resolved.job.analysis.centroid, experiment.calibration
    nominal = experiment.expected_frames(experiment.nominal_photons)
    before = judged_spots(nominal, frames, calibration, centroid)
    if experiment.stated is None:
        spread = difference_covariance(before[0], before[0], calibration.noise)
        return np.asarray(joint(spread[None])[0])

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        return before, experiment.expected_frames(photons)

    amounts = experiment.stated.draw(np.random.default_rng(1), _STATES)
    states = states_of(amounts, experiment.stated.components, experiment.thermal)
    how = Observing(record, centroid, max(1, _PIXELS // nominal.size), stated=False, frames=frames)
    try:
        seen = [found.recovery.shift_covariance for found in observe(experiment, states, how)]
    except (*LOST, SpotError):
        return np.asarray(joint(2.0 * before[0].covariance[None])[0])
    return np.asarray(np.concatenate(seen).mean(axis=0))


def find_limits(
    experiment: MonitorExperiment, noise: np.ndarray, frames: int, second_monitor: bool = False
) -> MonitorLimits | None:
    """What limits the readings of all quantities that what is stated changes; None where nothing is stated to move, or
    nothing that changes a camera.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    noise : np.ndarray
        (D, D) of the shifts, px^2.
    frames : int
        Of each state.
    second_monitor : bool
        Whether a second one is built to say what it would give; it takes a second or two.

    Raises
    ------
    InputError
        What is stated cannot be.
    """
    stated = experiment.disturbances
    if stated is None:
        return None
    cameras = experiment.cameras
    before = np.sqrt(np.diag(stated.parameter_covariance))
    found = tuple(q for q in limits.quantities(cameras, experiment.ground) if float(np.abs(q.row) @ before) > _UNMOVED)
    if not found:
        return None
    rows = np.stack([quantity.row for quantity in found])
    gains = estimator_gains(cameras, stated, noise)
    splits = {name: limits.split(rows, stated, noise, gain) for name, gain in gains.items()}
    remedies = [
        Remedy("more_frames", f"{_MORE_FRAMES} times the frames", _left(rows, stated, noise / _MORE_FRAMES)),
        Remedy("no_noise", "images without noise", _left(rows, stated, 0.0 * noise)),
    ]
    fields = half_fields(experiment.instrument, experiment.nominal_truth.principal_distance)
    field = limits.field_covariance(FIELD, cameras, list(fields.values()))
    for name, gap, text in (
        ("field_now", 0.0, "a test field at the same time"),
        ("field_day", DAY, "a test field a day before"),
        ("field_month", 30.0 * DAY, "a test field a month before"),
    ):
        remedies.append(Remedy(name, text, limits.calibrated_sigma(rows, stated, noise, field, gap)))
    why = ""
    if second_monitor:
        try:
            more = limits.with_further_spots(stated, _second_monitor(experiment).spots, _own(stated))
            remedies.append(
                Remedy(
                    "second_monitor",
                    "a second monitor on the other side of the pupil",
                    _left(rows, more, np.kron(np.eye(2), noise)),
                )
            )
        except (InputError, MisplacedError, *LOST) as error:
            why = str(error)
    seen = tuple(limits.least_seen(row, stated, noise) for row in rows)
    outside = _outside(experiment, stated, noise)
    name = experiment.instrument.spec.name
    return MonitorLimits(name, stated, found, noise, frames, splits, seen, tuple(remedies), outside, why)


def _left(rows: np.ndarray, stated: Disturbances, noise: np.ndarray) -> np.ndarray:
    return limits.posterior_sigma(rows, stated, noise)


def _own(stated: Disturbances) -> list[bool]:
    """Whether a second monitor has a body of its own: its prisms; cameras and central prism are the same."""
    return ["/monitor/" in body for body in stated.bodies]


def _second_monitor(experiment: MonitorExperiment) -> Disturbances:
    """Disturbances of a second monitor for the same motions, with its sub-aperture on the other side of every pupil."""
    resolved = experiment.resolved
    mirrored = {name: mounted.mirrored for name, mounted in resolved.instrument.cameras.items()}
    instrument = resolved.instrument.model_copy(update={"cameras": mirrored})
    other = MonitorExperiment(resolved.model_copy(update={"instrument": instrument}), experiment.backend)
    assert experiment.stated is not None
    return disturbances_of(experiment.stated, other.path, other.thermal, other.instrument, other.backend)


def _outside(experiment: MonitorExperiment, stated: Disturbances, noise: np.ndarray) -> float:
    """Chance that a spot is beyond its CCD, or too near its edge; from draws of the shifts, always the same ones."""
    half = 0.5 * (np.array(experiment.path.shape) - 1) - EDGE_PX
    middle = experiment.path.coarse_trace([{}]).place[:, 0]
    root = np.linalg.cholesky(stated.spot_covariance + noise)
    shifts = np.random.default_rng(1).standard_normal((_DRAWS, len(root))) @ root.T
    place = middle + shifts.reshape(_DRAWS, *middle.shape)
    return float(np.mean(np.any(np.abs(place) > half, axis=(1, 2))))


def quantity_text(quantity: Quantity) -> str:
    """With its unit: ``forward Δα [arcsec]``."""
    return f"{short_text(quantity)} [{unit_text(quantity)}]"


def short_text(quantity: Quantity) -> str:
    """Without its unit: ``forward Δα``, ``intersection angle``, ``height``."""
    name = quantity.parameter.symbol
    if quantity.group == ANGLE_GROUP:
        return "intersection angle"
    if quantity.group == GROUND_GROUP:
        return name if name == "height" else f"{name} the track"
    return f"{quantity.group} {name}"


def unit_text(quantity: Quantity) -> str:
    """Unit of a quantity."""
    return quantity.parameter.unit


def unseen_texts(
    stated: Disturbances, noise: np.ndarray, quantities: Sequence[Quantity], gain: np.ndarray
) -> tuple[str, ...]:
    """A warning for each stated body whose motions have next to no derivative in the spots and yet make sigma.

    Parameters
    ----------
    stated : Disturbances
        What moves.
    noise : np.ndarray
        (D, D) of the shifts, px^2.
    quantities : Sequence[Quantity]
        Q of them.
    gain : np.ndarray
        (4 K, D) of the estimator that is judged by.
    """
    rows = np.stack([quantity.row for quantity in quantities])
    out = []
    for body, shares in unobserved_bodies(rows, stated, noise, gain).items():
        worst = int(np.argmax(shares))
        out.append(
            f"{body}: its motions that are stated move no spot; {100.0 * float(shares[worst]):.0f} % of the variance "
            f"of {short_text(quantities[worst])} are from the statement, not from the spots, and nothing that is "
            "measured can contradict it"
        )
    return tuple(out)


def body_text(body: str) -> str:
    """A body, or a motion of it, without the base that all stand on."""
    return body.removeprefix(f"{BASE}/")


def part_of(body: str) -> str:
    """What a body is, whichever camera's it is: ``M2``, ``prism_180``, ``camera``, ``central_prism``."""
    below = body.split("/")[1:]
    if not below:
        return "base"
    if len(below) == 1:
        return below[0] if below[0] == "central_prism" else "camera"
    return below[-1]


def combination_text(limits: MonitorLimits, number: int, most: int = 4) -> str:
    """The motions that hide best, in words.

    Parameters
    ----------
    limits : MonitorLimits
        Of an instrument.
    number : int
        Of the quantity.
    most : int
        Motions that are named.
    """
    seen, quantity, stated = limits.least_seen[number], limits.quantities[number], limits.stated
    order = sorted(range(len(seen.amounts)), key=lambda k: -abs(seen.amounts[k]))[:most]
    named = [
        f"{body_text(stated.labels[k])} {significant(seen.amounts[k] * stated.sigmas[k], 2, sign=True)} "
        f"{shown_unit(stated.units[k])}"
        for k in order
        if seen.amounts[k]
    ]
    change = f"{significant(seen.change, 2)} {unit_text(quantity)}"
    return f"{', '.join(named)}: {change}, while no spot moves by more than {_moved(seen)}"


def _moved(seen: LeastObservable) -> str:
    """How far spots move with a combination, beside their noise."""
    moved, noise = float(abs(seen.spots).max()), float(seen.noise.max())
    return f"{moved:.1g} px (noise {noise:.1g} px)"
