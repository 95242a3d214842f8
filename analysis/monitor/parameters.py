"""Calibration of a monitor, and the quantities that are read from it.

The quantities that the monitor reads are declared here once; a further one is added here. Files, tables, figures, the
terminal, scripts, studies and the live page take keys, symbols, meanings and digits from here
(`twin.monitor.reading_table`), and budgets take their coefficients on the camera parameters
(`analysis.monitor.limits.quantities`).

The calibration contains what is known of the nominal instrument on the ground before launch: all that the analysis of
the images may use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from analysis.arrays import ARCSEC, UM_PER_M, Array, shows
from analysis.monitor.monitor_formulas import GroundGeometry, MonitorGeometry, coefficients
from analysis.spots.noise import NoiseModel
from analysis.spots.spot_template import SpotTemplate
from optics.numerics.extension_table import ExtensionTable

PAIR = ("left", "right")
"""Names of the channels at the +Y and at the -Y end of a line, which paper 001 (Wang et al. 2018) numbers 1 and 2."""


@shows()
@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibration of one camera's monitor.

    Attributes
    ----------
    geometry : MonitorGeometry
        Geometry for the formulas of paper 001 (Wang et al. 2018).
    look_rad : float
        Nominal look angle about the base's Y, rad.
    spot_jacobian : (2 n, P) ndarray
        Shift of the camera's n spots, row and column of one after the other, px per unit of motion.
    parameter_jacobian : (4, P) ndarray
        Change of d_alpha, d_beta, d_gamma (rad), d_f (m) per unit of motion.
    motions : tuple of str
        Names of the P motions that the `model` estimator assumes.
    channels : tuple of str
        Names of the camera's channels, in the order of its spots.

    Examples
    --------
    Both spots move by one column when the camera rotates by -2.5 urad about its Y:

    >>> import numpy as np
    >>> import analysis
    >>> geometry = analysis.MonitorGeometry(principal_distance_m=2.0, separation_m=0.2, pitch_m=10e-6)
    >>> camera = analysis.CameraCalibration.from_geometry(geometry)
    >>> np.round(camera.spot_jacobian @ [-2.5e-6, 0, 0, 0], 6) + 0.0
    array([0., 1., 0., 1.])
    >>> camera.channels, camera.pair
    (('left', 'right'), (0, 1))
    """

    geometry: MonitorGeometry
    look_rad: float
    spot_jacobian: Array
    parameter_jacobian: Array
    motions: tuple[str, ...]
    channels: tuple[str, ...] = PAIR

    @classmethod
    def from_geometry(cls, geometry: MonitorGeometry, look_rad: float = 0.0) -> CameraCalibration:
        """Return the calibration of a camera with a left and a right spot, by the derived formulas.

        Parameters
        ----------
        geometry : MonitorGeometry
            Principal distance, distance of the spots and pixel pitch.
        look_rad : float
            Nominal look angle of the camera about the base's Y, in radians, positive forward.
        """
        motions = ("rotation about Y", "rotation about X", "rotation about Z", "principal distance")
        spots = np.asarray(np.linalg.inv(coefficients("derived", geometry)), np.float64)
        return cls(geometry, look_rad, spots, np.eye(4), motions)

    @property
    def pair(self) -> tuple[int, int] | None:
        """Indices of the left and the right spot, which the printed formulas use; None without such a pair."""
        if not set(PAIR) <= set(self.channels):
            return None
        left, right = (self.channels.index(name) for name in PAIR)
        return left, right


@shows()
@dataclass(frozen=True, eq=False)
class MonitorCalibration:
    """Calibration of an instrument's monitor.

    Attributes
    ----------
    cameras : mapping of str to CameraCalibration
        Calibration of each camera, in the order of the spots, camera by camera.
    template : SpotTemplate
        Calibrated shapes of all spots, in that order.
    noise : NoiseModel
        Noise of the area CCDs.
    ground : GroundGeometry or None
        Geometry of a pair whose altitude is known.

    Examples
    --------
    One camera with two Gaussian spots; see `recover_monitor` for its use:

    >>> import numpy as np
    >>> import analysis
    >>> geometry = analysis.MonitorGeometry(principal_distance_m=2.0, separation_m=0.2, pitch_m=10e-6)
    >>> camera = analysis.CameraCalibration.from_geometry(geometry)
    >>> row, column = np.mgrid[:65, :65] - 32
    >>> shape = np.exp(-0.5 * (row**2 + column**2) / 2.0**2)
    >>> template = analysis.SpotTemplate.from_image(shape, row=32, column=32, shape=(33, 33))
    >>> noise = analysis.NoiseModel(gain_dn_per_e=0.1, dark_noise_e=20, offset_dn=200)
    >>> template = analysis.SpotTemplate.stack([template, template])
    >>> analysis.MonitorCalibration({"nadir": camera}, template, noise).spots
    2
    """

    cameras: Mapping[str, CameraCalibration]
    template: SpotTemplate
    noise: NoiseModel
    ground: GroundGeometry | None = None

    @property
    def spots(self) -> int:
        """Number of spots of all cameras."""
        return sum(len(camera.channels) for camera in self.cameras.values())


ANGLE_GROUP, GROUND_GROUP = "intersection_angle", "ground"
"""Keys, in result files, of changes computed from two cameras: their intersection angle, and ground errors.

Changes of one camera are under its name.
"""
_PER_SI: Mapping[str, float] = MappingProxyType(
    {"arcsec": 1 / ARCSEC, "m": 1.0, "mm": 1e3, "um": UM_PER_M, "nm": 1e9, "ppm": 1e6, "percent": 1e2}
)


@dataclass(frozen=True)
class Parameter:
    """Declaration of one quantity that the monitor reads of a camera, a pair or a ground point.

    Its true change is traced in simulations for comparison.

    Attributes
    ----------
    key : str
        Name in files of results, which ends in the unit.
    symbol : str
        Name in tables, figures and sentences.
    meaning : str
        Definition with its sign.
    decimals : int
        Number of decimals shown in the terminal.
    of : callable, tuple of float or None
        For a reading of one camera, its coefficients (4,) on d_alpha, d_beta, d_gamma and d_f, SI units per rad and m,
        or a function of the camera's calibration that returns them; None for a reading of two cameras together.
    """

    key: str
    symbol: str
    meaning: str
    decimals: int
    of: Callable[[CameraCalibration], ArrayLike] | tuple[float, ...] | None = None

    @property
    def file_unit(self) -> str:
        """Unit of the parameter as written in keys of files, such as ``um``."""
        return self.key.rpartition("_")[2]

    @property
    def unit(self) -> str:
        """Unit of the parameter as shown in tables and reports, such as ``µm``."""
        return self.file_unit.replace("um", "µm")

    @property
    def label(self) -> str:
        """Head of the parameter's column in tables, with its unit: ``Δα [arcsec]``."""
        return f"{self.symbol} [{self.unit}]"

    @property
    def per_si(self) -> float:
        """Number of this parameter's units in one SI unit."""
        return _PER_SI[self.file_unit]


ESTIMATED = (
    Parameter(
        "d_alpha_arcsec", "Δα", "rotation of the camera about its Y, right-handed, perturbed minus nominal", 4,
        (1.0, 0.0, 0.0, 0.0),
    ),
    Parameter(
        "d_beta_arcsec", "Δβ", "rotation of the camera about its X, right-handed, perturbed minus nominal", 4,
        (0.0, 1.0, 0.0, 0.0),
    ),
    Parameter(
        "d_gamma_arcsec", "Δγ", "rotation of the camera about its Z, the line of sight, perturbed minus nominal", 3,
        (0.0, 0.0, 1.0, 0.0),
    ),
    Parameter(
        "d_f_um", "Δf", "change of the principal distance, in pixels of the line CCD, longer positive", 2,
        (0.0, 0.0, 0.0, 1.0),
    ),
)  # fmt: skip
"""Parameters that the estimators determine, in the order of a camera's vector: d_alpha, d_beta, d_gamma, d_f."""
CAMERA_PARAMETERS = ExtensionTable("camera_parameters", {item.key: item for item in ESTIMATED}, Parameter)
"""Quantities that the monitor reads of every camera, by their key in files.

The first four are the parameters that estimators determine; a further one is a linear combination of them, and its name
here is its key.
"""
ANGLE = Parameter("change_arcsec", "Δθ", "change of the angle between the cameras' lines of sight, opening positive", 4)
"""Change of the angle between the lines of sight of two cameras, as a quantity that the monitor reads."""
FOCUS = Parameter("focus_um", "focus", "amount of the motion in which readings of focus are expressed", 2)
"""Focus of a camera in operation, estimated from readings of focus in place of a monitor's."""
GROUND = (
    Parameter("along_m", "along", "error on the ground along the track", 3),
    Parameter("across_m", "across", "error on the ground across the track, to the right", 3),
    Parameter("height_m", "height", "error in height, up", 3),
)
"""Quantities of a pair on the ground: errors of points that are located as if the cameras had not changed."""


def rows_of(camera: CameraCalibration) -> Array:
    """Return the coefficients of a camera's readings on d_alpha, d_beta, d_gamma (rad) and d_f (m), (P, 4).

    They are in the units of the readings per radian and per metre.

    Dimensions: P readings of the camera.

    Parameters
    ----------
    camera : CameraCalibration
        Calibration of the camera.
    """
    made_of = ((parameter.per_si, parameter.of) for parameter in CAMERA_PARAMETERS.values() if parameter.of is not None)
    return np.array([unit * np.array(of(camera) if callable(of) else of) for unit, of in made_of])
