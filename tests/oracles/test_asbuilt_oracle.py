"""Responses of wavefronts to motions, on which estimates of an instrument's state rest, against batoid's."""

import numpy as np
import pytest

from optics.geometry.pose import triple
from optics.geometry.tree import Motion
from scenes.specs.load import load_camera
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams

pytestmark = pytest.mark.oracle


OFF_AXIS = np.array([(-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, -1.0)])
SIZES = {"shift": 1e-6, "rotate": 1e-6, "figure": 1e-9, "radius": 1e-6, "conic": 1e-6}
MOTIONS = [
    *((f"M{k}", "shift", axis) for k in (1, 2, 3) for axis in "xyz"),
    *((f"M{k}", "rotate", axis) for k in (1, 2, 3) for axis in "xy"),
    *((f"M{k}", "radius", "") for k in (1, 2, 3)),
    ("M1", "figure", "Z7"),
    ("M3", "figure", "Z6"),
]


@pytest.mark.second
def test_derivatives_of_an_off_axis_pupil_as_by_batoid_and_an_own_fit(backend) -> None:
    """Rows of gf7's Z4 to Z11 at five fields for 20 motions, to 1e-3 of the largest of each row's motion.

    Batoid traces, and NumPy fits the terms at other nodes by least squares. It tells waves on planes, we on spheres
    about the image with the radius of the exit pupil.
    """
    optics = CameraOptics.alone(load_camera("gf7"), backend)
    beams = VariedBeams(optics, OFF_AXIS)
    rows = beams.zernike_rows(11)[:, 3:]
    pytest.importorskip("batoid")
    from tests.oracles.tolerance_peer import BatoidCamera

    peer = BatoidCamera(optics.model, OFF_AXIS)
    x, y = peer.nodes.points[1:].T
    r2 = x**2 + y**2
    terms = np.stack(
        [
            np.ones_like(x),
            x,
            y,
            np.sqrt(3.0) * (2.0 * r2 - 1.0),
            np.sqrt(6.0) * 2.0 * x * y,
            np.sqrt(6.0) * (x**2 - y**2),
            np.sqrt(8.0) * (3.0 * r2 - 2.0) * y,
            np.sqrt(8.0) * (3.0 * r2 - 2.0) * x,
            np.sqrt(8.0) * (3.0 * x**2 * y - y**3),
            np.sqrt(8.0) * (x**3 - 3.0 * x * y**2),
            np.sqrt(5.0) * (6.0 * r2**2 - 6.0 * r2 + 1.0),
        ],
        axis=-1,
    )
    weighted = terms * peer.nodes.share[:, None]
    fit = np.linalg.solve(terms.T @ weighted, weighted.T)[3:]
    for body, kind, axis in MOTIONS:
        size = SIZES[kind]
        states, theirs = [], []
        for amount in (size, -size):
            along = triple(amount if axis == one else 0.0 for one in "xyz")
            does = {"figure": {int(axis[1:]): amount}} if kind == "figure" else {kind: amount}
            states.append({f"camera/{body}": Motion(**({kind: along} if axis in tuple("xyz") else does))})
            theirs.append(-peer.waves({(body, kind, axis): amount}) @ fit.T)
        paths = beams.light(states).paths
        ours = np.einsum("ftn,sfn->sft", rows, paths)
        found, wanted = (ours[0] - ours[1]) / (2.0 * size), (theirs[0] - theirs[1]) / (2.0 * size)
        assert np.max(np.abs(wanted)) > 0.0
        np.testing.assert_allclose(
            found, wanted, rtol=0, atol=1e-3 * np.max(np.abs(wanted)), err_msg=f"{body} {kind} {axis}"
        )
