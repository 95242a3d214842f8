"""Estimators of the cameras' changes from the shifts of their monitors' spots, with a common interface.

Each is linear to first order: parameters = gain x shifts. With the gain, the noise of the shifts and the prior of the
disturbances (``analysis.monitor.disturbances``) the covariance of the error follows in the same way for all:

    noise: gain R gain', misfit: (gain A - B) C (gain A - B)', total: their sum,

with the effects A of the motions on the spots and B on the parameters, their correlation C and the noise R of the
shifts.

Order of spots: one camera after the other, left before right, of each row and column. Order of parameters: d_alpha,
d_beta, d_gamma (rad), d_f (m) of one camera after the other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import Array
from analysis.monitor import model_fit, monitor_formulas
from analysis.monitor.disturbances import Disturbances
from analysis.monitor.monitor_formulas import CameraParameters, MonitorGeometry
from analysis.monitor.parameters import CameraCalibration
from optics.numerics.extension_table import ExtensionTable

PARAMETERS_PER_CAMERA = 4
"""Number of parameters of one camera: rotations d_alpha, d_beta, d_gamma and change d_f of the principal distance."""


@dataclass(frozen=True, eq=False)
class Shifts:
    """Input of an estimator: positions of the C spots of K cameras before and after a change, in S states.

    Attributes
    ----------
    before, after : (S, C, 2) ndarray
        Spot positions (row, column), px, one camera's after the other's.
    covariance : (S, 2 C, 2 C) ndarray
        Covariance of after - before, px^2; zeros without noise.
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    disturbances : Disturbances or None
        Prior of the disturbances; None if there is none.
    """

    before: Array
    after: Array
    covariance: Array
    cameras: Mapping[str, CameraCalibration]
    disturbances: Disturbances | None = None

    @property
    def vector(self) -> Array:
        """Shifts (position after minus before) of all spots, row and column of one after the other, (S, 2 C) px.

        Dimensions: S states, C spots.
        """
        return (self.after - self.before).reshape(len(self.after), -1)

    @property
    def spots(self) -> dict[str, slice]:
        """Mapping from the name of each camera to the range of its spots among those of all cameras."""
        ends = np.cumsum([0, *(len(camera.channels) for camera in self.cameras.values())]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.cameras, ends[:-1], ends[1:], strict=True)}

    @property
    def coordinates(self) -> dict[str, slice]:
        """Mapping from the name of each camera to the range of its spot coordinates among those of all cameras.

        Spot coordinates are row and column of each spot.
        """
        return {name: slice(2 * spots.start, 2 * spots.stop) for name, spots in self.spots.items()}


class Estimator(ABC):
    """Estimator of the changes of all cameras from the shifts of all spots.

    Attributes
    ----------
    title : str
        Name shown in tables and reports: the name in files with blanks instead of underscores.
    note : str
        Description shown in reports.
    needs_prior : bool
        True if it needs a prior of the disturbances (motions of bodies); without one it is not in the results.
    """

    title: str
    note: str
    needs_prior: bool = False

    def applies(self, cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> bool:
        """Return True if the estimator can be used with these cameras and this prior.

        Parameters
        ----------
        cameras : mapping of str to CameraCalibration
            Calibration of each camera.
        disturbances : Disturbances or None
            Prior of the disturbances; None if there is none.
        """
        return disturbances is not None or not self.needs_prior

    @abstractmethod
    def gain(self, shifts: Shifts) -> Array:
        """Return the matrix from shifts (px) to parameters (rad and m), for every state: (S, 4 K, 2 C).

        Dimensions: S states, K cameras, C spots.

        Parameters
        ----------
        shifts : Shifts
            Measured shifts.
        """

    def read(self, shifts: Shifts) -> Array:
        """Return the estimated parameters, (S, 4 K) rad and m: gain times shifts, or the result of exact formulas.

        Dimensions: S states, K cameras.

        Parameters
        ----------
        shifts : Shifts
            Measured shifts.
        """
        return np.einsum("spd,sd->sp", self.gain(shifts), shifts.vector)


class PerCameraEstimator(Estimator):
    """Estimator that computes each camera's parameters from that camera's own spots alone."""

    @abstractmethod
    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """Return the matrix from one camera's shifts (px) to its four parameters (rad, m), (4, 2 n) or (S, 4, 2 n).

        Dimensions: n spots of the camera, S states.

        Parameters
        ----------
        camera : CameraCalibration
            Calibration of the camera.
        covariance : (S, 2 n, 2 n) ndarray
            Covariance of its shifts, px^2.
        """

    def gain(self, shifts: Shifts) -> Array:
        """Return the gain of all cameras, (S, 4 K, 2 C) rad and m per px, whose diagonal blocks are single cameras.

        Dimensions: S states, K cameras, C spots.
        """
        count = PARAMETERS_PER_CAMERA * len(shifts.cameras)
        out = np.zeros((len(shifts.covariance), count, shifts.covariance.shape[-1]))
        for k, (name, columns) in enumerate(shifts.coordinates.items()):
            rows = slice(PARAMETERS_PER_CAMERA * k, PARAMETERS_PER_CAMERA * (k + 1))
            out[:, rows, columns] = self.camera_gain(shifts.cameras[name], shifts.covariance[:, columns, columns])
        return out


Exact = Callable[[ArrayLike, ArrayLike, ArrayLike, MonitorGeometry], CameraParameters]


@dataclass(frozen=True)
class Formula(PerCameraEstimator):
    """Estimator that applies a set of printed or derived formulas of `analysis.monitor.monitor_formulas`.

    Attributes
    ----------
    name : str
        Name in that module and in files.
    note : str
        Description shown in reports.
    exact : callable or None
        Function with the exact formulas, where these are not linear; None otherwise.
    """

    name: str
    note: str
    exact: Exact | None = None

    @property
    def title(self) -> str:  # type: ignore[override]
        """Name of the set of formulas with blanks instead of underscores."""
        return self.name.replace("_", " ")

    def applies(self, cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> bool:
        """Return True if every camera has a left and a right spot, which the formulas need.

        Parameters
        ----------
        cameras : mapping of str to CameraCalibration
            Calibration of each camera.
        disturbances : Disturbances or None
            Prior of the disturbances; not used here.
        """
        return all(camera.pair is not None for camera in cameras.values())

    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """Return the formulas' coefficients for one camera with n spots, (4, 2 n) rad and m per px.

        Spots beyond the left and the right one have coefficients of zero.
        """
        out = np.zeros((PARAMETERS_PER_CAMERA, 2 * len(camera.channels)))
        out[:, [2 * k + axis for k in _pair(camera) for axis in (0, 1)]] = monitor_formulas.coefficients(
            self.name, camera.geometry
        )
        return out

    def read(self, shifts: Shifts) -> Array:
        """Return the parameters of K cameras in S states, (S, 4 K) rad and m, by exact formulas if there are any."""
        if self.exact is None:
            return super().read(shifts)
        parts = []
        for name, spots in shifts.spots.items():
            camera = shifts.cameras[name]
            at = [spots.start + k for k in _pair(camera)]
            rows = [2 * k + axis for k in at for axis in (0, 1)]
            covariance = shifts.covariance[:, rows][:, :, rows]
            seen = (shifts.before[:, at], shifts.after[:, at], covariance)
            parts.append(self.exact(*seen, camera.geometry).vector)
        return np.concatenate(parts, axis=-1)


def _pair(camera: CameraCalibration) -> tuple[int, int]:
    if camera.pair is None:
        raise ValueError(f"the formulas need spots called left and right, found {', '.join(camera.channels)}")
    return camera.pair


@dataclass(frozen=True)
class LeastSquares(PerCameraEstimator):
    """Weighted least-squares (Gauss-Markov) estimate of four motions of each camera.

    They are those of paper 001 (Wang et al. 2018): shifts of the line CCD along its X and Y axes, its rotation about Z,
    and a relative change of the camera's scale.

    The computation is in `analysis.monitor.model_fit`.
    """

    title: str = "model"
    note: str = "weighted least squares on all spot coordinates with the Jacobian of the traced instrument"

    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """Return the matrix from one camera's shifts (px) to its parameters (rad and m) by the weighted fit."""
        return model_fit.gain(covariance, camera.spot_jacobian, camera.parameter_jacobian, camera.motions)


@dataclass(frozen=True)
class Posterior(Estimator):
    """Minimum-variance linear estimate (best linear unbiased prediction).

    Of all linear functions of all spots it has the smallest mean square error under the prior and the noise:

        p = B C A' (A C A' + R)^-1 s,

    with the shifts s, the effects A of the motions on the spots and B on the parameters, their correlation C and the
    noise R. For normal disturbances it is the mean of the posterior distribution, and its total covariance that
    distribution's (Robinson, Statistical Science 6, 15-32, 1991; Kay, Fundamentals of Statistical Signal Processing,
    1993, ch. 12).
    """

    title: str = "posterior"
    note: str = "best linear unbiased prediction from all spots under the stated disturbances"
    needs_prior: bool = True

    def gain(self, shifts: Shifts) -> Array:
        """Return the gain of the best linear prediction, (S, 4 K, 2 C) rad and m per px.

        Dimensions: S states, K cameras, C spots. ValueError is raised without a prior.
        """
        prior = shifts.disturbances
        if prior is None:
            raise ValueError("posterior: needs a prior of disturbances")
        return prior.best_gain(shifts.covariance)


_ESTIMATORS: dict[str, Estimator] = {
    "paper_single": Formula(
        "paper_single",
        "eqs. (2), (3), (5), (7) of Wang et al. (2018) as printed, one change at a time",
        monitor_formulas.paper_single,
    ),
    "paper_joint": Formula("paper_joint", "joint changes as Wang et al. (2018) print them"),
    "derived": Formula(
        "derived", "the same spot coordinates with the factors of a plane return, plate scale and distortion calibrated"
    ),
    "model": LeastSquares(),
    "posterior": Posterior(),
}
ESTIMATORS = ExtensionTable("estimators", _ESTIMATORS, Estimator)
"""Estimators by their name in the results, in the order of tables.

A new one is added here: it is then in recovered.json, crosstalk.json, the tables and the figures.
"""


PREFERRED = ("posterior", "model")
"""Names of the estimators whose results decide verdicts: the first one that is in the results is used."""


def preferred_estimator(names: Iterable[str]) -> str:
    """Return the name of the estimator in the results that verdicts, quoted sigmas and studies use.

    Parameters
    ----------
    names : iterable of str
        Names of the estimators in the results.

    Raises
    ------
    ValueError
        None of the preferred estimators is among them.
    """
    present = list(names)
    for name in PREFERRED:
        if name in present:
            return name
    raise ValueError(f"results without {' or '.join(PREFERRED)}: there are {', '.join(present)}")


def applicable(cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> dict[str, Estimator]:
    """Return the estimators that can be used with these cameras and this prior, by their names.

    Parameters
    ----------
    cameras : mapping of str to CameraCalibration
        Calibration of each camera.
    disturbances : Disturbances or None
        Prior of the disturbances; None if there is none.
    """
    return {name: estimator for name, estimator in ESTIMATORS.items() if estimator.applies(cameras, disturbances)}
