"""What is known of the passes of a block, as the analysis has it: laws, cameras before and after their readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from analysis.block.block import CameraKnowledge, CamerasKnowledge, Term
from analysis.block.processes import Law
from scenes.specs.orbit.adjust import CameraChangeSpec, LawSpec
from scenes.specs.orbit.calibration import CameraDriftSpec, MonitorReadingSpec

MonitorSource = Callable[[Mapping[str, str], Sequence[str]], CamerasKnowledge]
"""Epochs of passes, UTC, and lines -> what a record of the monitor says of the lines' cameras in these passes."""


def law_of(name: str, spec: LawSpec) -> Term:
    """A stated law as the analysis has it."""
    sigma: tuple[float, float, float] = spec.sigma  # type: ignore[attr-defined]
    return Term(Law(name, spec.law, sigma, spec.interval, spec.time or 0.0, spec.frequency or 0.0), spec.shared_by)


def camera_sigmas(spec: CameraDriftSpec | MonitorReadingSpec) -> np.ndarray:
    """(4,) of d_alpha, d_beta, d_gamma, radians, and d_f, metres."""
    return np.array([*spec.angles, spec.principal_distance])


def change_covariance(spec: CameraChangeSpec, days: np.ndarray) -> np.ndarray:
    """(4 T, 4 T) of a camera's changes in passes at so many days (T,) from the first."""
    lasting, each, walk = (np.diag(camera_sigmas(s) ** 2) for s in (spec.lasting, spec.each_pass, spec.walk))
    one = np.ones((len(days), len(days)))
    earlier = np.minimum(days[:, None], days)
    return np.asarray(np.kron(one, lasting) + np.kron(np.eye(len(days)), each) + np.kron(earlier, walk))


def monitored_camera(law: np.ndarray, reading: np.ndarray, sigma: np.ndarray) -> CameraKnowledge:
    """A camera's changes after the monitor's readings.

    Args:
        law: covariance before them, (4 T, 4 T).
        reading: of the changes, (4 T,), radians and metres.
        sigma: of the readings, (4 T,); infinite where there is none.
    """
    use = np.flatnonzero(np.isfinite(sigma))
    gain = law[:, use] @ np.linalg.inv(law[np.ix_(use, use)] + np.diag(sigma[use] ** 2))
    rest = law - gain @ law[use]
    return CameraKnowledge((gain @ reading[use]).reshape(-1, 4), 0.5 * (rest + rest.T))
