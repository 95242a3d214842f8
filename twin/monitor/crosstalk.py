"""Response of every estimator to elementary motions of bodies, compared with the true change of the camera.

An estimator computes the changes of a camera's parameters from the shifts of the monitor's spots. This module gives the
scale factors of the formulas printed in paper 001 (Wang et al. 2018), and the crosstalk: the change that an estimator
reports for one parameter although another cause moved the spots.
"""

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
from twin.monitor.truth import ElementaryMotion, line_family, other_motions, truth_jacobian

_SEEN_WITHIN = 0.1
"""Largest relative error of an estimate for which the report says that the monitor observes the change."""

PRINTED = {("paper_single", k): f"eq. ({number})" for k, number in enumerate((3, 2, 5, 7))}
PRINTED |= {("paper_joint", k): "Table 1, joint" for k in range(4)}


@dataclass(frozen=True)
class FormulaFactor:
    """Ratio of a printed formula's estimate to the expected change, for the motion it was derived for.

    Attributes
    ----------
    formula : str
        Number of the equation or table in paper 001 (Wang et al. 2018).
    estimator, parameter : str
        Names of the estimator and of the camera parameter in the results.
    motion : str
        Label of the motion.
    by_model : float
        Estimate divided by the change in the paper's own model (thin lens: shift/f, rotation, scale * f).
    by_truth : float
        Estimate divided by the traced change of the real camera; it differs from ``by_model`` due to the camera's
        anamorphism and distortion.
    """

    formula: str
    estimator: str
    parameter: str
    motion: str
    by_model: float
    by_truth: float


@dataclass(frozen=True, eq=False)
class CameraCrosstalk:
    """First-order response of one camera's monitor to each of M elementary motions of its bodies.

    All values are per unit of the motion in tables: arcsec (rotation), um (shift) or ppm (expansion).

    Dimensions: n spots, M motions, P camera parameters.

    Attributes
    ----------
    motions : tuple of ElementaryMotion
        Motions, beginning with the four for which paper 001 (Wang et al. 2018) derives its formulas.
    spot_shift : (2 n, M) ndarray
        Shifts of the spots, in pixels: row and column of the first spot, then of the second, and so on.
    true : (P, M) ndarray
        True change of each camera parameter, in the parameter's unit.
    readings : mapping of str to (P, M) ndarray
        Estimator -> its estimates of these changes.
    factors : tuple of FormulaFactor
        Scale factors of the formulas printed in that paper.
    observability : ObservabilityReport
        Combinations of the motions that the spots can and cannot separate.
    channels : tuple of str
        Names of the camera's channels (one spot each).
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
        """Labels of the spot coordinates in ``spot_shift``, "left y", "left x" and so on: image rows count along y."""
        return tuple(f"{channel} {axis}" for channel in self.channels for axis in ("y", "x"))

    def to_dict(self) -> dict[str, Any]:
        """Return the response to elementary motions as plain data for the file crosstalk.json."""
        rows, keys = [], [parameter.key for parameter in parameters.CAMERA_PARAMETERS.values()]
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
            "observability": list(self.observability.sentences),
            "principal_distance": list(self.principal_distance_sentences()),
        }

    def principal_distance_sentences(self) -> tuple[str, ...]:
        """Return sentences on how changes of focus, spacing and size appear as changes of the principal distance."""
        out = []
        for k, motion in enumerate(self.motions):
            along_axis = motion.kind == "shift" and motion.axis == 2 and motion.body.count("/") == 2
            if not (along_axis or motion.kind == "scale"):
                continue
            true, reading = self.true[3, k], self.readings["derived"][3, k]
            false_readings = self.readings["derived"][:3, k] - self.true[:3, k]
            worst = int(np.argmax(np.abs(false_readings)))
            if abs(reading - true) < _SEEN_WITHIN * abs(true):
                verdict = "the spots show this change"
            elif abs(reading) < _SEEN_WITHIN * abs(true):
                verdict = "the spots do not show this change"
            else:
                verdict = "the spots show a wrong change"
            out.append(
                f"{motion.label}: the principal distance changes by {true:+.3g} um per {motion.unit}, the spots read "
                f"{reading:+.3g} um: {verdict}. They also show a false {false_readings[worst]:+.2g} arcsec in "
                f"{[*parameters.CAMERA_PARAMETERS.values()][worst].key.removesuffix('_arcsec')}."
            )
        return tuple(out)


def estimator_gains(
    cameras: Mapping[str, CameraCalibration], prior: Disturbances | None, covariance: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return for each estimator the linear map from spot shifts (px) to camera parameters (rad, m), its gain.

    Parameters
    ----------
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    prior : Disturbances | None
        Prior of the disturbances; None if there is none.
    covariance : (2 x spots, 2 x spots) ndarray | None
        Covariance of the spots' shifts, in px^2, by which they are weighted; None if they have no noise.

    Returns
    -------
    dict of str to (4 x cameras, 2 x spots) ndarray
        Estimator -> parameters (rad, m) per pixel of shift.
    """
    spots = sum(len(camera.channels) for camera in cameras.values())
    zeros = np.zeros((1, spots, 2))
    spread = np.zeros((2 * spots, 2 * spots)) if covariance is None else covariance
    shifts = Shifts(zeros, zeros, spread[None], cameras, prior)
    return {name: estimator.gain(shifts)[0] for name, estimator in applicable(cameras, prior).items()}


def crosstalk(experiment: MonitorExperiment, covariance: np.ndarray) -> dict[str, CameraCrosstalk]:
    """Compute the crosstalk table of every camera, for noise-free spots.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    covariance : (2 C, 2 C) ndarray
        Covariance of the shifts of all C spots (row and column of each), in px^2. It determines which combinations of
        motions the spots can separate.

    Returns
    -------
    dict of str to CameraCrosstalk
        Crosstalk table of each camera, by its name.
    """
    instrument = experiment.instrument
    sets = {name: (*line_family(name), *other_motions(instrument, name)) for name in instrument.cameras}
    all_motions = [motion for motions in sets.values() for motion in motions]
    all_spots = spot_jacobian(experiment.path, all_motions)
    all_truth = truth_jacobian(instrument, experiment.backend, all_motions)
    gains = estimator_gains(experiment.cameras, experiment.disturbances)
    out = {}
    for k, (name, motions) in enumerate(sets.items()):
        columns = slice(len(motions) * k, len(motions) * (k + 1))
        spots = all_spots[list(instrument.channels_of(name))][:, :, columns].reshape(-1, len(motions))
        truth = all_truth[name][:, columns]
        geometry = experiment.geometry(name)
        size = np.array([motion.unit_size for motion in motions])
        moved = all_spots[:, :, columns].reshape(-1, len(motions))
        rows, unit = slice(4 * k, 4 * k + 4), parameters.rows_of(experiment.cameras[name])
        readings = {estimator: (unit @ (gain[rows] @ moved)) * size for estimator, gain in gains.items()}
        true = unit @ truth * size
        f = geometry.principal_distance_m
        ideal = PER_SI * np.array([-1.0 / f, 1.0 / f, 1.0, f]) * size[:4]
        factors = tuple(
            FormulaFactor(
                where,
                estimator,
                [*parameters.CAMERA_PARAMETERS.values()][p].key,
                motions[p].label,
                readings[estimator][p, p] / ideal[p],
                readings[estimator][p, p] / true[p, p],
            )
            for (estimator, p), where in PRINTED.items()
            if estimator in readings
        )
        labels = [f"{m.label} [{m.unit}]" for m in motions]
        coordinates = instrument.coordinates_of(name)
        spread = covariance[np.ix_(coordinates, coordinates)]
        report = model_fit.observability(labels, spots, truth, size, spread, family=(0, 1, 2, 3))
        channels = experiment.cameras[name].channels
        out[name] = CameraCrosstalk(motions, spots * size, true, readings, factors, report, channels)
    return out
