"""3-D scene ``scene.glb`` of the perturbed instrument and its light paths, for any glTF viewer, and its own viewer.

The scene is in the base frame, in metres (X = flight direction, Y = along the line CCDs, Z toward the scene). Every
body of the tree is a node whose name is the body's path, so that a viewer shows the instrument's tree. Mirrors have
their true shape and clear aperture; figure errors, far too small to be visible, are omitted. Bodies without a size in
the model (board, reticle) are drawn large enough to see; the light-sensitive faces are to scale.

The scene's ``extras`` contain ``motions``: body -> its motion relative to its parent, so that a viewer can exaggerate
it. k times the motion is the matrix ``nominal`` (column by column) times the rotation by k ``rotate`` (rotation vector,
radians) about ``pivot`` and the shift by k ``shift``, metres, in the body's nominal frame.

The interactive viewer is part of the report's page, or a page of its own, and needs neither other files nor a network.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from importlib.resources import files
from typing import Any, assert_never

import numpy as np
import trimesh
from markupsafe import Markup
from scipy.spatial.transform import Rotation
from trimesh.visual.material import PBRMaterial

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.solid import Coating, Solid, solid_mesh
from optics.geometry.tree import AT_REST, Body, PlacedBodies, State
from scenes.models.camera_model import lenses
from scenes.models.instrument_model import Instrument
from scenes.models.meshes import BOARD, CHIP, behind, board_size, body_outline, lens_mesh, mirror_mesh
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE, Channel
from twin.framework.page import page_policy, style_sheet
from twin.pictures.light_paths import RIM, Beam, LightPaths

LINE_WIDTH = 0.002
"""Width of a line CCD as drawn, metres; the true width would be invisible."""
RETICLE = 0.0005
"""Radius of a reticle as drawn, metres."""
SHEET = 0.001
"""Thickness of baffles as drawn, metres."""
TUBE = 0.0015
"""Radius of the tubes by which rays are drawn, metres."""
TUBE_SIDES = 5
"""Number of sides of the tubes by which rays are drawn."""

MIN_MOTION = 1e-12
"""Rotation (radians) or shift (metres) below which a motion is rounding."""

_WORLD = "world"


def _metal(
    red: int, green: int, blue: int, metallic: float = 0.55, roughness: float = 0.25, alpha: int = 255
) -> PBRMaterial:
    """Return a glTF material of 8-bit colour."""
    return PBRMaterial(
        baseColorFactor=[red, green, blue, alpha],
        metallicFactor=metallic,
        roughnessFactor=roughness,
        alphaMode="BLEND" if alpha < 255 else "OPAQUE",
        doubleSided=True,
    )


MIRROR = _metal(205, 208, 214)
DARK = _metal(60, 64, 72, 0.2, 0.7)
BAFFLE = _metal(30, 32, 36, 0.0, 0.9)
SILICON = _metal(40, 60, 130, 0.3, 0.3)
BRASS = _metal(200, 160, 60)
GLASS = _metal(120, 190, 210, 0.1, 0.1, 110)
BLOCK = _metal(150, 170, 185, 0.2, 0.3)
IMAGING = (_metal(0, 114, 178, 0.0, 0.8), _metal(86, 180, 233, 0.0, 0.8))
MONITOR = (_metal(213, 94, 0, 0.0, 0.8), _metal(230, 159, 0, 0.0, 0.8))


def scene_bytes(instrument: Instrument, state: State, paths: LightPaths, tube: float = TUBE) -> bytes:
    """Return the contents of ``scene.glb``: the instrument in a perturbed state as binary glTF.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    state : State
        Perturbed state.
    paths : LightPaths
        Light paths in that state.
    tube : float
        Radius of the tubes by which rays are drawn, metres.
    """
    scene = build_scene(instrument, paths, tube)
    scene.metadata["motions"] = motions(instrument, state, paths.placed)
    return bytes(scene.export(file_type="glb"))


def motions(instrument: Instrument, state: State, placed: PlacedBodies) -> dict[str, dict[str, Any]]:
    """Return the motion of each moved body relative to its parent, by its path, as in the scene's ``extras``.

    Parameters
    ----------
    instrument : Instrument
        Instrument.
    state : State
        Perturbed state, for the pivots.
    placed : PlacedBodies
        Poses of the bodies in that state.
    """
    nominal = instrument.assembly.place()
    bodies = instrument.assembly.tree.bodies
    rest, moved = (_all_in_parents(bodies, poses) for poses in (nominal, placed))
    back = np.swapaxes(rest[:, :3, :3], -1, -2)
    rotation = back @ moved[:, :3, :3]
    offset = np.einsum("bij,bj->bi", back, moved[:, :3, 3] - rest[:, :3, 3])
    pivots = np.array([body.pivots[state.get(body.path, AT_REST).pivot] for body in bodies])
    rotate = Rotation.from_matrix(rotation).as_rotvec()
    shift = np.einsum("bij,bj->bi", rotation, pivots) + offset - pivots
    out = {}
    for k in np.flatnonzero(np.maximum(np.abs(rotate), np.abs(shift)).max(axis=1) > MIN_MOTION):
        vectors = {"rotate": rotate[k].tolist(), "shift": shift[k].tolist(), "pivot": pivots[k].tolist()}
        out[bodies[k].path] = {"nominal": rest[k].T.ravel().tolist(), **vectors}
    return out


def _all_in_parents(bodies: Sequence[Body], placed: PlacedBodies) -> np.ndarray:
    """Return the pose of each of B bodies relative to its parent, or to the world, as 4 x 4 matrices, (B, 4, 4)."""
    body_rows = np.array([placed.index[body.path] for body in bodies])
    matrix = np.zeros((len(body_rows), 4, 4))
    matrix[:, :3, :3], matrix[:, :3, 3] = placed.rotation[0, body_rows].real, placed.translation[0, body_rows].real
    matrix[:, 3, 3] = 1.0
    number = {body.path: k for k, body in enumerate(bodies)}
    parents = np.array([number.get(body.parent, -1) if body.parent else -1 for body in bodies])
    carrier = np.where((parents >= 0)[:, None, None], matrix[parents], np.eye(4))
    back = np.swapaxes(carrier[:, :3, :3], -1, -2)
    out = matrix.copy()
    out[:, :3, :3] = back @ matrix[:, :3, :3]
    out[:, :3, 3] = np.einsum("bij,bj->bi", back, matrix[:, :3, 3] - carrier[:, :3, 3])
    return out


def build_scene(instrument: Instrument, paths: LightPaths, tube: float = TUBE) -> trimesh.Scene:
    """Build the scene as a tree of nodes named after the bodies; rays are tubes of radius ``tube``, metres."""
    meshes = _body_meshes(instrument, paths)
    scene = trimesh.Scene(base_frame=_WORLD)
    placed = paths.placed
    bodies = instrument.assembly.tree.bodies
    for body, matrix in zip(bodies, _all_in_parents(bodies, placed), strict=True):
        parent = body.parent or _WORLD
        scene.graph.update(body.path, parent, matrix=matrix)
        mesh = meshes.get(body.path)
        if mesh is not None:
            mesh.vertices = mesh.vertices * placed.scale[0, placed.index[body.path]].real
            scene.geometry[body.path] = mesh
            scene.graph.update(body.path, parent, matrix=matrix, geometry=body.path)
    for name, (carrier, mesh) in _baffle_meshes(instrument.baffles).items():
        node = f"baffles/{name}"
        scene.geometry[node] = mesh
        scene.graph.update(node, carrier, matrix=np.eye(4), geometry=node)
    for beam in paths.beams:
        name = f"light/{beam.camera}/{beam.name.replace(' ', '_')}"
        scene.geometry[name] = _tubes(beam, list(instrument.cameras).index(beam.camera), tube)
        scene.graph.update(name, _WORLD, matrix=np.eye(4), geometry=name)
    return scene


def _body_meshes(instrument: Instrument, paths: LightPaths) -> dict[str, trimesh.Trimesh]:
    """Return the mesh of each body by its path, in the body's frame, metres, without thermal expansion."""
    out: dict[str, trimesh.Trimesh] = {}
    for camera, model in instrument.cameras.items():
        lens_of = lenses(model.spec)
        for name, surface in model.surfaces.items():
            if lens_of.get(name) == name:
                last = next(face for face, lens in reversed(lens_of.items()) if lens == name)
                out[f"{BASE}/{camera}/{name}"] = _painted(lens_mesh(model, name, last), GLASS)
            elif model.spec.mirrors[name].light is None:
                outline = body_outline(model, name, model.apertures[name])
                out[f"{BASE}/{camera}/{name}"] = _painted(mirror_mesh(surface, outline, behind(model, name)), MIRROR)
        plane = f"{BASE}/{camera}/focal_plane"
        line = model.spec.line.pixels * model.spec.line.pitch
        channels = [c for c in instrument.channels if c.camera == camera]
        width, height = board_size(model, [p for c in channels for p in (c.pinhole, c.ccd)])
        # light arrives along +Z of the focal plane, so the board that carries the detectors is on the +Z side
        out[plane] = _painted(_box((width, height, BOARD), 2.0 * CHIP + 0.5 * BOARD), DARK)
        out[f"{plane}/line"] = _painted(_box((LINE_WIDTH, line, CHIP), 0.5 * CHIP), SILICON)
        for channel in channels:
            out.update(_channel_meshes(instrument, channel))
    placed = paths.placed
    for solid in (
        instrument.solids
    ):  # meshes of solids include thermal expansion: restore their nominal size like that of all others
        mesh = solid_mesh(solid, placed).mesh
        mesh.vertices = mesh.vertices / placed.scale[0, placed.index[solid.path]].real
        out[solid.path] = _painted(mesh, _material(solid))
    return out


def is_mirror(solid: Solid) -> bool:
    """Return True for the plate of a mirror, whose polished side faces its +Z."""
    return any(face.coating is Coating.MIRROR and face.body == solid.path for face in solid.faces)


def _material(solid: Solid) -> PBRMaterial:
    """Return the glTF material with which a solid is drawn."""
    return GLASS if solid.transparent else MIRROR if is_mirror(solid) else BLOCK


def _baffle_meshes(plates: tuple[Plate, ...]) -> dict[str, tuple[str, trimesh.Trimesh]]:
    """Return for each baffle, by name, the body that carries it, and its plates in that body's frame, metres."""
    parts: dict[str, tuple[str, list[trimesh.Trimesh]]] = {}
    for plate in plates:
        outline = plate.outline
        match outline:
            case Circle():
                mesh = trimesh.creation.annulus(outline.inner, outline.radius, SHEET, sections=64)
            case Rectangle():
                mesh = trimesh.creation.box(extents=(2.0 * outline.half_x, 2.0 * outline.half_y, SHEET))
            case _:
                assert_never(outline)
        matrix = np.eye(4)
        matrix[:3, :3] = plate.pose.rotation
        matrix[:3, 3] = plate.pose.apply(np.array([*outline.centre, 0.0]))
        mesh.apply_transform(matrix)
        parts.setdefault(plate.name, (plate.body, []))[1].append(mesh)
    return {name: (body, _painted(trimesh.util.concatenate(meshes), BAFFLE)) for name, (body, meshes) in parts.items()}


def _channel_meshes(instrument: Instrument, channel: Channel) -> dict[str, trimesh.Trimesh]:
    """Return the meshes of a monitor channel's area CCD, reticle and return face (mirror that sends the light back)."""
    ccd = instrument.spec.autocollimator.area_ccd
    face = instrument.assembly.elements[f"{channel.key}/return_face"].aperture
    assert isinstance(face, Circle)
    disc = trimesh.creation.cylinder(
        radius=face.radius, height=CHIP, sections=48
    )  # a coating, drawn thick enough to see
    disc.apply_translation([0.0, 0.0, 0.5 * CHIP])
    reticle = trimesh.creation.cylinder(radius=RETICLE, height=CHIP, sections=24)
    reticle.apply_translation([0.0, 0.0, 0.5 * CHIP])
    size = (ccd.columns * ccd.pitch, ccd.rows * ccd.pitch, CHIP)
    return {
        channel.ccd_body: _painted(_box(size, -0.5 * CHIP), SILICON),  # faces the light along its own +Z
        channel.reticle_body: _painted(reticle, BRASS),
        channel.face_body: _painted(disc, MIRROR),
    }


def _box(size: tuple[float, float, float], z: float) -> trimesh.Trimesh:
    """Return a box of a size along x, y and z, metres, centred on (0, 0, z)."""
    box = trimesh.creation.box(extents=size)
    box.apply_translation([0.0, 0.0, z])
    return box


def _painted(mesh: trimesh.Trimesh, material: PBRMaterial) -> trimesh.Trimesh:
    """Return the mesh, drawn with the given glTF material."""
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh


def drawn_rays(beam: Beam) -> np.ndarray:
    """Return the middle ray and the edge rays of a beam that are drawn, (5, K, 3), metres."""
    return beam.vertices[[0, *(1 + k * RIM // 4 for k in range(4))]]


def beam_colour(instrument: Instrument, beam: Beam) -> np.ndarray:
    """Return red, green, blue and opacity of a beam, from 0 to 1, (4,)."""
    return np.asarray(_beam_material(list(instrument.cameras).index(beam.camera), beam).baseColorFactor) / 255.0


def _beam_material(camera: int, beam: Beam) -> PBRMaterial:
    """Return the material of a beam of the camera of this index."""
    return (MONITOR if beam.is_monitor else IMAGING)[camera % 2]


def _tubes(beam: Beam, camera: int, radius: float) -> trimesh.Trimesh:
    """Return the middle ray and some edge rays of a beam as tubes of the given radius, metres, in the camera's colour.

    ``camera`` is the index of the camera.
    """
    rays = drawn_rays(beam)
    start, end = rays[:, :-1].reshape(-1, 3), rays[:, 1:].reshape(-1, 3)
    along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    e1 = np.cross(along, helper)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    e2 = np.cross(along, e1)
    t = 2.0 * np.pi * np.arange(TUBE_SIDES) / TUBE_SIDES
    ring = radius * (np.cos(t)[:, None] * e1[:, None] + np.sin(t)[:, None] * e2[:, None])
    vertices = np.concatenate([start[:, None] + ring, end[:, None] + ring], axis=1)
    k = np.arange(TUBE_SIDES)
    next_k = np.roll(k, -1)
    sides = np.concatenate(
        [np.stack([k, next_k, k + TUBE_SIDES], 1), np.stack([next_k, next_k + TUBE_SIDES, k + TUBE_SIDES], 1)]
    )
    faces = sides + 2 * TUBE_SIDES * np.arange(len(start))[:, None, None]
    mesh = trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)
    return _painted(mesh, _beam_material(camera, beam))


LIBRARY = "three.min.js"
"""Parts of three.js (MIT, see LICENSE.three.txt beside it) that the viewer uses, built as viewer/three_parts.js
describes.
"""
_HERE = files(__package__) / "viewer"


def viewer_markup(moved: str) -> Markup:
    """Return the element of the viewer, hidden until the viewer starts.

    Parameters
    ----------
    moved : str
        Description of the moved bodies for readers; empty for none.
    """
    text = (_HERE / "viewer.html").read_text("utf-8")
    return Markup(text).format(moved=moved or "nothing")


def viewer_programs() -> tuple[str, str]:
    """Return the programs of the viewer: its own script and the library that the script loads."""
    return f"\n{(_HERE / 'viewer.js').read_text('utf-8')}", (_HERE / LIBRARY).read_text("utf-8")


def viewer_scripts(scene: bytes) -> Markup:
    """Return the scripts at the end of a page that start the viewer: compressed library and scene, and the program.

    Parameters
    ----------
    scene : bytes
        Binary glTF, from `scene_bytes`.
    """
    program, library = viewer_programs()
    # base64 cannot contain HTML tags, and the program contains none
    return Markup(
        f'<script type="application/gzip" id="viewer-library">{_packed(library.encode())}</script>\n'
        f'<script type="application/gzip" id="viewer-scene">{_packed(scene)}</script>\n'
        f"<script>{program}</script>\n"
    )


def viewer_page(title: str, scene: bytes, moved: str, still: Markup) -> str:
    """Return a page of its own for the viewer, which needs neither other files nor a network.

    Parameters
    ----------
    title : str
        Title of the page.
    scene : bytes
        Binary glTF, from `scene_bytes`.
    moved : str
        Description of the moved bodies for readers; empty for none.
    still : Markup
        Figure for browsers without WebGL.
    """
    style = style_sheet()
    page = Markup(_HERE.joinpath("view.html").read_text("utf-8"))
    allowed, programs = page_policy(style, viewer_programs()), viewer_scripts(scene)
    return page.format(
        policy=allowed, title=title, style=Markup(style), viewer=viewer_markup(moved), still=still, scripts=programs
    )


def _packed(data: bytes) -> str:
    """Return data compressed and encoded as base64; equal data give equal text."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")
