"""Estimators of the cameras' changes from the shifts of their monitors' spots, under one interface.

Each is linear to first order: parameters = gain x shifts. With the gain, the noise of the shifts and what is stated to
move (``analysis.monitor.disturbances``) the covariance of its error follows in the same way for all of them:

    noise: gain R gain',   misfit: (gain A - B) C (gain A - B)',   total: their sum.

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

PARAMETERS_EACH = 4
"""Parameters of one camera."""


@dataclass(frozen=True, eq=False)
class Shifts:
    """What an estimator is given: S states of K cameras with C spots together.

    Attributes
    ----------
    before, after : Array
        (S, C, 2) spot positions (row, column), px, one camera's after the other's.
    covariance : Array
        (S, 2 C, 2 C) px^2 of after - before; zeros without noise.
    cameras : Mapping[str, CameraCalibration]
        What is calibrated of each.
    disturbances : Disturbances | None
        What is stated to move, None for nothing.
    """

    before: Array
    after: Array
    covariance: Array
    cameras: Mapping[str, CameraCalibration]
    disturbances: Disturbances | None = None

    @property
    def vector(self) -> Array:
        """(S, 2 C) after - before, px."""
        return (self.after - self.before).reshape(len(self.after), -1)

    @property
    def spots(self) -> dict[str, slice]:
        """Camera -> its spots among all."""
        ends = np.cumsum([0, *(len(camera.channels) for camera in self.cameras.values())]).tolist()
        return {name: slice(a, b) for name, a, b in zip(self.cameras, ends[:-1], ends[1:], strict=True)}

    @property
    def coordinates(self) -> dict[str, slice]:
        """Camera -> the coordinates of its spots among all."""
        return {name: slice(2 * own.start, 2 * own.stop) for name, own in self.spots.items()}


class Estimator(ABC):
    """Makes changes of all cameras of the shifts of all spots.

    Attributes
    ----------
    title : str
        For readers, its name in files with blanks.
    note : str
        For readers, what it is.
    stated : bool
        Whether it needs stated disturbances; without any it does not stand in the results.
    """

    title: str
    note: str
    stated: bool = False

    def applies(self, cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> bool:
        """Whether it can be used with these cameras and with what is stated.

        Parameters
        ----------
        cameras : Mapping[str, CameraCalibration]
            What is calibrated of each.
        disturbances : Disturbances | None
            What is stated to move, None for nothing.
        """
        return disturbances is not None or not self.stated

    @abstractmethod
    def gain(self, shifts: Shifts) -> Array:
        """Parameters per pixel of shift, (S, 4 K, 2 C).

        Parameters
        ----------
        shifts : Shifts
            What was measured.
        """

    def read(self, shifts: Shifts) -> Array:
        """The parameters, (S, 4 K): gain x shifts, unless an estimator has something better.

        Parameters
        ----------
        shifts : Shifts
            What was measured.
        """
        return np.einsum("spd,sd->sp", self.gain(shifts), shifts.vector)


class OfEachCamera(Estimator):
    """An estimator that takes each camera's spots for themselves."""

    @abstractmethod
    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """(4, 2 n) or (S, 4, 2 n) parameters of one camera per pixel.

        Parameters
        ----------
        camera : CameraCalibration
            Its calibration.
        covariance : Array
            (S, 2 n, 2 n) of its shifts, px^2.
        """

    def gain(self, shifts: Shifts) -> Array:
        """Block by block, camera by camera."""
        count = PARAMETERS_EACH * len(shifts.cameras)
        out = np.zeros((len(shifts.covariance), count, shifts.covariance.shape[-1]))
        for k, (name, own) in enumerate(shifts.coordinates.items()):
            rows = slice(PARAMETERS_EACH * k, PARAMETERS_EACH * (k + 1))
            out[:, rows, own] = self.camera_gain(shifts.cameras[name], shifts.covariance[:, own, own])
        return out


Exact = Callable[[ArrayLike, ArrayLike, ArrayLike, MonitorGeometry], CameraParameters]


@dataclass(frozen=True)
class Formula(OfEachCamera):
    """A set of formulas of `analysis.monitor.monitor_formulas`.

    Attributes
    ----------
    name : str
        There and in files.
    note : str
        For readers.
    exact : Exact | None
        The formulas as they are, where they are not linear.
    """

    name: str
    note: str
    exact: Exact | None = None

    @property
    def title(self) -> str:  # type: ignore[override]
        """The name with blanks."""
        return self.name.replace("_", " ")

    def applies(self, cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> bool:
        """To cameras with a left and a right spot.

        Parameters
        ----------
        cameras : Mapping[str, CameraCalibration]
            What is calibrated of each.
        disturbances : Disturbances | None
            Of no matter.
        """
        return all(camera.pair is not None for camera in cameras.values())

    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """The formulas' coefficients; further spots have no say."""
        out = np.zeros((PARAMETERS_EACH, 2 * len(camera.channels)))
        out[:, [2 * k + axis for k in _pair(camera) for axis in (0, 1)]] = monitor_formulas.coefficients(
            self.name, camera.geometry
        )
        return out

    def read(self, shifts: Shifts) -> Array:
        """Changes by the exact formulas where there are such."""
        if self.exact is None:
            return super().read(shifts)
        parts = []
        for name, own in shifts.spots.items():
            camera = shifts.cameras[name]
            at = [own.start + k for k in _pair(camera)]
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
class LeastSquares(OfEachCamera):
    """Gauss-Markov estimate of the motions of paper 001's own family, by `analysis.monitor.model_fit`."""

    title: str = "model"
    note: str = "weighted least squares on all spot coordinates with the Jacobian of the traced instrument"

    def camera_gain(self, camera: CameraCalibration, covariance: Array) -> Array:
        """Gain of the weighted fit."""
        return model_fit.gain(covariance, camera.spot_jacobian, camera.parameter_jacobian, camera.motions)


@dataclass(frozen=True)
class Posterior(Estimator):
    """Minimum-variance linear estimate (best linear unbiased prediction): of all linear functions of all spots the one
    with the least mean square error under the stated disturbances and the noise.

        p = B C A' (A C A' + R)^-1 s

    For normal disturbances it is the mean of the posterior distribution, and its total covariance that distribution's
    (Robinson, Statistical Science 6, 15-32, 1991; Kay, Fundamentals of Statistical Signal Processing, 1993, ch. 12).
    """

    title: str = "posterior"
    note: str = "best linear unbiased prediction from all spots under the stated disturbances"
    stated: bool = True

    def gain(self, shifts: Shifts) -> Array:
        """Needs disturbances. Raises ValueError without."""
        stated = shifts.disturbances
        if stated is None:
            raise ValueError("posterior: needs stated disturbances")
        return stated.best_gain(shifts.covariance)


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
"""Name in the results -> estimator, in the order of tables. A new one is added here: it then stands in recovered.json,
crosstalk.json, the tables and the figures.
"""


JUDGED = ("posterior", "model")
"""By which a measurement is judged: the first that stands in its results."""


def judged(names: Iterable[str]) -> str:
    """The estimator that verdicts, quoted sigmas and studies are about: the best one that could be used.

    Parameters
    ----------
    names : Iterable[str]
        Of those that stand in the results.

    Raises
    ------
    ValueError
        None of them is judged by.
    """
    known = list(names)
    for name in JUDGED:
        if name in known:
            return name
    raise ValueError(f"results without {' or '.join(JUDGED)}: there are {', '.join(known)}")


def applicable(cameras: Mapping[str, CameraCalibration], disturbances: Disturbances | None) -> dict[str, Estimator]:
    """The estimators that can be used with these cameras and with what is stated.

    Parameters
    ----------
    cameras : Mapping[str, CameraCalibration]
        What is calibrated of each.
    disturbances : Disturbances | None
        What is stated to move, None for nothing.
    """
    return {name: one for name, one in ESTIMATORS.items() if one.applies(cameras, disturbances)}
