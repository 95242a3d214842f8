"""Stated motions of made-up instruments, and noise of their spots."""

from dataclasses import dataclass

import numpy as np

from analysis.monitor.disturbances import Disturbances, TimeLaw


def correlation_of(rng: np.random.Generator, laws: tuple[TimeLaw, ...]) -> np.ndarray:
    """Return a correlation matrix (M, M) in which motions of one law go together at random."""
    out = np.eye(len(laws))
    for law in dict.fromkeys(laws):
        own = np.flatnonzero([one == law for one in laws])
        root = rng.normal(size=(len(own), len(own)))
        block = root @ root.T + np.eye(len(own))
        size = np.sqrt(np.diag(block))
        out[np.ix_(own, own)] = block / size[:, None] / size
    return out


def disturbances(laws, spots, parameters, labels=None, correlation=None, sigmas=None, **more) -> Disturbances:
    """Return stated motions of these laws with the derivatives (D, M) of spots and (P, M) of parameters.

    A body is the first word of a label. Without a correlation the motions are independent.
    """
    count = len(laws)
    names = tuple(f"body{k} shift x" for k in range(count)) if labels is None else tuple(labels)
    correlation = np.eye(count) if correlation is None else correlation
    sizes = np.ones(count) if sigmas is None else np.asarray(sigmas, float)
    bodies, causes, units = tuple(name.split()[0] for name in names), ("mounts",) * count, ("um",) * count
    return Disturbances("toy", names, bodies, causes, sizes, units, spots, parameters, correlation, tuple(laws), **more)


@dataclass(frozen=True)
class SpotNoise:
    """Noise of a series of images: of each image alone, and of the reference that all are counted from; (D, D) px^2."""

    own: np.ndarray
    shared: float | np.ndarray = 0.0

    def covariance(self, images: np.ndarray) -> np.ndarray:
        return np.kron(np.eye(len(images)), self.own) + np.kron(np.ones((len(images),) * 2), self.shared + 0 * self.own)
