"""Designs beside scipy's least squares on batoid: three problems, ten random starts of each, the same for both."""

import numpy as np
import pytest

from optics.design.design_variables import Variable
from optics.design.merit_function import Operands
from optics.design.optimiser import judged
from optics.design.starts import drawn_start
from scenes.models.camera_design import beams_of, prescription_of

pytest.importorskip("batoid")
from tests.oracles.design_peer import judge

pytestmark = pytest.mark.oracle

PROBLEMS = {
    # name of a camera: what varies, envelope, clearance
    "gf7": ("M1 curvature conic A4 A6, M2 z curvature A4 A6, M3 z curvature conic A4 A6, image z", 0.798, 0.02),
    "gf7_conic": ("M1 curvature conic A4, M2 z curvature conic A4, M3 z curvature conic A4, image z", 0.9, 0.02),
    "monitor": ("M1 curvature conic A4, M2 z curvature conic A4, M3 z curvature conic A4, image z", 0.95, 0.02),
}


def posed(backend, spec):
    """Merit function, the camera's prescription and evaluation, variables."""
    vary, envelope, clearance = PROBLEMS[spec.name]
    variables = tuple(
        Variable(name, quantity) for part in vary.split(", ") for name, *own in [part.split()] for quantity in own
    )
    nominal, beams = prescription_of(spec), beams_of(spec)
    _, free = judged(backend, nominal, variables, beams, Operands(spec.wavelength))
    operands = Operands(spec.wavelength, free.principal_distance, envelope * free.envelope, clearance, spec.edge_margin)
    merit, before = judged(backend, nominal, variables, beams, operands)
    return merit, nominal, before, variables


@pytest.mark.parametrize("name", PROBLEMS)
def test_one_merit_function(backend, camera, name: str) -> None:
    """Wavefronts and envelope of both, to what batoid's differences leave of the aim: 1e-8 waves."""
    merit, nominal, before, variables = posed(backend, camera(name).spec)
    found = judge(merit, nominal)
    assert found is not None
    np.testing.assert_allclose(found.errors, before.errors, atol=1e-7)
    assert found.envelope == pytest.approx(before.envelope, abs=1e-10)
    drawn = drawn_start(merit, nominal, variables, np.random.default_rng(3))
    found = judge(merit, drawn)
    assert found is not None
    np.testing.assert_allclose(found.errors, merit.evaluate(drawn).errors, rtol=1e-6)
