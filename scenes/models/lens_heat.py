"""A lens in heat: its faces are bodies of their own, and move as the one piece of glass between them.

The lens is called by its first face, whose temperature it has. It is held at its middle, half way between the centres
of its faces, and expands freely about it; nothing bends it, so that a linear field deforms it by a formula.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optics.geometry.pose import Pose, rotation_matrix, triple
from optics.geometry.tree import Body, Motion
from optics.materials.glass import WarmGlass
from scenes.models.camera_model import CameraModel, lenses
from scenes.specs.instrument import BASE


@dataclass(frozen=True, eq=False)
class Lens:
    """One lens of an instrument.

    Attributes:
        path: of the body of its first face, by which it is called.
        faces: body of each face -> its pose in the frame of the first.
        parent: pose of the first face in the frame of the body that carries it.
        middle: where it is held, (3,), in the frame of the first face, metres.
        glass: what heat does to it; None where nothing says it.
        unknown: what is not said, empty where all is.
    """

    path: str
    faces: Mapping[str, Pose]
    parent: Pose
    middle: np.ndarray
    glass: WarmGlass | None
    unknown: str

    @property
    def mount(self) -> np.ndarray:
        """Where it is held, (3,), in the frame of the body that carries it, metres."""
        return np.asarray(self.parent.apply(self.middle))

    def grown(self, stretch: float) -> dict[str, Motion]:
        """What a relative growth of the lens about its middle does to its faces."""
        return {
            face: Motion(shift=triple(stretch * (pose.rotation.T @ (pose.translation - self.middle))), stretch=stretch)
            for face, pose in self.faces.items()
        }

    def carried(self, turn: np.ndarray, move: np.ndarray, stretch: float) -> dict[str, Motion]:
        """What the body that carries the lens does to its faces.

        Args:
            turn: rotation vector of the lens about where it is held, (3,), radians.
            move: of where it is held, (3,), metres, beside what the carrier's growth does.
            stretch: growth of the carrier, which moves the origins of the faces in the tree; the lens goes where that
                moves its middle. All in the frame of the carrier.
        """
        out = {}
        for face, pose in self.faces.items():
            arm = self.parent.rotation @ (pose.translation - self.middle)
            inward = (self.parent.rotation @ pose.rotation).T
            shift = move - stretch * arm + (rotation_matrix(turn) - np.eye(3)) @ arm
            if np.any(turn) or np.any(shift):
                out[face] = Motion(rotate=triple(inward @ turn), shift=triple(inward @ shift))
        return out


def lenses_of(name: str, model: CameraModel, bodies: Mapping[str, Body]) -> list[Lens]:
    """All lenses of a camera.

    Args:
        name: of the camera in its instrument.
        model: its numbers.
        bodies: of the instrument, by path.
    """
    root, groups = f"{BASE}/{name}", dict[str, list[str]]()
    for face, first in lenses(model.spec).items():
        groups.setdefault(first, []).append(face)
    out = []
    for first, faces in groups.items():
        own = bodies[f"{root}/{first}"].pose
        poses = {f"{root}/{face}": own.inverse() @ bodies[f"{root}/{face}"].pose for face in faces}
        centres = [pose.apply(np.array(bodies[face].pivots["centre"])) for face, pose in poses.items()]
        glass, unknown = None, ""
        try:
            glass = model.spec.warm_glass(first)
        except ValueError as error:
            unknown = str(error)
        out.append(Lens(f"{root}/{first}", poses, own, np.mean(centres, axis=0), glass, unknown))
    return out
