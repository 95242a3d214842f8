"""One camera as bodies, elements and sequences: in an instrument, or alone under test."""

from __future__ import annotations

from dataclasses import dataclass

from optics.geometry.pose import Pose
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.models.camera_model import LIGHT, CameraModel, derive_camera, glass_indices, lenses
from scenes.specs.camera import CameraSpec
from scenes.specs.camera_tests import CameraUnderTestSpec
from scenes.specs.course import noll
from scenes.specs.job import NodeInfo, perturbation_issues
from scenes.yaml.errors import InputError


def focal_plane_body(root: str) -> str:
    """Path of the focal-plane assembly of the camera at ``root``."""
    return f"{root}/focal_plane"


def line_body(root: str) -> str:
    """Path of the line CCDs on the focal-plane assembly of the camera at ``root``."""
    return f"{focal_plane_body(root)}/line"


def camera_bodies(root: str, pose: Pose, model: CameraModel) -> list[Body]:
    """The camera's structure at ``pose`` relative to its parent, mirrors, focal-plane assembly and line CCD."""
    into_camera = model.camera_frame.inverse()
    bodies = [Body(root, pose)]
    for mirror in model.mirrors:
        x, y = model.apertures[mirror].centre
        centre = (x, y, float(model.surfaces[mirror].sag(x, y)))
        own = into_camera @ model.mirror_pose(mirror)
        bodies.append(Body(f"{root}/{mirror}", own, pivots={"centre": centre}))
    x, y, z = model.focal_plane.inverse().apply(model.rear_node)
    pivots = {"rear_node": (float(x), float(y), float(z)), "line_centre": (0.0, 0.0, 0.0)}
    plane_root = focal_plane_body(root)
    bodies.append(Body(plane_root, into_camera @ model.focal_plane, pivots=pivots, scales=False))
    bodies.append(Body(line_body(root)))
    return bodies


def camera_elements(name: str, root: str, model: CameraModel) -> dict[str, Element]:
    """Mirrors and line CCD, by ``NAME/M1`` ... and ``NAME/line``."""
    out = {}
    glass = lenses(model.spec)
    for mirror in model.mirrors:
        key = f"{name}/{mirror}"
        surface, aperture = model.surfaces[mirror], model.apertures[mirror]
        how = LIGHT[model.spec.mirrors[mirror].light]
        solid = f"{root}/{glass[mirror]}" if mirror in glass else None
        out[key] = Element(key, f"{root}/{mirror}", surface, how, aperture, solid=solid)
    key = f"{name}/line"
    out[key] = Element(key, line_body(root), plane(), Interaction.PASS)
    return out


def camera_sequences(name: str, model: CameraModel) -> dict[str, tuple[str, ...]]:
    """Ways of the light: from the scene to the line CCD and to the stop, and back from the image."""
    forward = tuple(f"{name}/{m}" for m in model.mirrors)
    backward = forward[::-1]
    stop = f"{name}/{model.spec.stop}"
    return {
        f"{name}/imaging": (*forward, f"{name}/line"),
        f"{name}/to_stop": forward[: forward.index(stop) + 1],
        f"{name}/image_to_stop": backward[: backward.index(stop) + 1],
        f"{name}/image_to_object": backward,
    }


ROOT = "camera"


def camera_alone(model: CameraModel) -> Assembly:
    """The camera by itself: bodies ``camera/M1`` ... ``camera/focal_plane``, sequences ``camera/imaging`` ..."""
    tree = RigidTree(tuple(camera_bodies(ROOT, Pose(), model)))
    index = {f"{ROOT}/{lens}": n for lens, n in glass_indices(model.spec).items()}
    return Assembly(tree, camera_elements(ROOT, ROOT, model), camera_sequences(ROOT, model), index)


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
    camera.require_mirrors("a camera under test")
    model = derive_camera(camera, backend)
    assembly = camera_alone(model)
    shaped = {e.body for e in assembly.elements.values() if e.interaction is Interaction.REFLECT}
    nodes = {
        body.path.removeprefix(f"{ROOT}/"): NodeInfo(
            tuple(body.pivots), frozenset({"rotate", "shift", *(("figure",) if body.path in shaped else ())})
        )
        for body in assembly.tree.bodies
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
