"""One camera as bodies, elements and sequences, wherever it hangs: in an instrument or alone in the laboratory."""

from __future__ import annotations

import numpy as np

from optics.element import Element, Interaction
from optics.pose import Pose
from optics.surface import plane
from optics.tree import Body
from scenes.camera_model import CameraModel


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
        own = into_camera @ Pose(np.eye(3), model.vertex(mirror))
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
    for mirror in model.mirrors:
        key = f"{name}/{mirror}"
        surface, aperture = model.surfaces[mirror], model.apertures[mirror]
        out[key] = Element(key, f"{root}/{mirror}", surface, Interaction.REFLECT, aperture)
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
