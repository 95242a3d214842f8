"""Limits of the changes estimated by a monitor under a prior on disturbances, and the benefit of more measurements."""

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
from analysis.spots.spot_image import SpotError, difference_covariance
from scenes.models.disturbances import states_of
from scenes.models.instrument_model import MisplacedError
from scenes.specs.instrument import BASE
from scenes.yaml.errors import InputError
from twin.framework.artefact import significant, unit_for_reports
from twin.monitor.crosstalk import estimator_gains
from twin.monitor.monitor_derivative import disturbances_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import LOST, ObservationOptions, observe
from twin.monitor.truth import half_fields

BEST = "posterior"
"""Name of the estimator of the smallest variance; only a further measurement reduces the error that it leaves."""
LINES = 10
"""Number of motions of bodies that tables list for each quantity; the contributions of the others are summed."""
FIELD = 0.1 * ARCSEC
"""Standard deviation, in radians, of a camera's viewing direction that a calibration over a test field determines.

It corresponds to a quarter of a metre on the ground from 500 km, the accuracy of the control points.
"""
DAY = 86400.0
_MORE_FRAMES = 4
_UNMOVED = 1e-8
"""Standard deviation before any measurement, in arcsec, um or m, up to which a quantity counts as unchanged by the
prior.

Rounding errors of a trace are 1e-10.
"""
_DRAWS = 100_000
_STATES = 6
"""Number of random states over which the noise covariance of the spot shifts is averaged; it varies by some per cent
between states.
"""
_PIXELS = 1 << 21
"""Largest number of pixels of the images of these random states that are processed at once."""


@dataclass(frozen=True, eq=False)
class Remedy:
    """Further measurement that would reduce the errors of the estimated changes.

    Attributes
    ----------
    name : str
        Short name in lower case with underscores.
    what : str
        Description.
    sigma : (Q,) ndarray
        Standard deviations of the Q quantities by the posterior that it would leave.
    """

    name: str
    what: str
    sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class MonitorLimits:
    """Analysis of what limits the accuracy of the changes that an instrument's monitor estimates.

    Attributes
    ----------
    instrument : str
        Name of the instrument.
    disturbances : Disturbances
        Prior on the disturbances.
    quantities : tuple of Quantity
        The Q quantities.
    noise : (D, D) ndarray
        Noise covariance of the D coordinates of spot shifts, px^2.
    frames : int
        Number of frames of each state.
    splits : Mapping[str, Split]
        Estimator -> variances of all quantities by motion.
    least_observable : tuple of LeastObservable
        Least observable combination of motions for every quantity.
    remedies : tuple of Remedy
        Further measurements.
    outside : float
        Probability that a spot leaves its CCD, or is too near its edge, so that nothing is measured.
    without : str
        Reason why there is no result for a second monitor; empty where there is one, or none was asked for.
    """

    instrument: str
    disturbances: Disturbances
    quantities: tuple[Quantity, ...]
    noise: np.ndarray
    frames: int
    splits: Mapping[str, Split]
    least_observable: tuple[LeastObservable, ...]
    remedies: tuple[Remedy, ...]
    outside: float
    without: str = ""

    @cached_property
    def rows(self) -> np.ndarray:
        """Derivatives of the Q quantities with respect to the changes of the K cameras, (Q, 4 K).

        The four changes of each camera are three rotations, in radians, and that of the principal distance, in metres.
        """
        return np.stack([quantity.row for quantity in self.quantities])

    def lines(self, estimator: str, quantity: int) -> list[tuple[str, float]]:
        """Return label and share of each motion in the variance of an error, largest first, without the noise.

        Parameters
        ----------
        estimator : str
            Name of the estimator, or empty for the variance before a measurement.
        quantity : int
            Index of the quantity.
        """
        split = self.splits[estimator or BEST]
        total = (split.sigma if estimator else split.sigma_before)[quantity] ** 2
        shares = self._by_label[estimator]
        return sorted(((name, float(value[quantity] / total)) for name, value in shares.items()), key=lambda x: -x[1])

    @cached_property
    def _by_label(self) -> Mapping[str, dict[str, np.ndarray]]:
        """Estimator -> motion's label -> (Q,) contribution to the variances of the Q quantities.

        The empty name stands for the variances before a measurement.
        """
        shares = {"": self.splits[BEST].before, **{name: split.after for name, split in self.splits.items()}}
        return {name: Split.by(share, self.disturbances.labels) for name, share in shares.items()}

    @cached_property
    def gain(self) -> np.ndarray:
        """Gain of the posterior, (4 K, D), for K cameras and D coordinates of spot shifts.

        It gives the four parameters of each camera, in rad or m, per pixel of spot shift.
        """
        return self.disturbances.best_gain(self.noise)

    @cached_property
    def elasticities(self) -> tuple[Elasticity, ...]:
        """Sensitivity of every quantity's sigma to each number of the prior, relative change per relative change."""
        return elasticities(self.rows, self.disturbances, self.noise, self.gain)

    @cached_property
    def heavy_tail(self) -> HeavyTail:
        """Errors of the posterior under a prior with heavy tails."""
        return heavy_tails(self.rows, self.disturbances, self.noise, self.gain)

    @cached_property
    def from_prior(self) -> np.ndarray:
        """Fractions of the Q posterior variances that would remain without image noise, due to the prior, (Q,)."""
        with_noise, noise_free = (
            limits.posterior_sigma(self.rows, self.disturbances, noise) for noise in (self.noise, 0.0 * self.noise)
        )
        return np.minimum(np.square(noise_free / np.where(with_noise > 0.0, with_noise, np.inf)), 1.0)

    @cached_property
    def sigma_if_known(self) -> Mapping[str, np.ndarray]:
        """Motion's label -> (Q,) sigmas of the Q quantities if that motion were known.

        The motions are those listed first under the posterior.
        """
        names = {name for q in range(len(self.quantities)) for name, _ in self.lines(BEST, q)[:LINES]}
        # keep the order of the prior, since a set has none
        labels = [label for label in dict.fromkeys(self.disturbances.labels) if label in names]
        sigmas = limits.sigma_if_known(self.rows, self.disturbances, self.noise, [(label,) for label in labels])
        return dict(zip(labels, sigmas, strict=True))


def expected_covariance(experiment: MonitorExperiment, frames: int) -> np.ndarray:
    """Return the expected noise covariance (D, D), px^2, of the D coordinates of spot shifts between two measurements.

    No noise is drawn. The pattern of the pixels' response cancels where a spot stays on its pixels. It is therefore
    computed for some states of the prior and averaged; where their spots leave the CCDs, no such state is used.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument.
    frames : int
        Number of frames of each measurement.
    """
    centroid, calibration = experiment.resolved.job.analysis.centroid, experiment.calibration
    nominal = experiment.expected_frames(experiment.nominal_photons)
    before = judged_spots(nominal, frames, calibration, centroid)
    if experiment.prior is None:
        spread = difference_covariance(before[0], before[0], calibration.noise)
        return np.asarray(joint(spread[None])[0])

    def record(photons: np.ndarray, numbers: np.ndarray) -> tuple[MeasuredSpots, np.ndarray]:
        return before, experiment.expected_frames(photons)

    amounts = experiment.prior.draw(np.random.default_rng(1), _STATES)
    states = states_of(amounts, experiment.prior.components, experiment.thermal)
    observing = ObservationOptions(record, centroid, max(1, _PIXELS // nominal.size), use_prior=False, frames=frames)
    try:
        covariances = [observation.recovery.shift_covariance for observation in observe(experiment, states, observing)]
    except (*LOST, SpotError):
        return np.asarray(joint(2.0 * before[0].covariance[None])[0])
    return np.asarray(np.concatenate(covariances).mean(axis=0))


def find_limits(
    experiment: MonitorExperiment, noise: np.ndarray, frames: int, second_monitor: bool = False
) -> MonitorLimits | None:
    """Return what limits the accuracy of all quantities that the prior changes; None if it changes no camera.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument.
    noise : (D, D) ndarray
        Noise covariance of the D coordinates of spot shifts, px^2.
    frames : int
        Number of frames of each state.
    second_monitor : bool
        Also build a second monitor to compute its benefit, which takes a second or two.

    Raises
    ------
    InputError
        The disturbances of the prior are not possible.
    """
    prior = experiment.disturbances
    if prior is None:
        return None
    cameras = experiment.cameras
    before = np.sqrt(np.diag(prior.parameter_covariance))
    changed = tuple(
        q for q in limits.quantities(cameras, experiment.ground) if float(np.abs(q.row) @ before) > _UNMOVED
    )
    if not changed:
        return None
    rows = np.stack([quantity.row for quantity in changed])
    gains = estimator_gains(cameras, prior, noise)
    splits = {name: limits.split(rows, prior, noise, gain) for name, gain in gains.items()}
    left = limits.posterior_sigma
    remedies = [
        Remedy("more_frames", f"{_MORE_FRAMES} times the frames", left(rows, prior, noise / _MORE_FRAMES)),
        Remedy("no_noise", "images without noise", left(rows, prior, 0.0 * noise)),
    ]
    fields = half_fields(experiment.instrument, experiment.nominal_truth.principal_distance)
    field = limits.field_covariance(FIELD, cameras, list(fields.values()))
    for name, gap, text in (
        ("field_now", 0.0, "a test field at the same time"),
        ("field_day", DAY, "a test field a day before"),
        ("field_month", 30.0 * DAY, "a test field a month before"),
    ):
        remedies.append(Remedy(name, text, limits.calibrated_sigma(rows, prior, noise, field, gap)))
    reason = ""
    if second_monitor:
        try:
            individual = ["/monitor/" in body for body in prior.bodies]
            enlarged = limits.with_further_spots(prior, _second_monitor(experiment).spots, individual)
            sigma = left(rows, enlarged, np.kron(np.eye(2), noise))
            remedies.append(Remedy("second_monitor", "a second monitor on the other side of the pupil", sigma))
        except (InputError, MisplacedError, *LOST) as error:
            reason = str(error)
    least_observable = tuple(limits.least_seen(row, prior, noise) for row in rows)
    outside = _outside(experiment, prior, noise)
    name = experiment.instrument.spec.name
    return MonitorLimits(
        name, prior, changed, noise, frames, splits, least_observable, tuple(remedies), outside, reason
    )


def _second_monitor(experiment: MonitorExperiment) -> Disturbances:
    """Return the disturbances of a second monitor, mirrored to the other side of every pupil, for the same motions."""
    resolved = experiment.resolved
    mirrored = {name: mounted.mirrored for name, mounted in resolved.instrument.cameras.items()}
    instrument = resolved.instrument.model_copy(update={"cameras": mirrored})
    other = MonitorExperiment(resolved.model_copy(update={"instrument": instrument}), experiment.backend)
    assert experiment.prior is not None
    return disturbances_of(experiment.prior, other.path, other.thermal, other.instrument, other.backend)


def _outside(experiment: MonitorExperiment, prior: Disturbances, noise: np.ndarray) -> float:
    """Return the probability that a spot is beyond its CCD or too near its edge, from a fixed set of random shifts."""
    half = 0.5 * (np.array(experiment.path.shape) - 1) - EDGE_PX
    middle = experiment.path.coarse_trace([{}]).centre[:, 0]
    root = np.linalg.cholesky(prior.spot_covariance + noise)
    shifts = np.random.default_rng(1).standard_normal((_DRAWS, len(root))) @ root.T
    positions = middle + shifts.reshape(_DRAWS, *middle.shape)
    return float(np.mean(np.any(np.abs(positions) > half, axis=(1, 2))))


def quantity_text(quantity: Quantity) -> str:
    """Return the name of a quantity with its unit: ``forward Δα [arcsec]``."""
    return f"{short_text(quantity)} [{unit_text(quantity)}]"


def short_text(quantity: Quantity) -> str:
    """Return the name of a quantity without its unit: ``forward Δα``, ``intersection angle``, ``height``."""
    name = quantity.parameter.symbol
    if quantity.group == ANGLE_GROUP:
        return "intersection angle"
    if quantity.group == GROUND_GROUP:
        return name if name == "height" else f"{name} the track"
    return f"{quantity.group} {name}"


def unit_text(quantity: Quantity) -> str:
    """Return the unit of a quantity as text, such as arcsec or um."""
    return quantity.parameter.unit


def unobserved_texts(
    prior: Disturbances, noise: np.ndarray, quantities: Sequence[Quantity], gain: np.ndarray
) -> tuple[str, ...]:
    """Return a warning for each body whose motions in the prior hardly move the spots but contribute to sigma.

    Parameters
    ----------
    prior : Disturbances
        Prior on the disturbances.
    noise : (D, D) ndarray
        Noise covariance of the D coordinates of spot shifts, px^2.
    quantities : Sequence[Quantity]
        The quantities.
    gain : (4 K, D) ndarray
        Gain of the estimator of the verdict: four parameters of each of K cameras per pixel of shift.
    """
    rows = np.stack([quantity.row for quantity in quantities])
    out = []
    for body, shares in unobserved_bodies(rows, prior, noise, gain).items():
        worst = int(np.argmax(shares))
        out.append(
            f"{body}: its motions in the prior move no spot; {100.0 * float(shares[worst]):.0f} % of the variance of "
            f"{short_text(quantities[worst])} rest on the prior, not on the spots, and no measurement can contradict it"
        )
    return tuple(out)


def body_text(body: str) -> str:
    """Return the name of a body, or of its motion, without the prefix ``base``."""
    return body.removeprefix(f"{BASE}/")


def part_of(body: str) -> str:
    """Return the kind of a body, the same in all cameras: ``M2``, ``prism_180``, ``camera``, ``central_prism``."""
    below = body.split("/")[1:]
    if not below:
        return "base"
    if len(below) == 1:
        return below[0] if below[0] == "central_prism" else "camera"
    return below[-1]


def combination_text(limits: MonitorLimits, number: int, most: int = 4) -> str:
    """Return the least observable combination of motions for a quantity, as text.

    Parameters
    ----------
    limits : MonitorLimits
        Limits of an instrument.
    number : int
        Index of the quantity.
    most : int
        Largest number of motions to name.
    """
    combination, quantity, prior = limits.least_observable[number], limits.quantities[number], limits.disturbances
    order = sorted(range(len(combination.amounts)), key=lambda k: -abs(combination.amounts[k]))[:most]
    named = [
        f"{body_text(prior.labels[k])} {significant(combination.amounts[k] * prior.sigmas[k], 2, sign=True)} "
        f"{unit_for_reports(prior.units[k])}"
        for k in order
        if combination.amounts[k]
    ]
    change = f"{significant(combination.change, 2)} {unit_text(quantity)}"
    return f"{', '.join(named)}: {change}, while no spot moves by more than {_moved(combination)}"


def _moved(combination: LeastObservable) -> str:
    """Return how far a combination of motions moves the spots, in comparison with their noise, as text."""
    moved, noise = float(abs(combination.spots).max()), float(combination.noise.max())
    return f"{moved:.1g} px (noise {noise:.1g} px)"
