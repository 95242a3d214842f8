"""Fisher information of the monitor's spots on the camera parameters: posterior covariance from derivatives and noise.

The amounts x ~ N(0, C) of M motions, in standard deviations with correlation matrix C, move the spots by A x and change
the cameras' parameters by B x; A and B are the Jacobians. Spots with noise covariance R give x the Fisher information
A' R^-1 A. The posterior covariance of the cameras' parameters is B (C^-1 + A' R^-1 A)^-1 B', which equals B C B' - B C
A' (A C A' + R)^-1 A C B' also for singular C.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from analysis.monitor.disturbances import Disturbances
from analysis.monitor.limits import Split, split
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.recovery import joint
from analysis.spots.likelihood import image_bound
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from scenes.models.disturbances import prior_of_spec
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import DisturbancesSpec
from twin.monitor.monitor_derivative import disturbances_of
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import ground_geometry
from twin.sensors.area_detector import EmvaDetector

NOISE = "noise"
"""Name of the images' noise among the causes of an estimate's variance."""
_SLOPE = 2  # pixels more on every side of an image, for its slopes
_PARAMETERS = 4


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of a monitor layout's spots about its cameras.

    Dimensions: C spots, D = 2 C spot coordinates (row and column), K cameras.

    Attributes
    ----------
    disturbances : Disturbances
        Prior of the motions, with their derivatives of the spot coordinates and of the cameras' parameters.
    noise : (D, D) ndarray
        Covariance of the spot shifts due to the noise of the images before and after the change, in px^2.
    quantities : mapping of str to (n, 4 K) ndarray
        Name of a quantity -> n linear combinations of the parameters of all cameras, as rows of coefficients; the
        quantity's variance is the mean of the variances of these combinations.
    brightest : (C,) ndarray
        Expected signal of every spot's brightest pixel, as a fraction of saturation.
    """

    disturbances: Disturbances
    noise: np.ndarray
    quantities: Mapping[str, np.ndarray]
    brightest: np.ndarray

    @cached_property
    def gain(self) -> np.ndarray:
        """Matrix from spot shifts to camera parameters with the smallest variance, (4 K, D), in rad or m per pixel.

        Dimensions: K cameras, D spot coordinates (row and column of every spot).
        """
        return self.disturbances.best_gain(self.noise)

    @cached_property
    def splits(self) -> Mapping[str, Split]:
        """Name of each quantity -> the contribution of each motion to its variance, in SI units squared."""
        return {name: split(rows, self.disturbances, self.noise, self.gain) for name, rows in self.quantities.items()}

    def sigma(self, name: str) -> float:
        """Return the posterior standard deviation of a quantity, in SI units."""
        return float(np.sqrt(np.mean(self.splits[name].sigma ** 2)))

    def sigma_before(self, name: str) -> float:
        """Return the prior standard deviation of a quantity, in SI units."""
        return float(np.sqrt(np.mean(self.splits[name].sigma_before ** 2)))

    def slopes(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of a quantity's posterior sigma with respect to the spot Jacobian and to the noise.

        The posterior-variance-minimizing gain does not contribute by its own change. With w = gain' q for a row q of
        the quantity's coefficients, spot Jacobian A, camera Jacobian B, correlations C of the motions and noise
        covariance R, the variance changes by 2 w' dA C (A' w - B' q) + w' dR w.

        Returns
        -------
        tuple of ndarray
            Derivative with respect to A (spot shifts in px per standard deviation of each motion), (D, M), and to R
            (covariance of the spot noise, px^2), (D, D), in the quantity's SI unit per px and per px^2, for D spot
            coordinates (row and column of every spot) and M motions.
        """
        prior, rows = self.disturbances, self.quantities[name]
        weights = rows @ self.gain
        residual = (weights @ prior.spots - rows @ prior.parameters) @ prior.correlation
        scale = 2.0 * self.sigma(name) * len(rows)
        return 2.0 * weights.T @ residual / scale, weights.T @ weights / scale

    def shares(self, name: str, measured: bool = True) -> dict[str, float]:
        """Return cause -> its contribution to the variance of a quantity, in SI units squared.

        A cause is a motion of the prior, or the noise of the images.

        The causes are independent, so that the contributions sum to the variance.

        Parameters
        ----------
        name : str
            Name of the quantity.
        measured : bool
            True for the posterior variance, including noise; False for the prior variance.
        """
        variances = self.splits[name]
        shares = Split.by(variances.after if measured else variances.before, self.disturbances.causes)
        out = {cause: float(np.mean(share)) for cause, share in shares.items()}
        return {**out, NOISE: float(np.mean(variances.noise))} if measured else out

    @property
    def spot_sigma(self) -> np.ndarray:
        """Prior standard deviations of the spot coordinates, (D,), in pixels.

        Dimensions: D spot coordinates (row and column of every spot).
        """
        return np.sqrt(np.diag(self.disturbances.spot_covariance))


def information_of(
    instrument: Instrument,
    prior: Sequence[DisturbancesSpec],
    detector: EmvaDetector,
    backend: Backend,
    ground: GroundGeometry | None = None,
    same_shape: bool = False,
    single: bool = True,
) -> list[Information]:
    """Return the Fisher information of an instrument's monitor spots, one for each prior of the motions.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    prior : sequence of DisturbancesSpec
        Disturbances files, each of which specifies a prior of the motions.
    detector : EmvaDetector
        Model of the area CCDs.
    backend : Backend
        Backend of the ray trace.
    ground : GroundGeometry | None
        Ground geometry of a stereo pair, which adds the height to the quantities.
    same_shape : bool
        True to assume the same noise for spots of one camera with the same beam width.
    single : bool
        True to compute images in single precision, as elsewhere; False (double) if they are differentiated.

    Raises
    ------
    InputError
        The disturbances name a body that the instrument does not have.
    BeamMissedError, AimError
        Light does not reach the area CCDs.
    """
    path, thermal = MonitorPath(instrument, backend), ThermalModel(instrument)
    noise, brightest = spot_noise(path, detector, same_shape, single)
    rows = quantity_rows(instrument, ground)
    return [
        Information(
            disturbances_of(prior_of_spec(spec, instrument), path, thermal, instrument, backend), noise, rows, brightest
        )
        for spec in prior
    ]


def quantity_rows(instrument: Instrument, ground: GroundGeometry | None) -> dict[str, np.ndarray]:
    """Return name of a quantity -> its coefficients on the parameters of all cameras, (n, 4 K).

    The quantities are d_alpha, d_beta, d_gamma (rad) and d_f (m) of every camera, as ``camera/d_alpha``; the
    intersection angle of the first two cameras (rad); and the height (m) at the line's centre.

    Dimensions: n linear combinations, over which the quantity's variance is averaged; K cameras with 4 parameters each.
    """
    names = list(instrument.cameras)
    unit = np.eye(_PARAMETERS * len(names))
    out = {
        f"{name}/{key}": unit[None, _PARAMETERS * c + k]
        for c, name in enumerate(names)
        for k, key in enumerate(("d_alpha", "d_beta", "d_gamma", "d_f"))
    }
    if len(names) > 1:
        out["angle"] = (unit[0] - unit[_PARAMETERS])[None]
    if ground is not None:
        first, second = (instrument.cameras[name].line_principal_distance for name in names[:2])
        rows = ground.rows((first, second))
        out["height"] = rows[len(rows) // 2, 2:3]
    return out


def ground_of(instrument: Instrument) -> GroundGeometry | None:
    """Return the ground geometry of a stereo pair of known altitude; None for other instruments.

    It is computed for the focal lengths along the pair's line CCDs.

    Raises
    ------
    InputError
        The rays of the pair do not intersect on the ground.
    """
    distances = {name: model.line_principal_distance for name, model in instrument.cameras.items()}
    return ground_geometry(instrument, distances)


def spot_noise(
    path: MonitorPath, detector: EmvaDetector, same_shape: bool = False, single: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise covariance of all spot shifts, and the signal of each spot's brightest pixel.

    The covariance of each spot is twice (images before and after) the Cramer-Rao bound of any unbiased fit of its
    image, with the light of its channel and the instrument's number of frames.

    Dimensions: D spot coordinates (row and column of every spot), C spots.

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    detector : EmvaDetector
        Model of the area CCDs.
    same_shape : bool
        True to assume the same shape, but not the same light, for spots of one camera with the same beam width.
    single : bool
        True to compute the images in single precision.

    Returns
    -------
    tuple of ndarray
        Covariance (D, D), in px^2, and signal of the brightest pixels (C,), as a fraction of saturation.

    Raises
    ------
    BeamMissedError, AimError
        Light does not reach the area CCDs.
    """
    channels = path.channels
    groups = {(c.camera, c.aperture) if same_shape else c.key: c for c in reversed(channels)}
    shown = tuple(c for c in channels if c in groups.values())
    shown_path = (
        path if len(shown) == len(channels) else MonitorPath(replace(path.instrument, channels=shown), path.backend)
    )
    photons = shown_path.expected_photons([{}], margin=_SLOPE, single=single)[0]
    images = []
    for channel in channels:
        representative = groups[(channel.camera, channel.aperture) if same_shape else channel.key]
        images.append(photons[shown.index(representative)] * (channel.photons / representative.photons))
    bounds, brightest = _image_bounds(np.stack(images)[None], path, detector)
    return joint(2.0 * bounds)[0], brightest[0]


def noise_as_built(path: MonitorPath, detector: EmvaDetector, states: Sequence[State]) -> np.ndarray:
    """Return the noise covariance of all spot shifts for S instruments as built, (S, D, D), in px^2.

    The covariance of each spot is twice the Cramer-Rao bound of its image. Both images, before and after, are those of
    the instrument as built.

    Dimensions: D spot coordinates (row and column of every spot).

    Parameters
    ----------
    path : MonitorPath
        Optical path of the monitor.
    detector : EmvaDetector
        Model of the area CCDs.
    states : sequence of State
        S states as built.

    Raises
    ------
    BeamMissedError, AimError
        Light does not reach the area CCDs, or no image can be computed.
    """
    bounds = [_image_bounds(photons, path, detector)[0] for _, photons in path.iterate_photons(states, margin=_SLOPE)]
    return joint(2.0 * np.concatenate(bounds))


def _image_bounds(photons: np.ndarray, path: MonitorPath, detector: EmvaDetector) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest covariance of each spot's position, (S, C, 2, 2) px^2, and its peak signal, (S, C).

    The covariance is the Cramer-Rao bound; the signal is that of the brightest pixel as a fraction of saturation. The
    images are wider than the CCD by ``_SLOPE`` pixels on every side.

    Dimensions: S states, C spots.
    """
    spec = path.instrument.spec.autocollimator
    exposure = spec.area_ccd.exposure
    model, dark = detector.noise_model(exposure), float(detector.expected_dn(np.zeros((1, 1)), exposure)[0, 0])
    bounds, brightest = np.zeros((*photons.shape[:2], 2, 2)), np.zeros(photons.shape[:2])
    for k in range(photons.shape[1]):
        light = detector.expected_dn(photons[:, k], exposure) - dark
        bounds[:, k] = image_bound(light, dark, model, spec.frames)
        brightest[:, k] = light.max(axis=(1, 2)) / (detector.saturation_dn - dark)
    return bounds, brightest
