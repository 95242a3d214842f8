"""What every estimator says about every elementary motion, against the true change: formula factors and crosstalk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.monitor import model_fit, parameters
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.estimators import Shifts, applicable
from analysis.monitor.model_fit import ObservabilityReport
from analysis.monitor.monitor_formulas import PER_SI
from analysis.monitor.parameters import CameraCalibration
from twin.monitor.monitor_derivative import spot_jacobian
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.motions import ElementaryMotion, line_family, other_motions
from twin.monitor.truth import truth_jacobian

_SEEN_WITHIN = 0.1
"""Relative error up to which the words say that a change is seen."""

PRINTED = {("paper_single", k): f"eq. ({number})" for k, number in enumerate((3, 2, 5, 7))}
PRINTED |= {("paper_joint", k): "Table 1, joint" for k in range(4)}


@dataclass(frozen=True)
class FormulaFactor:
    """A printed formula's reading divided by what it should read, for the motion it was derived for.

    Attributes
    ----------
    formula : str
        Where it is printed; estimator, parameter: its names in the results.
    motion : str
        Label of the motion.
    by_model : float
        Reading / change in the paper's own model (thin lens: shift/f, turn, scale * f).
    by_truth : float
        Reading / traced change of the real camera; differs from ``by_model`` by the camera's anamorphism and
        distortion.
    """

    formula: str
    estimator: str
    parameter: str
    motion: str
    by_model: float
    by_truth: float


@dataclass(frozen=True, eq=False)
class CameraCrosstalk:
    """First-order response of one camera's monitor to M elementary motions, per table unit (arcsec, um, ppm).

    Attributes
    ----------
    motions : tuple[ElementaryMotion, ...]
        The four of the paper's own family first.
    spot_shift : np.ndarray
        (2 n, M) px, row and column of one spot after the other.
    true : np.ndarray
        (P, M) true change of every reading of a camera, in its unit.
    readings : Mapping[str, np.ndarray]
        Estimator -> (P, M), what it says.
    factors : tuple[FormulaFactor, ...]
        Of the printed formulas.
    observability : ObservabilityReport
        What the spots' coordinates can and cannot separate.
    channels : tuple[str, ...]
        Names of the camera's channels.
    """

    motions: tuple[ElementaryMotion, ...]
    spot_shift: np.ndarray
    true: np.ndarray
    readings: Mapping[str, np.ndarray]
    factors: tuple[FormulaFactor, ...]
    observability: ObservabilityReport
    channels: tuple[str, ...]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the rows of ``spot_shift``, ``left y`` and so on: rows count along y, columns along x."""
        return tuple(f"{channel} {axis}" for channel in self.channels for axis in ("y", "x"))

    def to_dict(self) -> dict[str, Any]:
        """Plain data for crosstalk.json."""
        rows, keys = [], [one.key for one in parameters.CAMERA_PARAMETERS.values()]
        for k, motion in enumerate(self.motions):
            rows.append(
                {
                    "motion": motion.label,
                    "body": motion.body,
                    "per": motion.unit,
                    "spot_shift_px": self.spot_shift[:, k].tolist(),
                    "true": dict(zip(keys, self.true[:, k].tolist(), strict=True)),
                    **{e: dict(zip(keys, r[:, k].tolist(), strict=True)) for e, r in self.readings.items()},
                }
            )
        return {
            "motions": rows,
            "factors": [vars(factor) for factor in self.factors],
            "observability": list(self.observability.statements),
            "principal_distance": list(self.principal_distance_statements()),
        }

    def principal_distance_statements(self) -> tuple[str, ...]:
        """Which changes of focus, spacing and size the spots report as a change of the principal distance."""
        out = []
        for k, motion in enumerate(self.motions):
            along_axis = motion.kind == "shift" and motion.axis == 2 and motion.body.count("/") == 2
            if not (along_axis or motion.kind == "scale"):
                continue
            true, seen = self.true[3, k], self.readings["derived"][3, k]
            false = self.readings["derived"][:3, k] - self.true[:3, k]
            worst = int(np.argmax(np.abs(false)))
            if abs(seen - true) < _SEEN_WITHIN * abs(true):
                verdict = "the spots see it"
            elif abs(seen) < _SEEN_WITHIN * abs(true):
                verdict = "the spots do not see it"
            else:
                verdict = "the spots see it wrongly"
            out.append(
                f"{motion.label}: the principal distance changes by {true:+.3g} um per {motion.unit}, the spots read "
                f"{seen:+.3g} um: {verdict}. Beside it they show {false[worst]:+.2g} arcsec of "
                f"{[*parameters.CAMERA_PARAMETERS.values()][worst].key.removesuffix('_arcsec')} that is not there."
            )
        return tuple(out)


def estimator_gains(
    cameras: Mapping[str, CameraCalibration], stated: Disturbances | None, covariance: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Estimator -> (4 x cameras, 2 x spots) parameters (rad, m) per pixel of shift, to first order.

    Parameters
    ----------
    cameras : Mapping[str, CameraCalibration]
        What is calibrated of each.
    stated : Disturbances | None
        What is stated to move, None for nothing.
    covariance : np.ndarray | None
        (2 x spots, 2 x spots) px^2 of their shifts, which weighs them; None for no noise.
    """
    spots = sum(len(camera.channels) for camera in cameras.values())
    still = np.zeros((1, spots, 2))
    spread = np.zeros((2 * spots, 2 * spots)) if covariance is None else covariance
    shifts = Shifts(still, still, spread[None], cameras, stated)
    return {name: one.gain(shifts)[0] for name, one in applicable(cameras, stated).items()}


def crosstalk(experiment: MonitorExperiment, covariance: np.ndarray) -> dict[str, CameraCrosstalk]:
    """Work out the table for every camera; readings are those of spots without noise, the same for every measurement.

    Parameters
    ----------
    experiment : MonitorExperiment
        The instrument.
    covariance : np.ndarray
        (2 C, 2 C) px^2 of the shifts of all spots, by which is told what they can separate.
    """
    instrument = experiment.instrument
    sets = {name: (*line_family(name), *other_motions(instrument, name)) for name in instrument.cameras}
    every = [motion for motions in sets.values() for motion in motions]
    all_spots = spot_jacobian(experiment.path, every)
    all_truth = truth_jacobian(instrument, experiment.backend, every)
    gains = estimator_gains(experiment.cameras, experiment.disturbances)
    out = {}
    for k, (name, motions) in enumerate(sets.items()):
        own = slice(len(motions) * k, len(motions) * (k + 1))
        spots = all_spots[list(instrument.channels_of(name))][:, :, own].reshape(-1, len(motions))
        truth = all_truth[name][:, own]
        geometry = experiment.geometry(name)
        size = np.array([motion.unit_size for motion in motions])
        moved = all_spots[:, :, own].reshape(-1, len(motions))
        rows, unit = slice(4 * k, 4 * k + 4), parameters.rows_of(experiment.cameras[name])
        readings = {e: (unit @ (gain[rows] @ moved)) * size for e, gain in gains.items()}
        true = unit @ truth * size
        f = geometry.principal_distance_m
        ideal = PER_SI * np.array([-1.0 / f, 1.0 / f, 1.0, f]) * size[:4]
        factors = tuple(
            FormulaFactor(
                where,
                e,
                [*parameters.CAMERA_PARAMETERS.values()][p].key,
                motions[p].label,
                readings[e][p, p] / ideal[p],
                readings[e][p, p] / true[p, p],
            )
            for (e, p), where in PRINTED.items()
            if e in readings
        )
        labels = [f"{m.label} [{m.unit}]" for m in motions]
        seen = instrument.coordinates_of(name)
        spread = covariance[np.ix_(seen, seen)]
        report = model_fit.observability(labels, spots, truth, size, spread, family=(0, 1, 2, 3))
        channels = experiment.cameras[name].channels
        out[name] = CameraCrosstalk(motions, spots * size, true, readings, factors, report, channels)
    return out
