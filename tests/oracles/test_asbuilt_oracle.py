"""Responses of wavefronts to motions, on which estimates of an instrument's state rest, against batoid's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix, triple
from optics.geometry.tree import Motion, State
from scenes.models.camera_model import field_direction
from scenes.specs.load import load_camera
from tests.oracles.test_telescopes import LSST, OVER, batoids_telescope
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams

pytest.importorskip("batoid", reason="batoid not installed (extra `oracles`)")

import batoid

from tests.oracles.tolerance_peer import BatoidCamera

pytestmark = pytest.mark.oracle

CAMERA = "LSST.LSSTCamera"
IN_CAMERA = (*(f"camera/L{k}" for k in range(1, 9)), "camera/focal_plane")
FIELDS = np.array([(0.0, 0.0), (0.4, 0.0), (0.0, 0.4), (-0.3, 0.3)])
"""Within the part of the field in which nothing but M1's rim and its hole limits the light."""
SHIFT, TURN = 2e-6, 1e-6


def rigid(
    optics: CameraOptics, bodies: tuple[str, ...], turn: np.ndarray, shift: np.ndarray, about: np.ndarray
) -> State:
    """Bodies that move as one: a rotation vector and a shift in the world, about a point of it."""
    out = {}
    for body in bodies:
        pose = optics.assembly.nominal_pose(body)
        arm = pose.translation - about
        away = rotation_matrix(turn) @ arm - arm + shift
        out[body] = Motion(rotate=triple(pose.rotation.T @ turn), shift=triple(pose.rotation.T @ away))
    return out


@pytest.fixture(scope="module")
def lsst(backend) -> tuple[CameraOptics, Any, VariedBeams]:
    optics = batoids_telescope(backend, *LSST)
    peer = batoid.Optic.fromYaml(str(Path(batoid.__file__).parent / "data" / LSST[0]))
    return optics, peer, VariedBeams(optics, FIELDS)


@pytest.mark.second
@pytest.mark.parametrize("kind", ["shift", "turn"])
@pytest.mark.parametrize("part", ["M2", "camera"])
def test_rigid_motions_of_lsst_in_annular_terms_as_batoids(lsst, part, kind) -> None:
    """Annular Z4 to Z11 at four fields for each motion of M2 and of the camera, within 1 % of the largest of each.

    Batoid fits rays of a square grid, which is right to some 0.2 % of a term.
    """
    optics, peer, beams = lsst
    name = "M2" if part == "M2" else CAMERA
    bodies = ("camera/M2",) if part == "M2" else IN_CAMERA
    origin = np.array(peer[name].coordSys.origin) - np.array(peer["M1"].coordSys.origin)
    frame = optics.model.camera_frame.rotation
    about = optics.assembly.nominal_pose("camera/M1").translation + (OVER * origin) @ frame
    rows = beams.zernike_rows(11)[:, 3:]
    eps = optics.wavefront((0.0, 0.0)).hole
    spec = optics.model.spec
    for axis in np.eye(3)[: 3 if kind == "shift" else 2]:
        step = SHIFT if kind == "shift" else TURN
        ours = []
        for sign in (1.0, -1.0):
            move = sign * step * (OVER * axis) @ frame
            pair = (np.zeros(3), move) if kind == "shift" else (move, np.zeros(3))
            ours.append(rigid(optics, bodies, *pair, about))
        paths = beams.light(ours).paths
        found = np.einsum("ftn,sfn->sft", rows, paths)
        slope = (found[0] - found[1]) / (2.0 * step)
        theirs = []
        for x, y in FIELDS:
            heading = OVER * field_direction(spec, x * spec.field.x, y * spec.field.y)
            angle = batoid.utils.dirCosToField(*heading, projection="postel")
            both = []
            for sign in (1.0, -1.0):
                if kind == "shift":
                    moved = peer.withGloballyShiftedOptic(name, (sign * step * axis).tolist())
                else:
                    turned = rotation_matrix(sign * step * axis)
                    moved = peer.withLocallyRotatedOptic(name, turned)
                both.append(batoid.zernike(moved, *angle, LSST[1], jmax=11, eps=eps, nx=128)[4:])
            theirs.append((both[0] - both[1]) * LSST[1] / (2.0 * step))
        # y of the stop runs against batoid's, so that terms of odd order in it change their sign
        odd = np.array([1, -1, 1, -1, 1, -1, 1, 1])
        wanted = np.array(theirs)
        assert np.max(np.abs(wanted)) > 1e-4
        np.testing.assert_allclose(slope * odd, wanted, rtol=0, atol=0.01 * np.max(np.abs(wanted)), err_msg=str(axis))


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
