"""Responses of wavefronts to motions, on which estimates of an instrument's state rest, against batoid's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.pose import rotation_matrix, triple
from optics.geometry.tree import Motion, State
from scenes.models.camera_model import field_direction
from tests.oracles.test_telescopes import LSST, OVER, batoids_telescope
from twin.camera.camera_optics import CameraOptics
from twin.camera.varied_beams import VariedBeams

batoid = pytest.importorskip("batoid", reason="batoid not installed (extra `oracles`)")
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
        paths, _ = beams.paths(ours)
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
