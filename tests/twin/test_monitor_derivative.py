"""Derivatives from a body's motion to the pixels, by AD through tree, trace and diffraction, against differences; and
the gradient of the spots by reverse mode, against forward mode and differences of exact traces.
"""

from collections.abc import Callable, Sequence

import drjit as dr
import numpy as np
import pytest

from optics.geometry.tree import ORIGIN, Motion, State
from scenes.specs.instrument import BASE
from twin.monitor.monitor_derivative import spot_gradient, spot_jacobian
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import FIGURE_TERMS, ElementaryMotion, line_family, other_motions

pytestmark = pytest.mark.second


@pytest.fixture(scope="module")
def path(gf7_pair, backend):
    return MonitorPath(gf7_pair, backend)


def kernels(path, motions):
    """Hashes of the kernels that the derivatives by these motions run."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        spot_jacobian(path, motions)
        return {kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel}


def test_derivatives_by_any_motions_take_the_same_kernels(path):
    """With figures or without: to compile another set of kernels takes seconds."""
    plain, figured = line_family("backward"), (ElementaryMotion(f"{BASE}/backward/M2", "figure", 8),)
    spot_jacobian(path, plain)  # works out what the path keeps
    assert kernels(path, plain) == kernels(path, (*figured, *plain)) != set()


CAMERAS = ("forward", "backward")
CAP = {"shift": 1e-3, "rotate": 3e-4, "scale": 1e-3, "figure": 1e-6}
"""Largest steps: they move the beam on the mirrors by a few millimetres at most."""
MOVE = 2.0
"""By how many pixels a step moves a spot; the CCDs have room for some ten."""
SPOT_ROUNDING = 5e-10
"""Rounding of a traced spot, px: metres are rounded to 1e-16 of themselves at each of 26 surfaces, which is 5e-15 m in
all, and a pixel has 12 um."""
SEEN = 2e-3
"""A motion whose step moves a spot by more than this, px, can be measured to 1e-6 above the rounding."""


@pytest.fixture(scope="module")
def coarse(path):
    return path.coarse


@pytest.fixture(scope="module")
def motions(gf7_pair) -> tuple[ElementaryMotion, ...]:
    """Shifts, turns and scale of every body, about the middle of mirrors, and their low Zernike figures."""
    out = []
    mirrors = {e.body for e in gf7_pair.assembly.elements.values() if not e.surface.is_plane}
    for body in gf7_pair.assembly.tree.bodies:
        pivot = "centre" if body.path in mirrors else ORIGIN
        kinds = {"shift": range(3), "rotate": range(3), "scale": range(1)}
        kinds |= {"figure": FIGURE_TERMS} if body.path in mirrors else {}
        out += [ElementaryMotion(body.path, kind, axis, pivot) for kind, axes in kinds.items() for axis in axes]
    return tuple(out)


@pytest.fixture(scope="module")
def gradient(coarse, motions) -> np.ndarray:
    return spot_gradient(coarse, motions)


def spots(coarse: MonitorPath, states: Sequence[State], chunk: int = 400) -> np.ndarray:
    """Mean of the rays, rows and columns in px, (S, C, 2)."""
    out = []
    for start in range(0, len(states), chunk):
        some = states[start : start + chunk]
        mean = np.einsum("n,bnk->bk", coarse.nodes.share, coarse.rays(some).position[..., 1::-1]) / coarse.pitch
        out.append(np.swapaxes(mean.reshape(len(coarse.channels), len(some), 2), 0, 1))
    return np.concatenate(out)


def steps_for(exact: np.ndarray, motions: Sequence[ElementaryMotion]) -> np.ndarray:
    """A step for each motion (M,), by how far it moves the spots."""
    size = np.abs(exact).max(axis=(0, 1))
    return np.minimum(MOVE / np.maximum(size, 1e-30), [CAP[m.kind] for m in motions])


def differences(
    coarse: MonitorPath,
    state: Callable[[ElementaryMotion, float], State],
    motions: Sequence[ElementaryMotion],
    h: np.ndarray,
) -> np.ndarray:
    """Central differences extrapolated from steps h and h / 2 to zero, (C, 2, M)."""
    sizes = (1.0, -1.0, 0.5, -0.5)
    at = spots(coarse, [state(m, s * step) for m, step in zip(motions, h, strict=True) for s in sizes])
    at = np.moveaxis(at.reshape(len(motions), 4, *at.shape[1:]), 0, -1)
    wide, narrow = (at[0] - at[1]) / (2.0 * h), (at[2] - at[3]) / h
    return np.asarray((4.0 * narrow - wide) / 3.0)


def test_it_is_what_forward_mode_gives(coarse, motions, gradient, gf7_pair) -> None:
    """Same derivative, other order of summation: rounding only, of terms as large as the camera's turn makes."""
    some = [m for name in CAMERAS for m in (*line_family(name), *other_motions(gf7_pair, name))]
    place = {m.step: k for k, m in enumerate(motions)}
    reverse, forward = gradient[..., [place[m.step] for m in some]], spot_jacobian(coarse, some)
    size = np.abs(forward).max(axis=(0, 1))
    # a camera's shift moves its mirrors and its focal plane by 1e5 px/m each, which cancels to some px/m
    terms = np.maximum(size, 1e4)
    assert np.all(np.abs(reverse - forward).max(axis=(0, 1)) < 1e-10 * np.where(size > 1.0, size, terms))
    assert np.count_nonzero(size > 1.0) > 85


def check_differences(coarse, motions: Sequence[ElementaryMotion], exact: np.ndarray) -> int:
    """Compare with differences; returns how many motions move a spot enough for six digits."""
    h = steps_for(exact, motions)
    measured = differences(coarse, lambda m, step: m.state(step), motions, h)
    size = np.abs(exact).max(axis=(0, 1))
    error = np.abs(measured - exact).max(axis=(0, 1))
    seen = size * h > SEEN
    assert np.all(error[seen] < 1e-6 * size[seen])
    # a rounding in each of four spots, weighed by 4/3 and 1/3: of the others the derivative is right to that
    assert np.all(error[~seen] * h[~seen] < 2.0 * SPOT_ROUNDING)
    return int(np.count_nonzero(seen))


def test_it_is_what_the_spots_do(coarse, motions, gradient) -> None:
    """Every third motion of all parts: three of the seven kinds of each, others for the next part."""
    own = range(0, len(motions), 3)
    assert check_differences(coarse, [motions[k] for k in own], gradient[..., own]) > 60


def test_about_a_perturbed_state(coarse) -> None:
    """Derivatives by components of motions that are not zero: of a rotation vector, which does not just turn."""
    plane, mirror = f"{BASE}/forward/focal_plane", f"{BASE}/forward/M3"
    about = {
        plane: Motion(rotate=(1e-4, -2e-4, 3e-4), shift=(2e-6, 0.0, 1e-5)),
        mirror: Motion(rotate=(0.0, 2e-6, 1e-4), pivot="centre", figure={5: 2e-7}, scale=1e-5),
    }
    components = [
        *(ElementaryMotion(plane, "rotate", axis) for axis in range(3)),
        *(ElementaryMotion(mirror, "rotate", axis, "centre") for axis in range(3)),
        ElementaryMotion(mirror, "scale", 0, "centre"),
        ElementaryMotion(mirror, "figure", 5, "centre"),
        ElementaryMotion(mirror, "figure", 8, "centre"),
        ElementaryMotion(f"{BASE}/backward/M1", "shift", 0),
    ]

    def moved(motion: ElementaryMotion, amount: float) -> State:
        start, more = about.get(motion.body, Motion()), motion.motion(amount)
        triples = {
            kind: tuple(a + b for a, b in zip(getattr(start, kind), getattr(more, kind), strict=True))
            for kind in ("rotate", "shift")
        }
        figure = {j: start.figure.get(j, 0.0) + more.figure.get(j, 0.0) for j in {*start.figure, *more.figure}}
        new = Motion(**triples, scale=start.scale + more.scale, figure=figure, pivot=motion.pivot)
        return {**about, motion.body: new}

    exact = spot_gradient(coarse, components, about)
    size = np.abs(exact).max(axis=(0, 1))
    h = steps_for(exact, components)
    error = np.abs(differences(coarse, moved, components, h) - exact).max(axis=(0, 1))
    assert np.all(size * h > SEEN)
    assert np.all(error < 1e-6 * size)
    changed = np.abs(exact - spot_gradient(coarse, components)).max(axis=(0, 1))
    assert np.count_nonzero(changed > 1e-5 * size) >= 5  # the state is not the nominal one


def test_another_pivot_than_the_states_is_refused(coarse) -> None:
    body = f"{BASE}/forward/M1"
    about = {body: Motion(rotate=(1e-6, 0.0, 0.0), pivot="centre")}
    with pytest.raises(ValueError, match=r"base/forward/M1 moves about 'centre'"):
        spot_gradient(coarse, [ElementaryMotion(body, "rotate", 0)], about)
    with pytest.raises(ValueError, match="a rotate, shift, scale or figure, not a 'bend'"):
        ElementaryMotion(body, "bend").state(1e-6)
