"""From a foreign prescription to a camera's file, and whether both trace the same.

Prescriptions without what a camera's file has no place for: flat folds before a turned image, and a curved image.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optics.geometry.aperture import Circle, flipped_y
from optics.geometry.pose import Pose, rotation_vector
from optics.geometry.sag_terms import LAST_NOLL, SAG_TERMS, ZernikeSag
from optics.geometry.surface import Surface, ZernikeFigure, plane
from optics.materials.glass import GLASSES, CatalogueGlass
from optics.numerics.backend import Backend
from optics.raytrace.aim import AimError
from optics.raytrace.assembly import Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, Rays, make_rays, trace
from scenes.lens.prescription import (
    SEQUENCE,
    LensSurface,
    Note,
    Prescription,
    edge_entries,
    facing,
    without_rim,
    written,
)
from scenes.models.camera_model import CameraModel, collimated, derive_camera, field_direction
from scenes.specs.camera import CameraSpec
from scenes.specs.glass import glass_entry
from scenes.yaml.errors import InputError, Problem, printable
from scenes.yaml.units import ANGLE, LENGTH, format_quantity, power_of_length

_FLIP = np.diag([1.0, -1.0, 1.0])
"""A mirror image has no right-handed axes; with its y the other way round it has."""


def unfolded(lens: Prescription) -> Prescription:
    """Return the prescription with its flat mirrors taken out, and what follows each as the mirror shows it.

    Rays go the same ways in length and in angles; an odd number of mirrors turns the image's y round. A flat that is
    the stop or has edges stays as a plane that light passes.

    Parameters
    ----------
    lens : Prescription
        The prescription.

    Raises
    ------
    InputError
        a surface behind a fold is not of revolution.
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
            surface = replace(surface, aperture=edge, edges=tuple(map(flipped_y, surface.edges)))
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


PITCH = 7e-6
"""Pitch of a line CCD's pixels where none is asked for, metres."""
LARGEST_TILT, TURNED = math.radians(45.0), 1e-12
"""Largest turn of an image about x, radians, and sine of its turn about y that is rounding."""
FAR = 1e6
"""An object beyond this distance is at infinity, metres: programs write 1e9 millimetres and more for one."""
SAME = 1e-9
"""Farthest that a ray of the camera may meet the image from where the prescription's does, metres. Both are traced by
the same code: what is left is the rounding of poses and numbers."""
_SAME_INDEX = 1e-11
"""Coefficients of one glass in two files agree to the digits that are printed of them."""
_SINGLE_FIELD = math.radians(0.05)
_RIM, _FINE_RIM = 12, 720
_LIGHT = {Interaction.REFRACT: "refracts", Interaction.PASS: "passes"}
_LETTER = {Interaction.REFLECT: "M", Interaction.REFRACT: "L", Interaction.PASS: "P"}


class Width(NamedTuple):
    """What a user says in place of the file.

    Attributes
    ----------
    pupil : float | None
        Diameter of the entrance pupil, metres.
    pitch : float
        Of the line CCD's pixels, metres.
    """

    pupil: float | None = None
    pitch: float = PITCH


AS_IN_FILE = Width()


@dataclass(frozen=True, eq=False)
class ReadCamera:
    """A camera made of a prescription.

    Attributes
    ----------
    camera : CameraSpec
        What its file says.
    names : dict[str, str]
        Surface of the camera -> surface of the prescription.
    notes : tuple[Note, ...]
        What did not come along, and what was put in.
    difference : float
        Farthest distance at the image between rays of both, metres.
    rays : int
        That were compared.
    """

    camera: CameraSpec
    names: dict[str, str]
    notes: tuple[Note, ...]
    difference: float
    rays: int

    def told(self, lens: Prescription) -> list[str]:
        """What there is to say of it."""
        spec = self.camera
        mirrors = sum(m.light is None for m in spec.mirrors.values())
        faces = sum(m.light == "refracts" for m in spec.mirrors.values())
        parts = [f"{mirrors} mirrors"] + ([f"{faces} faces of lenses"] if faces else [])
        angles = [f"{math.degrees(a):.4g}" for a in (spec.field.x, spec.field.y, spec.field_bias)]
        return [
            f"{lens.name}: {', '.join(parts)}, stop {spec.stop}, f {spec.focal_length:.7g} m, entrance pupil "
            f"{spec.entrance_pupil:.6g} m, field {angles[0]} x {angles[1]} deg about {angles[2]} deg",
            f"{self.rays} rays through both meet the image within {self.difference:.1e} m",
            *(f"note: {note}" for note in self.notes),
        ]


def camera_of(lens: Prescription, name: str, backend: Backend, width: Width = AS_IN_FILE) -> ReadCamera:
    """Make a camera of a prescription.

    Parameters
    ----------
    lens : Prescription
        The prescription.
    name : str
        Of the camera.
    backend : Backend
        Where to trace.
    width : Width
        What the user says of the beam and the pixels.

    Raises
    ------
    InputError
        The prescription has what a camera's file cannot hold, or light does not come through.
    """
    if abs(lens.image.pose.rotation[0, 2]) > TURNED or abs(_image(lens)[1]) > LARGEST_TILT:
        lens = unfolded(lens)
    if lens.heights:
        lens = _by_angles(lens, name, backend, width)
    _check(lens)
    if _one_axis(lens) and not lens.round_field:
        try:
            return _camera_of(lens, name, backend, width)
        except InputError:
            # its corners are farther out than anything the file asks for
            return _camera_of(replace(lens, round_field=True), name, backend, width)
    return _camera_of(lens, name, backend, width)


def _camera_of(lens: Prescription, name: str, backend: Backend, width: Width) -> ReadCamera:
    """What `camera_of` says, with the field as the prescription has it."""
    notes = list(lens.notes)
    sources = {name: getattr(glass, "source", "") for name, glass in lens.glasses.items()}
    taken_from = "the glass of {}; --glasses FILE.agf takes another"
    notes += [Note(0, name, taken_from.format(source)) for name, source in sources.items() if source]
    surfaces, stop, origin, taken = _surfaces(lens, notes)
    bias, half_x, half_y = _field(lens, surfaces, notes)
    where = {"z": written(_image(lens)[0], LENGTH)}
    if _image(lens)[1]:
        where["tilt"] = written(_image(lens)[1], ANGLE)
    plain: dict[str, Any] = {
        "name": name,
        "description": f"Read from {re.sub(r'[^ -~]', '?', lens.name)[:200]}.",
        "focal_length": "1 m",
        "entrance_pupil": "0.1 mm",
        "field_bias": written(bias, ANGLE),
        "field": {"x": written(half_x, ANGLE), "y": written(half_y, ANGLE)},
        "wavelength": written(lens.wavelength, LENGTH),
        "stop": stop,
        "mirrors": surfaces,
        "image": where,
        "line": {"pixels": 2, "pitch": format_quantity(width.pitch, LENGTH)},
    }
    if any("glass" in surface for surface in surfaces.values()):
        plain["medium"] = "air"  # which other programs take glasses against
    narrow = _derived(lens, plain, backend)
    pupil = _pupil(lens, narrow, plain, backend, width)
    focal = narrow.line_principal_distance
    if math.isfinite(lens.object_distance):
        nearer, far = 1e6 * focal**2 / lens.object_distance, f"{lens.object_distance:.6g} m away is taken for infinity"
        notes.append(Note(0, "object", f"{far}, whose image is {nearer:.3g} um nearer to the optics"))
    pixels = 2.0 * focal * math.tan(half_x) / width.pitch
    if not 2.0 <= pixels <= 1e6:
        problem = "a line CCD over the whole field would have too few or too many pixels"
        raise lens.error(
            problem, None, f"{pixels:.4g} of {format_quantity(width.pitch, LENGTH)}", "2 to 1000000: --pitch"
        )
    plain["focal_length"] = format_quantity(float(f"{narrow.paraxial.focal_length:.7g}"), LENGTH)
    plain["entrance_pupil"] = written(pupil, LENGTH)
    plain["line"]["pixels"] = math.ceil(pixels)
    plain["edge_margin"] = format_quantity(float(f"{min(0.005, 0.05 * pupil):.3g}"), LENGTH)
    text = f"{plain['line']['pixels']} pixels of {format_quantity(width.pitch, LENGTH)} put in, which cover the field"
    notes.append(Note(0, "line CCD", text))
    model = _without_idle_edges(_derived(lens, plain, backend), lens, plain, taken, notes, backend)
    compared = _compared(lens, origin, model, backend)
    if compared is None:
        return camera_of(_round_field(lens), name, backend, width)
    difference, rays = compared
    if not difference < SAME:
        raise lens.error(
            "the camera would not trace as this prescription does", None, f"{difference:.2g} m apart", "1 nm"
        )
    return ReadCamera(model.spec, taken, tuple(notes), difference, rays)


def _round_field(lens: Prescription) -> Prescription:
    """The prescription with a round field in place of one whose corners edges leave dark.

    Raises
    ------
    InputError
        Its field is round already.
    """
    x, y = np.array(lens.fields).T
    if lens.round_field:
        raise lens.error("edges leave no light at the end of the field", allowed="a smaller field, or other edges")
    largest = float(np.max(np.hypot(x, y)))
    note = Note(0, "field", "edges leave no light between the ends of its axes: taken to be round")
    fields = ((0.0, -largest), (0.0, 0.0), (0.0, largest))
    return replace(lens, fields=fields, round_field=True).with_notes(note)


def _by_angles(lens: Prescription, name: str, backend: Backend, width: Width) -> Prescription:
    """Return the prescription with the directions from which light comes to its fields' heights."""
    heights = np.array(lens.heights)
    if lens.field_kind == "object heights":
        if not FAR <= abs(lens.object_distance) < math.inf:
            found = f"{lens.object_distance:.6g} m"
            raise lens.error("heights on an object that is near, or nowhere", None, found, "field angles: --field")
        tangents = -heights / lens.object_distance
    else:
        middle = replace(lens, fields=((0.0, 0.0),), heights=(), field_kind="angles")
        _check(middle)
        model = derive_camera(_camera_of(middle, name, backend, width).camera, backend)
        tangents = _tangents_at(model, lens, heights, backend)
    note = Note(0, "field", f"{lens.field_kind}: the directions are taken whose chief rays belong to them")
    fields = tuple((float(x), float(y)) for x, y in np.arctan(tangents))
    return replace(lens, fields=fields, heights=(), field_kind="angles").with_notes(note)


def _tangents_at(model: CameraModel, lens: Prescription, heights: np.ndarray, backend: Backend) -> np.ndarray:
    """Return the tangents (F, 2) of the directions whose chief rays meet the image at heights (F, 2), metres; by the
    slope in the middle where the heights are paraxial.
    """
    bare, names = model.bare_assembly(apertures=False), model.mirrors
    to_stop, imaging = assemble(bare, [names[: names.index(model.spec.stop) + 1]]), assemble(bare, ["imaging"])

    def places(tangents: np.ndarray) -> np.ndarray:
        light = np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1)
        light /= np.linalg.norm(light, axis=1, keepdims=True)
        launch = collimated(backend, to_stop, light, np.zeros((1, 2)))[:, 0]
        return np.asarray(trace(backend, imaging, make_rays(backend, launch, light)).numpy()[0][0, :, :2])

    try:
        middle, *steps = places(_SMALL_STEP * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]))
        back = np.linalg.inv((np.array(steps) - middle).T / _SMALL_STEP).T
        tangents = (heights - middle) @ back
        off = np.zeros(())
        # distortion alone is left of each step
        for _ in range(_STEPS if lens.field_kind == "real image heights" else 0):
            off = heights - places(tangents)
            tangents = tangents + off @ back
    except (AimError, BeamMissedError):
        off = np.array(np.nan)
    if not np.all(np.abs(off) <= _REACHED * np.max(np.abs(heights))):
        raise lens.error(f"no light at its {lens.field_kind}", allowed="a smaller field: --field")
    return np.asarray(tangents)


_SMALL_STEP, _STEPS, _REACHED = 1e-6, 40, 1e-9
"""Tangent by which the scale in the middle of the image is found, steps to a height, and how near to it, in shares of
the largest height, the last but one must come: distortion of 50 % ends at 1e-12 of it, and heights that no light has
do not end."""


def _check(lens: Prescription) -> None:
    """Refuse what a camera's file cannot hold."""
    if abs(lens.object_distance) < FAR:
        found = f"{lens.object_distance:.6g} m"
        raise lens.error("the object is at a finite distance", lens.surfaces[0].line, found, "a scene at infinity")
    if not lens.fields:
        raise lens.error("no directions of the field in this file", None, lens.field_kind, "field angles")
    image = lens.image
    if not image.surface.is_plane or image.surface.figure is not None:
        raise lens.error("a curved image", image.line, allowed="a plane: --flat-image takes the one that touches it")
    if image.index != 1.0 or image.interaction is not Interaction.PASS:
        raise lens.error("an image in glass", image.line, allowed="an image in the object's medium")
    normal = image.pose.rotation[:, 2]
    if abs(normal[0]) > TURNED:
        raise lens.error("an image that is turned out of the plane of symmetry", image.line, allowed="a turn about x")
    if abs(_image(lens)[1]) > LARGEST_TILT:
        found = f"{math.degrees(_image(lens)[1]):.4g} deg"
        problem = "an image turned too far from square to the axis that light enters along"
        raise lens.error(problem, image.line, found, "45 deg at most")


def _image(lens: Prescription) -> tuple[float, float]:
    """Where the image plane crosses the parent axis, metres, and its turn about x, radians."""
    pose = lens.image.pose
    normal = pose.rotation[:, 2] * math.copysign(1.0, pose.rotation[2, 2])
    z = float(normal @ pose.translation / normal[2]) if abs(normal[2]) > 1e-3 else math.inf
    tilt = math.atan2(-float(normal[1]), float(normal[2]))
    return z, (tilt if abs(tilt) > 1e-15 else 0.0)


def _surfaces(lens: Prescription, notes: list[Note]) -> tuple[dict[str, Any], str, Prescription, dict[str, str]]:
    """Surfaces as a camera's file has them, the stop among them, the prescription of those that came along, names."""
    out: dict[str, Any] = {}
    taken: dict[str, str] = {}
    stop, kept, count = "", [], dict.fromkeys(_LETTER.values(), 0)
    for k, surface in enumerate(lens.surfaces[:-1]):
        idle = surface.interaction is Interaction.PASS
        if idle and k != lens.stop and not (surface.every_edge and surface.surface.is_plane):
            notes.append(Note(surface.line, surface.name, "a surface that does nothing: not carried"))
            continue
        kept.append(surface)
        letter = _LETTER[surface.interaction]
        count[letter] += 1
        name = "STOP" if idle and k == lens.stop else f"{letter}{count[letter]}"
        if k == lens.stop:
            stop = name
            if surface.aperture is not None:
                text = "the stop's outer edge is not carried: it is the disk that the entrance pupil asks for"
                notes.append(Note(surface.line, surface.name, text))
                surface = without_rim(surface)
        taken[name] = surface.name
        out[name] = _written(lens, facing(surface))
    if lens.image.every_edge:
        text = "the image's edge is not carried: it ends the field, and stops no light within"
        notes.append(Note(lens.image.line, lens.image.name, text))
    if not any(s.interaction is not Interaction.PASS for s in kept):
        raise lens.error("nothing in this file reflects or refracts light", lens.surfaces[0].line)
    bare = replace(lens, surfaces=(*kept, lens.image), stop=list(taken).index(stop))
    return out, stop, bare, taken


def _written(lens: Prescription, surface: LensSurface) -> dict[str, Any]:
    """A surface as a camera's file has it."""
    shape = surface.surface
    x, y, z = (float(v) for v in surface.pose.translation)
    out: dict[str, Any] = {"z": written(z, LENGTH)}
    if x or y:
        out["decentre"] = [written(v, LENGTH) for v in (x, y)]
    turn = rotation_vector(surface.pose.rotation)
    if np.any(np.abs(turn) > 0.0):
        out["rotate"] = [written(float(v), ANGLE) for v in turn]
    out["radius"] = written(1.0 / shape.curvature, LENGTH) if shape.curvature else "flat"
    if shape.conic:
        out["conic"] = shape.conic
    powers = {f"A{4 + 2 * n}": written(a, power_of_length(-3 - 2 * n)) for n, a in enumerate(shape.even) if a}
    if powers:
        out["aspheric"] = powers
    terms = _terms(lens, surface, shape)
    if terms:
        out["sag"] = terms
    edges = edge_entries(surface.every_edge)
    if edges:
        out["edges"] = edges
    if surface.interaction in _LIGHT:
        out["light"] = _LIGHT[surface.interaction]
    if surface.interaction is Interaction.REFRACT:
        out |= _behind(lens, surface)
    return out


def _behind(lens: Prescription, surface: LensSurface) -> dict[str, Any]:
    """Glass behind a surface where its dispersion is known and makes its index, else the index alone."""
    known = lens.glasses.get(surface.glass)
    if known is None or abs(known(lens.wavelength) - surface.index) > _SAME_INDEX:
        return {"index": surface.index}
    if isinstance(known, CatalogueGlass):
        return {"glass": glass_entry(known)}
    own = next((name for name, one in GLASSES.items() if one.index == known), None)
    return {"index": surface.index} if own is None else {"glass": own}


def _terms(lens: Prescription, surface: LensSurface, shape: Surface) -> dict[str, Any]:
    """Further terms of a sag as a camera's file has them."""
    terms = list(shape.terms)
    if isinstance(shape.figure, ZernikeFigure):
        last = max(shape.figure.terms, default=0)
        if last > LAST_NOLL:
            problem = "Zernike terms, or a polynomial, beyond what a camera's file has a place for"
            raise lens.error(problem, surface.line, f"Z{last}", f"Z1 to Z{LAST_NOLL}, polynomials to order 7")
        given = {f"Z{j}": a for j, a in shape.figure.terms.items()}
        x0, y0 = shape.figure.centre
        terms.append(ZernikeSag(radius=shape.figure.radius, x0=x0, y0=y0, **given))
    elif shape.figure is not None:
        raise lens.error("a figure on a grid, which a camera's file has no place for", surface.line, surface.name)
    kinds = {kind: name for name, kind in SAG_TERMS.items()}
    return {
        kinds[type(term)]: {
            key: written(float(value), power_of_length(power)) if power else float(value)
            for key, power in term.POWERS.items()
            if (value := getattr(term, key)) != 0.0
        }
        for term in terms
    }


def _one_axis(lens: Prescription) -> bool:
    """Whether the fields stand on one axis, from the middle outward."""
    x, y = np.array(lens.fields).T
    out = np.hypot(x, y)
    return bool((np.all(x == 0.0) or np.all(y == 0.0)) and np.max(out) > 0.0 and np.min(out) == 0.0)


def _field(lens: Prescription, surfaces: dict[str, Any], notes: list[Note]) -> tuple[float, float, float]:
    """Field bias and half angles along x and y, radians."""
    x, y = np.array(lens.fields).T
    upright = not any({"decentre", "rotate", "sag"} & set(s) for s in surfaces.values()) and not _image(lens)[1]
    largest = float(np.max(np.hypot(x, y)))
    if upright and _one_axis(lens):
        wide = math.degrees(largest)
        if lens.round_field:
            text = f"a circle of {wide:.6g} deg about the axis; the square in it is taken"
            notes.append(Note(0, "field", text))
            return 0.0, largest / math.sqrt(2.0), largest / math.sqrt(2.0)
        text = (
            f"angles along one axis alone, to {wide:.6g} deg; the camera's field is a square of {wide:.6g} deg to each "
            f"side, whose corners are {math.sqrt(2.0) * wide:.4g} deg out. --field '{wide:.6g} deg' takes the square "
            "in the circle"
        )
        notes.append(Note(0, "field", text))
        return 0.0, largest, largest
    bias = 0.5 * float(y.max() + y.min())
    half_x, half_y = float(np.max(np.abs(x))), 0.5 * float(y.max() - y.min())
    if half_x == 0.0 and half_y == 0.0:
        half_x = half_y = _SINGLE_FIELD
        notes.append(Note(0, "field", f"one direction alone; half angles of {math.degrees(half_x):g} deg put in"))
    elif half_x == 0.0 or half_y == 0.0:
        half_x = half_y = max(half_x, half_y)
        notes.append(Note(0, "field", "angles along one axis alone; as much put in along the other"))
    return bias, half_x, half_y


def _derived(lens: Prescription, plain: dict[str, Any], backend: Backend) -> CameraModel:
    """The camera of a plain mapping, traced."""
    try:
        spec = CameraSpec.model_validate(plain)
    except ValueError as error:
        reason = next((str(e["ctx"]["error"]) for e in getattr(error, "errors", list)() if "ctx" in e), str(error))
        problem = error.problem if isinstance(error, Problem) else reason.splitlines()[0]
        raise lens.error(f"a camera's file cannot hold this: {problem}") from error
    try:
        return derive_camera(spec, backend, stated=False)
    except InputError as error:
        raise lens.error(error.issues[0].problem, allowed="a system that images its field") from error


def _pupil(lens: Prescription, narrow: CameraModel, plain: dict[str, Any], backend: Backend, width: Width) -> float:
    """Diameter of the entrance pupil, metres."""
    if width.pupil is not None:
        return width.pupil
    allowed = "the entrance pupil's diameter: --pupil"
    if lens.pupil is None:
        raise lens.error("the file does not say how wide the beam is", allowed=allowed)
    if lens.pupil.kind == "diameter":
        return lens.pupil.value
    if lens.pupil.kind == "stop":
        plain["stop_diameter"] = written(2.0 * lens.pupil.value, LENGTH)
        return float(f"{_derived(lens, plain, backend).entrance_pupil:.9g}")
    if lens.pupil.kind == "f_number":
        if any({"decentre", "rotate"} & set(surface) for surface in plain["mirrors"].values()):
            problem = "an F-number of a system with surfaces that are turned or off the axis"
            raise lens.error(problem, lens.pupil.line, allowed=allowed)
        return narrow.paraxial.focal_length / lens.pupil.value
    raise lens.error("a numerical aperture in object space", lens.pupil.line, allowed=allowed)


def _beams(model: CameraModel, lens: Prescription, stop: np.ndarray, fields: int, backend: Backend) -> Rays:
    """Rays of fields x fields directions over the whole field through points (N, 2) of the stop, in its radii."""
    spec, names = model.spec, model.mirrors
    to_stop = assemble(model.bare_assembly(apertures=False), [names[: names.index(spec.stop) + 1]])
    shares = np.linspace(-1.0, 1.0, fields)
    directions = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x in shares for y in shares])
    launch = collimated(backend, to_stop, directions, float(model.apertures[spec.stop].bounds[1]) * stop)
    heading = np.broadcast_to(directions[:, None], launch.shape)
    return make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3))


def _met(model: CameraModel, lens: Prescription, stop: np.ndarray, fields: int, backend: Backend) -> list[np.ndarray]:
    """Where rays as of ``_beams`` meet each mirror, (rays, 3), in its own frame."""
    rays = _beams(model, lens, stop, fields, backend)
    every = range(len(model.mirrors))
    traced = trace(backend, assemble(model.bare_assembly(apertures=False), ["imaging"]), rays, keep=every)
    return [traced.hit(k)[0] for k in every]


def _compared(
    lens: Prescription, origin: Prescription, model: CameraModel, backend: Backend
) -> tuple[float, int] | None:
    """Farthest distance at the image between rays of a prescription and of its camera, metres, and how many rays; None
    where edges leave a field dark.
    """
    bare = model.bare_assembly(apertures=False)
    turn = 2.0 * np.pi * np.arange(_RIM) / _RIM
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    # of a cut beam middle and rim may be missing
    stop = np.concatenate([np.zeros((1, 2)), *([0.75 * rim, 0.9 * rim] if model.edges else []), rim])
    rays, places, comes = _beams(model, lens, stop, 3, backend), [], []
    for assembly, sequence in ((bare, "imaging"), (origin.assembly(apertures=False), SEQUENCE)):
        traced = trace(backend, assemble(assembly, [sequence]), rays, world=True)
        position, _, path, valid = traced.numpy(traced.world)
        places.append(np.concatenate([position[0], path[0, :, None]], axis=-1))
        comes.append(valid[0])
    through = comes[0]
    if model.edges:
        # light that an edge stops need not come on, but some of every field has to
        met = _met(model, lens, stop, 3, backend)
        through = through & model.uncut(lambda name: met[model.mirrors.index(name)])
        if not np.any(through.reshape(9, -1), axis=-1).all():
            return None
        lost = not np.array_equal(*comes)
    else:
        lost = not (comes[0].all() and comes[1].all())
    if lost:
        raise lens.error("rays of the whole field do not come through", allowed="a smaller field or pupil")
    places = [place[through] for place in places]
    return float(np.max(np.abs(places[0] - places[1]))), len(places[0])


def _without_idle_edges(
    model: CameraModel,
    lens: Prescription,
    plain: dict[str, Any],
    taken: dict[str, str],
    notes: list[Note],
    backend: Backend,
) -> CameraModel:
    """The camera without clear apertures that stop no light of its field."""
    if not model.edges:
        return model
    turn = 2.0 * np.pi * np.arange(_FINE_RIM) / _FINE_RIM
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    met = _met(model, lens, rim, 5, backend)
    idle = 0
    for name, edges in model.edges.items():
        place = met[model.mirrors.index(name)]
        needed = [
            edge.blocks or (isinstance(edge.shape, Circle) and edge.shape.inner > 0.0)
            or not bool(np.all(edge.passes(place[:, 0], place[:, 1])))
            for edge in edges
        ]  # fmt: skip
        idle += needed.count(False)
        surface = plain["mirrors"][name]
        surface["edges"] = [edge for edge, kept in zip(surface["edges"], needed, strict=True) if kept]
        if not surface["edges"]:
            del surface["edges"]
            if surface.get("light") == "passes" and name != model.spec.stop:
                del plain["mirrors"][name], taken[name]
    if not idle:
        return model
    notes.append(Note(0, "clear apertures", f"{idle} of them stop no light of the field: not carried"))
    return _derived(lens, plain, backend)


def camera_text(made: ReadCamera, lens: Prescription) -> str:
    """Text of the camera's file, with what did not come along at its head."""
    remark = [f"Read from {lens.file} by python -m scenes.lens read."]
    remark += [f"{name}: {surface}" for name, surface in made.names.items() if name != surface]
    remark += [str(note) for note in made.notes]
    return made.camera.file_text("\n".join(printable(line) for line in remark))
