"""The camera under test as an optical assembly of its own; the world is the camera frame."""

from __future__ import annotations

from dataclasses import dataclass

from optics.assembly import Assembly
from optics.backend import Backend
from optics.element import Interaction
from optics.pose import Pose
from optics.tree import Motion, RigidTree, State
from scenes.camera import CameraSpec
from scenes.camera_assembly import camera_bodies, camera_elements, camera_sequences
from scenes.camera_model import CameraModel, derive_camera
from scenes.collimator import CameraUnderTestSpec
from scenes.errors import InputError
from scenes.job import NodeInfo, noll, perturbation_issues

ROOT = "camera"


@dataclass(frozen=True, eq=False)
class CameraUnderTest:
    """A camera ready to be traced.

    Attributes:
        model: derived numbers of the prescription.
        assembly: bodies ``camera/M1`` ... ``camera/focal_plane``, sequences ``camera/imaging`` ...
        as_built: how it departs from the prescription.
    """

    model: CameraModel
    assembly: Assembly
    as_built: State


def build_camera_under_test(test: CameraUnderTestSpec, camera: CameraSpec, backend: Backend) -> CameraUnderTest:
    """Build the camera and check what the test says of it.

    Raises:
        InputError: ``as_built`` names what the camera does not have.
    """
    model = derive_camera(camera, backend)
    elements = camera_elements(ROOT, ROOT, model)
    tree = RigidTree(tuple(camera_bodies(ROOT, Pose(), model)))
    assembly = Assembly(tree, elements, camera_sequences(ROOT, model))
    shaped = {e.body for e in elements.values() if e.interaction is Interaction.REFLECT}
    nodes = {
        body.path.removeprefix(f"{ROOT}/"): NodeInfo(
            tuple(body.pivots), frozenset({"rotate", "shift", *(("figure",) if body.path in shaped else ())})
        )
        for body in tree.bodies
        if body.path != ROOT
    }
    issues = [
        issue
        for path, what in test.as_built.items()
        for issue in perturbation_issues(test, nodes, path, what, ("as_built", path))
    ]
    if issues:
        raise InputError(*issues)
    as_built = {
        f"{ROOT}/{path}": Motion(p.rotate, p.shift, p.pivot, figure={noll(t): v for t, v in p.figure.items()})
        for path, p in test.as_built.items()
    }
    return CameraUnderTest(model, assembly, as_built)
