"""Prescriptions without what a camera's file has no place for: flat folds before a turned image, and a curved image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optics.geometry.aperture import turned_over
from optics.geometry.pose import Pose
from optics.geometry.surface import plane
from optics.raytrace.assembly import Interaction
from scenes.lens.prescription import LensSurface, Note, Prescription

_FLIP = np.diag([1.0, -1.0, 1.0])
"""A mirror image has no right-handed axes; with its y the other way round it has."""


def unfolded(lens: Prescription) -> Prescription:
    """Return the prescription with its flat mirrors taken out, and what follows each as the mirror shows it.

    Rays go the same ways in length and in angles; an odd number of mirrors turns the image's y round. A flat that is
    the stop or has edges stays as a plane that light passes.

    Args:
        lens: the prescription.

    Raises:
        InputError: a surface behind a fold is not of revolution.
    """
    turn, shift, stop, notes = np.eye(3), np.zeros(3), lens.surfaces[lens.stop].name, []
    kept: list[LensSurface] = []
    for surface in lens.surfaces:
        rotation, place, shape = turn @ surface.pose.rotation, turn @ surface.pose.translation + shift, surface.surface
        if np.linalg.det(turn) < 0.0:
            if shape.terms or shape.figure is not None:
                problem = "a fold before a surface that is not of revolution, which cannot be unfolded"
                raise lens.error(problem, surface.line, surface.name, "an image square to the axis of the light")
            rotation = rotation @ _FLIP
            edge = surface.aperture and replace(
                surface.aperture, centre=(surface.aperture.centre[0], -surface.aperture.centre[1])
            )
            surface = replace(surface, aperture=edge, edges=tuple(map(turned_over, surface.edges)))
        surface = replace(surface, pose=Pose(rotation, place))
        if surface.interaction is Interaction.REFLECT and shape.is_plane and shape.figure is None:
            mirror = np.eye(3) - 2.0 * np.outer(rotation[:, 2], rotation[:, 2])
            turn, shift = mirror @ turn, place + mirror @ (shift - place)
            text = (
                "a flat mirror, unfolded: its errors are not carried, nor its shadow, which an edge that blocks states"
            )
            notes.append(Note(surface.line, surface.name, text))
            surface = replace(surface, interaction=Interaction.PASS)
            if surface.name != stop and not surface.every_edge:
                continue
        kept.append(surface)
    at = [surface.name for surface in kept].index(stop)
    return replace(lens, surfaces=tuple(kept), stop=at).with_notes(*notes)


def with_flat_image(lens: Prescription) -> Prescription:
    """Return the prescription with the plane that touches its image in the image's middle."""
    image, radius = lens.image, 1.0 / (lens.image.surface.curvature or np.inf)
    text = (
        f"curved, radius {radius:.6g} m: the plane that touches it is taken, which is {500.0 / radius:.3g} mm x "
        "(h / 1 m)^2 away from it at a height h; python -m twin.camera --refocus finds the best plane"
    )
    flat = replace(image, surface=plane())
    return replace(lens, surfaces=(*lens.surfaces[:-1], flat)).with_notes(Note(image.line, image.name, text))
