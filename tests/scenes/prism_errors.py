"""First order of what small turns of plane mirrors and windows do to a beam, from their normals alone."""

import numpy as np


def reflection(normal) -> np.ndarray:
    """Matrix of the reflection at a plane."""
    return np.eye(3) - 2.0 * np.outer(normal, normal)


def turn_by_mirrors(normals, turns) -> np.ndarray:
    """W with (mirrors in sequence, each turned by its small vector) = (1 + [W]) (the mirrors as they were), (3,).

    A mirror R turned by w reflects as Rot(w) R Rot(-w) = (1 + 2 [w']) R with w' the part of w in its plane. Carried
    through the mirrors after it, with S their product, this becomes 2 det(S) S w'.
    """
    after, whole = np.eye(3), np.zeros(3)
    for normal, turn in zip(reversed(normals), reversed(turns), strict=True):
        normal = np.asarray(normal)
        along = turn - (turn @ normal) * normal
        whole += 2.0 * np.linalg.det(after) * after @ along
        after = after @ reflection(normal)
    return whole


def seen_outside(turn, beam, index: float) -> np.ndarray:
    """Turn of a beam in air when it is turned inside glass that it enters or leaves square to its face, (3,)."""
    along = (turn @ beam) * beam
    return along + index * (turn - along)
