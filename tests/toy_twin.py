"""What another distribution adds to tables of the twin; tests copy this module and say so in its entry points."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from analysis.monitor.estimators import Formula, PerCameraEstimator
from analysis.monitor.parameters import CameraCalibration
from analysis.spots import CENTROIDS, Centroid
from optics.geometry.vector_shape import Polygon
from optics.numerics.number_tree import FrozenMap
from optics.targets.target_shapes import Target

BAR = (8, 60)
"""Width and length of the toy target, pixels."""
DERIVED = Formula("derived", "")
"""The corrected formulas themselves."""


@dataclass(frozen=True)
class TwoLevels:
    """Half of the pixels read too high, half too low, by as many electrons: a fixed pattern that is not normal."""

    step_e: float

    @property
    def fixed_variance_e2(self) -> float:
        return self.step_e**2

    def temporal_variance_e2(self, electrons: Any) -> float:
        return 0.0

    def fixed_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        return self.step_e * (2.0 * rng.integers(0, 2, shape) - 1.0)

    def temporal_e(self, electrons: np.ndarray, rng: np.random.Generator) -> None:
        return


class Half(PerCameraEstimator):
    """Half of what the corrected formulas say."""

    title = "half"
    note = "half of what derived says"

    def camera_gain(self, camera: CameraCalibration, covariance: np.ndarray) -> np.ndarray:
        return 0.5 * DERIVED.camera_gain(camera, covariance)


AGAIN = Centroid("the energy centroid by another name", lambda *spots: CENTROIDS["energy"].measure(*spots))


def one_bar(pitch: float, region: int) -> Target:
    half = 0.5 * pitch * np.array(BAR)
    return Target(0.0, ((1.0, Polygon(half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))),))


@dataclass(frozen=True)
class Cylinder:
    """A circular cylinder about the y axis, z = c x^2 / (1 + sqrt(1 - c^2 x^2)); ``step`` is a slope, to have a number
    without unit.
    """

    POWERS: ClassVar[Mapping[str, int]] = FrozenMap(curvature=-1, step=0)
    curvature: Any = 0.0
    step: Any = 0.0

    def sag(self, x: Any, y: Any) -> Any:
        c = self.curvature
        return c * x * x / (1.0 + np.sqrt(1.0 - (c * x) ** 2)) + self.step * y

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        import drjit as dr

        c = self.curvature
        root = dr.sqrt(dr.maximum(1.0 - (c * x) ** 2, 1e-6))
        return c * x * x / (1.0 + root) + self.step * y, c * x / root, self.step + 0.0 * y
