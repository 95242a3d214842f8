"""Paper 004, section 1.2: which of the six parameters of the focal-plane assembly the adjustments change together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.units import ARCSEC
from optics.pose import Pose
from optics.rotation import rotation_matrix
from twin.laboratory.focus import line_turn, mount_of
from twin.laboratory.focus_bench import FocusBench
from twin.validation.check import Check, CheckResult
from twin.validation.chosen import Chosen

Array = NDArray[np.float64]
PARAMETERS = ("Δα", "Δβ", "Δγ", "Δx", "Δy", "Δz")
ADJUSTMENTS = ("tilt about the surface's x", "tilt about its y", "turn in it", "slide along x", "slide along y", "lift")
"""Tilts and lift by shims, the others by hand."""
LIMITS = np.array([10.0 * ARCSEC, 10.0 * ARCSEC, 10.0 * ARCSEC, 7e-6, 7e-6, 5e-6])
"""What counts as a change: the theodolite's 10 arcsec, a panchromatic pixel, a step of the shims."""


def effects(bench: FocusBench, inclined: float = 1.0) -> Array:
    """Change of each parameter (6) by each adjustment (6), as far as the assembly is mis-set: radians and metres.

    Δα, Δβ and Δz are those of the plane through the traced defocus of all sites; Δγ is the line's turn, Δx and Δy where
    its middle goes.

    Args:
        bench: with the mount.
        inclined: factor on the inclination of the mounting surface.
    """
    test = bench.setup.test
    surface = test.mount.model_copy(update={"tilt": inclined * test.mount.tilt})
    mount = mount_of(test.model_copy(update={"mount": surface}))
    up, centre = mount.normal, mount.holes.mean(axis=0)
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    size_turn, size_shift = np.array(test.misset.rotate), np.array(test.misset.shift)
    none = np.zeros(3)
    steps = [(size * axis, none) for size, axis in zip(size_turn, (x, y, up), strict=True)]
    steps += [(none, size * axis) for size, axis in zip(size_shift, (x, y, up), strict=True)]
    start = _parameters(bench, Pose(np.eye(3), none))
    out = []
    for turn, shift in steps:
        rotation = rotation_matrix(turn)
        pose = Pose(rotation, centre - rotation @ centre + shift)
        out.append(_parameters(bench, pose) - start)
    return np.array(out)


def _parameters(bench: FocusBench, pose: Pose) -> Array:
    defocus = np.array([site.defocus(pose, 0.0) for site in bench.sites])
    places = np.array([site.place for site in bench.sites])
    piston, slope_x, slope_y = np.linalg.lstsq(np.column_stack([np.ones(len(places)), places]), defocus)[0]
    # a rotation (a, b, c) lifts a point by a Y' - b X'
    return np.array([slope_y, -slope_x, line_turn(pose), *pose.translation[:2], piston])


def judge_coupling(check: Check, bench: FocusBench) -> CheckResult:
    """How many parameters no adjustment of the mount changes alone."""
    change = effects(bench)
    seen = np.abs(change) > LIMITS
    text = "; ".join(
        f"{name} changes {', '.join(p for p, s in zip(PARAMETERS, row, strict=True) if s)}"
        for name, row in zip(ADJUSTMENTS, seen, strict=True)
    )
    lost = change[0, 2] / change[0, 0]
    how = (
        "Exact motions of the assembly on its mount, by as much as it is mis-set, and the traced defocus of "
        f"{len(bench.sites)} sites: {text}. A tilt about the surface's x costs the line {abs(lost):.2f} of it in "
        "level. Counted is what exceeds 10″, a pixel of 7 µm, or a shim step of 5 µm. The inclination of the mounting "
        f"surface, {np.degrees(bench.setup.test.mount.tilt):g}°, and its distance from the focal plane are assumed, "
        "for the paper prints neither. About one axis it couples two families of three, not all six with each other."
    )
    inclination = Chosen(
        "inclination of the mounting surface", float(np.degrees(bench.setup.test.mount.tilt)), "deg",
        lambda factor: _coupled(effects(bench, factor)),
    )  # fmt: skip
    return check.judge(_coupled(change), None, how, inputs=[inclination])


def _coupled(change: Array) -> float:
    """How many parameters change together with another one."""
    seen = np.abs(change) > LIMITS
    return float(np.sum(np.any(seen & (seen.sum(axis=1) > 1)[:, None], axis=0)))
