"""What the light of a layout can know: information and posterior covariance of all parameters, from the traced
derivatives of the stated disturbances and the light of every spot.

The M motions x ~ N(0, C), in standard deviations, move the spots by A x and the cameras by B x. Spots with noise R hold
the Fisher information A' R^-1 A on them; what is left of the cameras' parameters is B (C^-1 + A' R^-1 A)^-1 B', which
equals B C B' - B C A' (A C A' + R)^-1 A C B' also where C is singular.
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
from scenes.models.disturbances import motions_of_spec
from scenes.models.instrument_model import Instrument
from scenes.models.thermal_model import ThermalModel
from scenes.specs.disturbances import DisturbancesSpec
from twin.monitor.monitor_derivative import disturbances_of
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import ground_geometry
from twin.sensors.area_detector import EmvaDetector

NOISE = "noise"
"""What the images add beside the stated causes."""
_SLOPE = 2  # pixels more on every side of an image, for its slopes
_PARAMETERS = 4


@dataclass(frozen=True, eq=False)
class Information:
    """What a layout's spots know of its cameras.

    Attributes
    ----------
    disturbances : Disturbances
        Stated, with their derivatives: D spot coordinates, K cameras.
    noise : np.ndarray
        (D, D) px^2 of the shifts, of the images before and after together.
    quantities : Mapping[str, np.ndarray]
        Name -> (n, 4 K) rows on all parameters; the quantity's variance is the mean of the rows'.
    brightest : np.ndarray
        (C,) expected light of every spot's brightest pixel, as a share of what a pixel can hold.
    """

    disturbances: Disturbances
    noise: np.ndarray
    quantities: Mapping[str, np.ndarray]
    brightest: np.ndarray

    @cached_property
    def gain(self) -> np.ndarray:
        """(4 K, D) of the estimate with the least variance, rad and m per pixel."""
        return self.disturbances.best_gain(self.noise)

    @cached_property
    def splits(self) -> Mapping[str, Split]:
        """Quantity -> its variances by motions, SI."""
        return {name: split(rows, self.disturbances, self.noise, self.gain) for name, rows in self.quantities.items()}

    def sigma(self, name: str) -> float:
        """What is left of a quantity, SI."""
        return float(np.sqrt(np.mean(self.splits[name].sigma ** 2)))

    def sigma_before(self, name: str) -> float:
        """Standard deviation of a quantity without any measurement, SI."""
        return float(np.sqrt(np.mean(self.splits[name].sigma_before ** 2)))

    def slopes(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of a quantity's sigma by A, (D, M), and by the noise R, (D, D); SI per pixel and per px^2.

        The gain is the one of least variance, so that its own change does not count: with w = gain' row the variance
        changes by 2 w' dA C (A' w - B' row) + w' dR w.
        """
        stated, rows = self.disturbances, self.quantities[name]
        weights = rows @ self.gain
        left = (weights @ stated.spots - rows @ stated.parameters) @ stated.correlation
        scale = 2.0 * self.sigma(name) * len(rows)
        return 2.0 * weights.T @ left / scale, weights.T @ weights / scale

    def shares(self, name: str, measured: bool = True) -> dict[str, float]:
        """Variance of a quantity by cause, SI; causes are independent of one another, so that shares add up.

        Parameters
        ----------
        name : str
            Of the quantity.
        measured : bool
            What is left of it, with the noise; else before any measurement.
        """
        found = self.splits[name]
        shares = Split.by(found.after if measured else found.before, self.disturbances.causes)
        out = {cause: float(np.mean(share)) for cause, share in shares.items()}
        return {**out, NOISE: float(np.mean(found.noise))} if measured else out

    @property
    def spot_sigma(self) -> np.ndarray:
        """(D,) standard deviations of the spots' places, px."""
        return np.sqrt(np.diag(self.disturbances.spot_covariance))


def information_of(
    instrument: Instrument,
    stated: Sequence[DisturbancesSpec],
    detector: EmvaDetector,
    backend: Backend,
    ground: GroundGeometry | None = None,
    alike: bool = False,
    single: bool = True,
) -> list[Information]:
    """What an instrument's spots know, one for each statement of what moves.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    stated : Sequence[DisturbancesSpec]
        Disturbances files.
    detector : EmvaDetector
        Of the area CCDs.
    backend : Backend
        Where to trace.
    ground : GroundGeometry | None
        Of a pair; the height is then one of the quantities.
    alike : bool
        Spots of one camera and one beam width are taken to have the same noise.
    single : bool
        Pictures of the spots in single precision, as all others; in double where they are differentiated.

    Raises
    ------
    InputError
        The disturbances name a body that the instrument does not have.
    BeamMissedError, AimError
        Light does not come to the area CCDs.
    """
    path, thermal = MonitorPath(instrument, backend), ThermalModel(instrument)
    noise, brightest = spot_noise(path, detector, alike, single)
    rows = quantity_rows(instrument, ground)
    return [
        Information(
            disturbances_of(motions_of_spec(spec, instrument), path, thermal, instrument, backend),
            noise,
            rows,
            brightest,
        )
        for spec in stated
    ]


def quantity_rows(instrument: Instrument, ground: GroundGeometry | None) -> dict[str, np.ndarray]:
    """Name -> (n, 4 K) rows: every camera's d_alpha, d_beta, d_gamma (rad) and d_f (m) as ``camera/d_alpha``; the
    intersection angle of the first two cameras; height and plan (m) at the line's middle.
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
    """How a pair of known altitude sees the ground, by the focal lengths along its lines; None for other instruments.

    Raises
    ------
    InputError
        Its rays do not meet on the ground.
    """
    distances = {name: model.line_principal_distance for name, model in instrument.cameras.items()}
    return ground_geometry(instrument, distances)


def spot_noise(
    path: MonitorPath, detector: EmvaDetector, alike: bool = False, single: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of all shifts by the noise of images before and after, (D, D) px^2: of each spot twice the bound that
    no unbiased fit of its image can beat, with the light of its channel and the instrument's number of frames. And the
    share of what a pixel can hold that every spot's brightest one gets, (C,).

    Parameters
    ----------
    path : MonitorPath
        The monitor's light.
    detector : EmvaDetector
        Of the area CCDs.
    alike : bool
        Spots of one camera and one beam width are taken to have one shape; their light is their own.
    single : bool
        Pictures of the spots in single precision.

    Raises
    ------
    BeamMissedError, AimError
        Light does not come to the area CCDs.
    """
    channels = path.channels
    groups = {(c.camera, c.aperture) if alike else c.key: c for c in reversed(channels)}
    shown = tuple(c for c in channels if c in groups.values())
    own = path if len(shown) == len(channels) else MonitorPath(replace(path.instrument, channels=shown), path.backend)
    photons = own.expected_photons([{}], margin=_SLOPE, single=single)[0]
    images = []
    for channel in channels:
        like = groups[(channel.camera, channel.aperture) if alike else channel.key]
        images.append(photons[shown.index(like)] * (channel.photons / like.photons))
    bounds, brightest = _image_bounds(np.stack(images)[None], path, detector)
    return joint(2.0 * bounds)[0], brightest[0]


def built_noise(path: MonitorPath, detector: EmvaDetector, states: Sequence[State]) -> np.ndarray:
    """Covariance of all shifts by the noise of images, px^2, (S, D, D), as of ``spot_noise``, of instruments that are
    built as S states say: both images of each are its own.

    Parameters
    ----------
    path : MonitorPath
        The monitor's light.
    detector : EmvaDetector
        Of the area CCDs.
    states : Sequence[State]
        S of them.

    Raises
    ------
    BeamMissedError, AimError
        Light does not come to the area CCDs, or no image can be made of it.
    """
    found = [_image_bounds(photons, path, detector)[0] for _, photons in path.iterate_photons(states, margin=_SLOPE)]
    return joint(2.0 * np.concatenate(found))


def _image_bounds(photons: np.ndarray, path: MonitorPath, detector: EmvaDetector) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (S, C, 2, 2) px^2 of spots by their images (S, C, H, W) with the margin of ``_SLOPE``, and how full their
    brightest pixels are, (S, C).
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
