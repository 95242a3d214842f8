"""Reverse mode through a batch of systems against forward mode: <w, J s> both ways."""

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.numerics.number_tree import leaves
from optics.raytrace.derivatives import jvp, vjp
from optics.raytrace.system import assemble
from scenes.models.camera_model import collimated, field_direction

STEPS = [("M1", "rotate", 0), ("M2", "shift", 2), ("M3", "figure", 7), ("M3", "scale", 0), ("image", "rotate", 1)]
CURVATURE = ("surface", "curvature")
FIGURE = {"M3": Motion(figure={7: 1e-7})}


@pytest.fixture(scope="module")
def launch(gf7, backend) -> tuple[np.ndarray, np.ndarray]:
    """Rays of as many fields as there are steps: (B, N, 3) twice."""
    bare = gf7.bare_assembly(apertures=False)
    directions = np.array([field_direction(gf7.spec, 0.004 * k, 0.001 * k) for k in range(len(STEPS))])
    nodes = 0.8 * gf7.apertures["M2"].radius * np.random.default_rng(1).uniform(-0.7, 0.7, (40, 2))
    place = collimated(backend, assemble(bare, [gf7.mirrors[:2]]), directions, nodes)
    return place, np.broadcast_to(directions[:, None], place.shape)


def test_reverse_mode_is_the_transpose_of_forward_mode(gf7, backend, launch) -> None:
    """Each system has a motion, launch points and directions of its own; so nothing may leak between systems."""
    bare = gf7.bare_assembly()
    systems = assemble(bare, ["imaging"], [FIGURE] * len(STEPS), STEPS)
    place, heading = launch
    rng = np.random.default_rng(2)
    position_step, direction_step, weight = rng.normal(size=(3, *place.shape))
    pushed = jvp(backend, systems, place, heading, position_step, direction_step)
    steps = [leaves(tangents) for tangents in systems.tangents]
    names = [tuple(path for path, step in own.items() if np.any(step)) for own in steps]
    assert [len(own) > 0 for own in names] == [True] * 4
    pulled = vjp(backend, systems, place, heading, weight, names)

    forward = np.sum(weight * pushed.position, axis=(1, 2))
    reverse = np.sum(pulled.position * position_step + pulled.direction * direction_step, axis=(1, 2))
    for own, slopes, tangents in zip(names, pulled.values, steps, strict=True):
        assert set(slopes) == set(own)
        reverse = reverse + sum(slopes[name] * tangents[name] for name in own)
    # both sums have a few hundred terms of up to 10, rounded to 1e-16
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-11)
    assert np.all(np.abs(forward) > 0.1)


def test_only_what_is_asked_for(gf7, backend, launch) -> None:
    systems = assemble(gf7.bare_assembly(), ["imaging"], [{}] * len(STEPS))
    nothing = vjp(backend, systems, *launch, np.array([1.0, 0.0, 0.0]), [()] * 4)
    assert nothing.values == ({}, {}, {}, {})
    curvature = vjp(backend, systems, *launch, np.array([1.0, 0.0, 0.0]), [(CURVATURE,), (), (), ()])
    assert set(curvature.values[0]) == {CURVATURE}
    assert curvature.values[0][CURVATURE].shape == (len(STEPS),)
    np.testing.assert_allclose(curvature.position, nothing.position, rtol=1e-12)
