"""A camera of the twin as a sequential prescription: as designed, or as it stands in a job's perturbed state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose
from optics.geometry.surface import plane
from optics.geometry.tree import AT_REST, State
from optics.raytrace.assembly import Interaction
from scenes.lens.prescription import LensSurface, Note, Prescription, Pupil, joined
from scenes.models.camera_model import IMAGE, LIGHT, CameraModel, line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE


def prescription_of(model: CameraModel) -> Prescription:
    """A camera as designed."""
    spec, behind, index = model.spec, {}, 1.0
    for name, mirror in spec.mirrors.items():
        index = spec.index_behind(name) if mirror.light == "refracts" else index
        behind[name] = index
    surfaces = [
        LensSurface(
            name,
            model.mirror_pose(name),
            joined(model.surfaces[name]),
            LIGHT[mirror.light],
            behind[name],
            *_cut(model, name),
        )
        for name, mirror in spec.mirrors.items()
    ]
    surfaces.append(LensSurface(IMAGE, model.image_body, plane(), Interaction.PASS, index))
    return Prescription(
        spec.name,
        spec.source.file or spec.name,
        tuple(surfaces),
        model.mirrors.index(spec.stop),
        spec.wavelength,
        (spec.wavelength,),
        field_angles(model),
        "angles",
        # the stop's own size: a pupil's diameter means another ray in every program
        Pupil("stop", float(model.apertures[spec.stop].bounds[1])),
    )


def _cut(model: CameraModel, name: str) -> tuple[Any, ...]:
    """Clear aperture of a surface, the line and the glass of no file, and its further edges."""
    edges = model.edges.get(name, ())
    if name == model.spec.stop or not edges:
        return model.apertures[name], 0, "", edges
    first = edges[0].shape
    if not edges[0].blocks and not edges[0].turn and isinstance(first, Aperture):
        return first, 0, "", edges[1:]
    # what stands in the file, and not the box about the beams
    return None, 0, "", edges


def field_angles(model: CameraModel) -> tuple[tuple[float, float], ...]:
    """Middle, ends and corners of the field, angles about x and y whose tangents are the light's, radians."""
    spec = model.spec
    sides = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    shares = [(0.0, 0.0), *sides, *product((1.0, -1.0), repeat=2)]
    return tuple((x * spec.field.x, spec.field_bias + y * spec.field.y) for x, y in shares)


def perturbed_prescription(instrument: Instrument, camera: str, state: State) -> Prescription:
    """A camera of an instrument in a perturbed state, in the frame in which it was designed.

    Motions of all that carries its mirrors are in their poses, growth in their shapes, figures on their surfaces. What
    is no part of the camera, as prisms, is left out, and said in the notes.

    Args:
        instrument: in which it stands.
        camera: its name there.
        state: body path -> motion.

    Raises:
        ValueError: a figure that no surface can carry.
    """
    model, assembly = instrument.cameras[camera], instrument.assembly
    root = f"{BASE}/{camera}"
    design = (assembly.nominal_pose(root) @ model.camera_frame.inverse()).inverse()
    placed = assembly.place([state])
    nominal = prescription_of(model)
    surfaces = []
    for name in model.mirrors:
        body = f"{root}/{name}"
        k = placed.index[body]
        pose = design @ Pose(placed.rotation[0, k], placed.translation[0, k])
        element = assembly.elements[f"{camera}/{name}"]
        size = float(placed.scale[0, k])
        shape = joined(element.figured(state.get(body, AT_REST)).grown(size))
        aperture = None if element.aperture is None else element.aperture.grown(size)
        surfaces.append(LensSurface(name, pose, shape, element.interaction, 1.0, aperture))
    k = placed.index[line_body(root)]
    line = design @ Pose(placed.rotation[0, k], placed.translation[0, k])
    image = line @ model.focal_plane.inverse() @ model.image_body
    surfaces.append(replace(nominal.image, pose=image))
    radius = float(surfaces[nominal.stop].aperture.bounds[1])  # type: ignore[union-attr]
    moved = replace(nominal, surfaces=tuple(surfaces), pupil=Pupil("stop", radius))
    return moved.with_notes(*_left_out(state, root))


def _left_out(state: Mapping[str, object], root: str) -> list[Note]:
    """Bodies of a state that a camera's prescription does not have."""
    ours = {BASE, root}
    carried = [
        p for p in state if p in ours or (p.startswith(f"{root}/") and "/monitor" not in p and "area_ccd" not in p)
    ]
    strangers = [p for p in state if p not in carried]
    return [Note(0, path, "is no part of this camera: not carried") for path in strangers]


def rounded(pose: Pose) -> Pose:
    """A pose without the last digit's noise of products of poses: what is below 1e-15 m and 1e-15 rad is none."""
    rotation = np.where(np.abs(pose.rotation) < 1e-15, 0.0, pose.rotation)
    if np.allclose(rotation, np.eye(3), rtol=0.0, atol=2e-16):
        rotation = np.eye(3)
    return Pose(rotation, np.where(np.abs(pose.translation) < 1e-15, 0.0, pose.translation))
