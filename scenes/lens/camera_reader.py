"""Conversion of a foreign prescription to a camera's file, checked by tracing both.

``unfolded`` and ``with_flat_image`` remove what a camera's file cannot represent: flat folds before a rotated image,
and a curved image.
"""

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
from scenes.specs.camera import CameraSpec, glass_entry
from scenes.yaml.errors import InputError, Problem, printable
from scenes.yaml.units import ANGLE, LENGTH, format_quantity, power_of_length

_FLIP = np.diag([1.0, -1.0, 1.0])
"""Reflection of y, which makes the axes of a mirror image right-handed again."""


def unfolded(lens: Prescription) -> Prescription:
    """Return the prescription without its flat mirrors; what follows each of them is replaced by its mirror image.

    Lengths and angles of the rays stay; an odd number of mirrors reverses the image's y. A flat that is the stop or has
    edges stays as a plane that light passes.

    Parameters
    ----------
    lens : Prescription
        The prescription.

    Raises
    ------
    InputError
        A surface behind a fold is not a surface of revolution.
    """
    flip, shift, stop, notes = np.eye(3), np.zeros(3), lens.surfaces[lens.stop].name, []
    surfaces: list[LensSurface] = []
    for surface in lens.surfaces:
        rotation, position, shape = (
            flip @ surface.pose.rotation,
            flip @ surface.pose.translation + shift,
            surface.surface,
        )
        if np.linalg.det(flip) < 0.0:
            if shape.terms or shape.figure is not None:
                problem = "a fold before a surface that is not a surface of revolution cannot be unfolded"
                raise lens.error(problem, surface.line, surface.name, "an image square to the axis of the light")
            rotation = rotation @ _FLIP
            edge = surface.aperture and replace(
                surface.aperture, centre=(surface.aperture.centre[0], -surface.aperture.centre[1])
            )
            surface = replace(surface, aperture=edge, edges=tuple(map(flipped_y, surface.edges)))
        surface = replace(surface, pose=Pose(rotation, position))
        if surface.interaction is Interaction.REFLECT and shape.is_plane and shape.figure is None:
            mirror = np.eye(3) - 2.0 * np.outer(rotation[:, 2], rotation[:, 2])
            flip, shift = mirror @ flip, position + mirror @ (shift - position)
            text = "a flat mirror, unfolded: its errors and its shadow are omitted; an edge may describe the shadow"
            notes.append(Note(surface.line, surface.name, text))
            surface = replace(surface, interaction=Interaction.PASS)
            if surface.name != stop and not surface.every_edge:
                continue
        surfaces.append(surface)
    at = [surface.name for surface in surfaces].index(stop)
    return replace(lens, surfaces=tuple(surfaces), stop=at).with_notes(*notes)


def with_flat_image(lens: Prescription) -> Prescription:
    """Return the prescription with its curved image replaced by the tangent plane at the image's middle."""
    image, radius = lens.image, 1.0 / (lens.image.surface.curvature or np.inf)
    text = (
        f"curved, radius {radius:.6g} m: replaced by its tangent plane, which differs by {500.0 / radius:.3g} mm x "
        "(h / 1 m)^2 at a height h; python -m twin.camera --refocus finds the best plane"
    )
    flat = replace(image, surface=plane())
    return replace(lens, surfaces=(*lens.surfaces[:-1], flat)).with_notes(Note(image.line, image.name, text))


PITCH = 7e-6
"""Default pixel pitch of the line CCD, in metres."""
LARGEST_TILT, OBLIQUE = math.radians(45.0), 1e-12
"""Largest tilt of an image about x, in radians, and largest sine of its tilt about y that counts as rounding error."""
FAR = 1e6
"""Distance beyond which an object is at infinity, in metres: programs write 1e9 millimetres and more for infinity."""
SAME = 1e-9
"""Largest distance on the image between a ray of the camera and that of the prescription, in metres. Both are traced by
the same code: only the rounding of poses and numbers remains.
"""
_SAME_INDEX = 1e-11
"""Tolerance of an index within which two files name the same glass: the printed digits of its coefficients."""
_SINGLE_FIELD = math.radians(0.05)
_RIM, _FINE_RIM = 12, 720
_LIGHT = {Interaction.REFRACT: "refracts", Interaction.PASS: "passes"}
_LETTER = {Interaction.REFLECT: "M", Interaction.REFRACT: "L", Interaction.PASS: "P"}


class Width(NamedTuple):
    """Options that replace or add to numbers of the file.

    Attributes
    ----------
    pupil : float or None
        Diameter of the entrance pupil, in metres.
    pitch : float
        Pixel pitch of the line CCD, in metres.
    """

    pupil: float | None = None
    pitch: float = PITCH


AS_IN_FILE = Width()


@dataclass(frozen=True, eq=False)
class ReadCamera:
    """Camera made from a prescription.

    Attributes
    ----------
    camera : CameraSpec
        Content of the camera's file.
    names : dict[str, str]
        Surface of the camera -> surface of the prescription.
    notes : tuple[Note, ...]
        Omissions and assumptions of the conversion.
    difference : float
        Largest distance at the image between rays of both, in metres.
    rays : int
        Number of rays compared.
    """

    camera: CameraSpec
    names: dict[str, str]
    notes: tuple[Note, ...]
    difference: float
    rays: int

    def summary_lines(self, lens: Prescription) -> list[str]:
        """Return a summary of the camera and of the conversion for the user, line by line."""
        camera = self.camera
        mirrors = sum(m.light is None for m in camera.mirrors.values())
        faces = sum(m.light == "refracts" for m in camera.mirrors.values())
        parts = [f"{mirrors} mirrors"] + ([f"{faces} faces of lenses"] if faces else [])
        angles = [f"{math.degrees(a):.4g}" for a in (camera.field.x, camera.field.y, camera.field_bias)]
        return [
            f"{lens.name}: {', '.join(parts)}, stop {camera.stop}, f {camera.focal_length:.7g} m, entrance pupil "
            f"{camera.entrance_pupil:.6g} m, field {angles[0]} x {angles[1]} deg about {angles[2]} deg",
            f"{self.rays} rays traced through both differ by at most {self.difference:.1e} m on the image",
            *(f"note: {note}" for note in self.notes),
        ]


def camera_of(lens: Prescription, name: str, backend: Backend, width: Width = AS_IN_FILE) -> ReadCamera:
    """Make a camera from a prescription.

    Parameters
    ----------
    lens : Prescription
        The prescription.
    name : str
        Name of the camera.
    backend : Backend
        Backend that traces the rays.
    width : Width
        The user's options for beam and pixels.

    Raises
    ------
    InputError
        The prescription has content that a camera's file cannot represent, or light does not come through.
    """
    if abs(lens.image.pose.rotation[0, 2]) > OBLIQUE or abs(_image(lens)[1]) > LARGEST_TILT:
        lens = unfolded(lens)
    if lens.heights:
        lens = _by_angles(lens, name, backend, width)
    _check(lens)
    if _one_axis(lens) and not lens.round_field:
        try:
            return _camera_of(lens, name, backend, width)
        except InputError:
            # The corners of a square field are farther out than any field of the file.
            return _camera_of(replace(lens, round_field=True), name, backend, width)
    return _camera_of(lens, name, backend, width)


def _camera_of(lens: Prescription, name: str, backend: Backend, width: Width) -> ReadCamera:
    """Make a camera with the fields exactly as the prescription has them."""
    notes = list(lens.notes)
    sources = {name: getattr(glass, "source", "") for name, glass in lens.glasses.items()}
    taken_from = "the glass of {} is used; --glasses FILE.agf replaces it"
    notes += [Note(0, name, taken_from.format(source)) for name, source in sources.items() if source]
    surfaces, stop, origin, names = _surfaces(lens, notes)
    bias, half_x, half_y = _field(lens, surfaces, notes)
    image_entry = {"z": written(_image(lens)[0], LENGTH)}
    if _image(lens)[1]:
        image_entry["tilt"] = written(_image(lens)[1], ANGLE)
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
        "image": image_entry,
        "line": {"pixels": 2, "pitch": format_quantity(width.pitch, LENGTH)},
    }
    if any("glass" in surface for surface in surfaces.values()):
        plain["medium"] = "air"  # Indices of other programs are relative to air.
    narrow = _derived(lens, plain, backend)
    pupil = _pupil(lens, narrow, plain, backend, width)
    focal = narrow.line_principal_distance
    if math.isfinite(lens.object_distance):
        nearer, far = 1e6 * focal**2 / lens.object_distance, f"{lens.object_distance:.6g} m away, treated as infinity"
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
    text = (
        f"added with {plain['line']['pixels']} pixels of {format_quantity(width.pitch, LENGTH)}, which cover the field"
    )
    notes.append(Note(0, "line CCD", text))
    model = _without_idle_edges(_derived(lens, plain, backend), lens, plain, names, notes, backend)
    compared = _compared(lens, origin, model, backend)
    if compared is None:
        return camera_of(_round_field(lens), name, backend, width)
    difference, rays = compared
    if not difference < SAME:
        raise lens.error(
            "rays of the camera differ from those of the prescription", None, f"{difference:.2g} m", "at most 1 nm"
        )
    return ReadCamera(model.spec, names, tuple(notes), difference, rays)


def _round_field(lens: Prescription) -> Prescription:
    """Return the prescription with a round field instead of one whose corners are fully vignetted.

    Raises
    ------
    InputError
        Its field is round already.
    """
    x, y = np.array(lens.fields).T
    if lens.round_field:
        raise lens.error("edges block all light at the end of the field", allowed="a smaller field, or other edges")
    largest = float(np.max(np.hypot(x, y)))
    note = Note(0, "field", "edges block all light at its corners: treated as round")
    fields = ((0.0, -largest), (0.0, 0.0), (0.0, largest))
    return replace(lens, fields=fields, round_field=True).with_notes(note)


def _by_angles(lens: Prescription, name: str, backend: Backend, width: Width) -> Prescription:
    """Return the prescription with fields given as object or image heights converted to directions of the light."""
    heights = np.array(lens.heights)
    if lens.field_kind == "object heights":
        if not FAR <= abs(lens.object_distance) < math.inf:
            value = f"{lens.object_distance:.6g} m"
            raise lens.error("object heights without a distant object", None, value, "field angles: --field")
        tangents = -heights / lens.object_distance
    else:
        middle = replace(lens, fields=((0.0, 0.0),), heights=(), field_kind="angles")
        _check(middle)
        model = derive_camera(_camera_of(middle, name, backend, width).camera, backend)
        tangents = _tangents_at(model, lens, heights, backend)
    note = Note(0, "field", f"{lens.field_kind}: converted to the directions of their chief rays")
    fields = tuple((float(x), float(y)) for x, y in np.arctan(tangents))
    return replace(lens, fields=fields, heights=(), field_kind="angles").with_notes(note)


def _tangents_at(model: CameraModel, lens: Prescription, heights: np.ndarray, backend: Backend) -> np.ndarray:
    """Return the field directions whose chief rays meet the image at given heights, as tangents of their angles.

    Paraxial heights are converted by the scale in the middle of the image.

    Parameters
    ----------
    model : CameraModel
        The traced camera.
    lens : Prescription
        The prescription.
    heights : (F, 2) ndarray
        Image heights (x, y) of F fields, in metres.
    backend : Backend
        Backend that traces the rays.

    Returns
    -------
    (F, 2) ndarray
        Tangents of the angles along x and y.
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
        # Each step leaves the distortion alone.
        for _ in range(_STEPS if lens.field_kind == "real image heights" else 0):
            off = heights - places(tangents)
            tangents = tangents + off @ back
    except (AimError, BeamMissedError):
        off = np.array(np.nan)
    if not np.all(np.abs(off) <= _REACHED * np.max(np.abs(heights))):
        raise lens.error(f"no chief ray reaches its {lens.field_kind}", allowed="a smaller field: --field")
    return np.asarray(tangents)


_SMALL_STEP, _STEPS, _REACHED = 1e-6, 40, 1e-9
"""Constants of the search for the field direction of a given image height: step of the direction's tangent from which
the scale in the middle of the image is computed, largest number of iterations, and largest change in the last but
one iteration, relative to the largest height. With a distortion of 50 % the result is then right to 1e-12 of that
height; the iteration does not converge for heights that no ray reaches.
"""


def _check(lens: Prescription) -> None:
    """Raise InputError for content that a camera's file cannot represent."""
    if abs(lens.object_distance) < FAR:
        value = f"{lens.object_distance:.6g} m"
        raise lens.error("the object is at a finite distance", lens.surfaces[0].line, value, "a scene at infinity")
    if not lens.fields:
        raise lens.error("this kind of field is not supported", None, lens.field_kind, "field angles")
    image = lens.image
    if not image.surface.is_plane or image.surface.figure is not None:
        raise lens.error("the image is curved", image.line, allowed="a plane: --flat-image uses the tangent plane")
    if image.index != 1.0 or image.interaction is not Interaction.PASS:
        raise lens.error("the image is in glass", image.line, allowed="an image in the object's medium")
    normal = image.pose.rotation[:, 2]
    if abs(normal[0]) > OBLIQUE:
        raise lens.error("the image is tilted out of the plane of symmetry", image.line, allowed="a tilt about x")
    if abs(_image(lens)[1]) > LARGEST_TILT:
        value = f"{math.degrees(_image(lens)[1]):.4g} deg"
        problem = "the image is tilted too far relative to the axis along which light enters"
        raise lens.error(problem, image.line, value, "45 deg at most")


def _image(lens: Prescription) -> tuple[float, float]:
    """Return the image plane's position on the parent axis, in metres, and its tilt about x, in radians."""
    pose = lens.image.pose
    normal = pose.rotation[:, 2] * math.copysign(1.0, pose.rotation[2, 2])
    z = float(normal @ pose.translation / normal[2]) if abs(normal[2]) > 1e-3 else math.inf
    tilt = math.atan2(-float(normal[1]), float(normal[2]))
    return z, (tilt if abs(tilt) > 1e-15 else 0.0)


def _surfaces(lens: Prescription, notes: list[Note]) -> tuple[dict[str, Any], str, Prescription, dict[str, str]]:
    """Return the surfaces for a camera's file, and how they correspond to the prescription's.

    Returns
    -------
    tuple
        Name -> content of each surface as in a camera's file; name of the stop; prescription of the same surfaces; name
        in the camera -> name in the prescription.
    """
    out: dict[str, Any] = {}
    names: dict[str, str] = {}
    stop, surfaces, count = "", [], dict.fromkeys(_LETTER.values(), 0)
    for k, surface in enumerate(lens.surfaces[:-1]):
        is_dummy = surface.interaction is Interaction.PASS
        if is_dummy and k != lens.stop and not (surface.every_edge and surface.surface.is_plane):
            notes.append(Note(surface.line, surface.name, "a dummy surface: omitted"))
            continue
        surfaces.append(surface)
        letter = _LETTER[surface.interaction]
        count[letter] += 1
        name = "STOP" if is_dummy and k == lens.stop else f"{letter}{count[letter]}"
        if k == lens.stop:
            stop = name
            if surface.aperture is not None:
                text = "the stop's outer edge is omitted: the entrance pupil determines it"
                notes.append(Note(surface.line, surface.name, text))
                surface = without_rim(surface)
        names[name] = surface.name
        out[name] = _written(lens, facing(surface))
    if lens.image.every_edge:
        text = "the image's edge is omitted: it limits the field, and vignettes no light within"
        notes.append(Note(lens.image.line, lens.image.name, text))
    if not any(s.interaction is not Interaction.PASS for s in surfaces):
        raise lens.error("nothing in this file reflects or refracts light", lens.surfaces[0].line)
    bare = replace(lens, surfaces=(*surfaces, lens.image), stop=list(names).index(stop))
    return out, stop, bare, names


def _written(lens: Prescription, surface: LensSurface) -> dict[str, Any]:
    """Return the keys and values of one surface as a camera's file has them."""
    shape = surface.surface
    x, y, z = (float(v) for v in surface.pose.translation)
    out: dict[str, Any] = {"z": written(z, LENGTH)}
    if x or y:
        out["decentre"] = [written(v, LENGTH) for v in (x, y)]
    rotation = rotation_vector(surface.pose.rotation)
    if np.any(np.abs(rotation) > 0.0):
        out["rotate"] = [written(float(v), ANGLE) for v in rotation]
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
    """Return the key ``glass`` if a known glass has the surface's index, else the key ``index`` alone."""
    known = lens.glasses.get(surface.glass)
    if known is None or abs(known(lens.wavelength) - surface.index) > _SAME_INDEX:
        return {"index": surface.index}
    if isinstance(known, CatalogueGlass):
        return {"glass": glass_entry(known)}
    catalogue_name = next((name for name, glass in GLASSES.items() if glass.index == known), None)
    return {"index": surface.index} if catalogue_name is None else {"glass": catalogue_name}


def _terms(lens: Prescription, surface: LensSurface, shape: Surface) -> dict[str, Any]:
    """Return the sag terms beyond the conic (even powers, polynomials, Zernike terms) as a camera's file has them."""
    terms = list(shape.terms)
    if isinstance(shape.figure, ZernikeFigure):
        last = max(shape.figure.terms, default=0)
        if last > LAST_NOLL:
            problem = "Zernike terms, or a polynomial, of a higher order than a camera's file allows"
            allowed = f"Noll terms Z1 to Z{LAST_NOLL}, and x-y polynomials up to order 7"
            raise lens.error(problem, surface.line, f"Z{last}", allowed)
        coefficients = {f"Z{j}": a for j, a in shape.figure.terms.items()}
        x0, y0 = shape.figure.centre
        terms.append(ZernikeSag(radius=shape.figure.radius, x0=x0, y0=y0, **coefficients))
    elif shape.figure is not None:
        raise lens.error("a camera's file cannot represent a figure on a grid", surface.line, surface.name)
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
    """Return True if the fields lie on one axis and include its origin."""
    x, y = np.array(lens.fields).T
    out = np.hypot(x, y)
    return bool((np.all(x == 0.0) or np.all(y == 0.0)) and np.max(out) > 0.0 and np.min(out) == 0.0)


def _field(lens: Prescription, surfaces: dict[str, Any], notes: list[Note]) -> tuple[float, float, float]:
    """Return field bias and half angles along x and y, in radians."""
    x, y = np.array(lens.fields).T
    upright = not any({"decentre", "rotate", "sag"} & set(s) for s in surfaces.values()) and not _image(lens)[1]
    largest = float(np.max(np.hypot(x, y)))
    if upright and _one_axis(lens):
        wide = math.degrees(largest)
        if lens.round_field:
            text = f"a circle of {wide:.6g} deg about the axis; the camera's field is the inscribed square"
            notes.append(Note(0, "field", text))
            return 0.0, largest / math.sqrt(2.0), largest / math.sqrt(2.0)
        text = (
            f"angles along one axis alone, to {wide:.6g} deg; the camera's field is a square of {wide:.6g} deg to each "
            f"side, with corners at {math.sqrt(2.0) * wide:.4g} deg. --field '{wide:.6g} deg' uses the inscribed "
            "square"
        )
        notes.append(Note(0, "field", text))
        return 0.0, largest, largest
    bias = 0.5 * float(y.max() + y.min())
    half_x, half_y = float(np.max(np.abs(x))), 0.5 * float(y.max() - y.min())
    if half_x == 0.0 and half_y == 0.0:
        half_x = half_y = _SINGLE_FIELD
        notes.append(Note(0, "field", f"a single direction; half angles of {math.degrees(half_x):g} deg assumed"))
    elif half_x == 0.0 or half_y == 0.0:
        half_x = half_y = max(half_x, half_y)
        notes.append(Note(0, "field", "angles along one axis alone; the same assumed along the other"))
    return bias, half_x, half_y


def _derived(lens: Prescription, plain: dict[str, Any], backend: Backend) -> CameraModel:
    """Trace the camera whose file content is ``plain`` and return its model."""
    try:
        spec = CameraSpec.model_validate(plain)
    except ValueError as error:
        reason = next((str(e["ctx"]["error"]) for e in getattr(error, "errors", list)() if "ctx" in e), str(error))
        problem = error.problem if isinstance(error, Problem) else reason.splitlines()[0]
        raise lens.error(f"a camera's file cannot represent this: {problem}") from error
    try:
        return derive_camera(spec, backend, check_stated=False)
    except InputError as error:
        raise lens.error(error.issues[0].problem, allowed="a system that images its field") from error


def _pupil(lens: Prescription, narrow: CameraModel, plain: dict[str, Any], backend: Backend, width: Width) -> float:
    """Return the diameter of the entrance pupil that the prescription or the user's option defines, in metres."""
    if width.pupil is not None:
        return width.pupil
    allowed = "the entrance pupil's diameter: --pupil"
    if lens.pupil is None:
        raise lens.error("the file does not define the width of the beam", allowed=allowed)
    if lens.pupil.kind == "diameter":
        return lens.pupil.value
    if lens.pupil.kind == "stop":
        plain["stop_diameter"] = written(2.0 * lens.pupil.value, LENGTH)
        return float(f"{_derived(lens, plain, backend).entrance_pupil:.9g}")
    if lens.pupil.kind == "f_number":
        if any({"decentre", "rotate"} & set(surface) for surface in plain["mirrors"].values()):
            problem = "an F-number of a system with rotated or off-axis surfaces"
            raise lens.error(problem, lens.pupil.line, allowed=allowed)
        return narrow.paraxial.focal_length / lens.pupil.value
    raise lens.error("a numerical aperture in object space", lens.pupil.line, allowed=allowed)


def _beams(model: CameraModel, lens: Prescription, stop: np.ndarray, fields: int, backend: Backend) -> Rays:
    """Trace rays of a grid of field directions through given points of the stop.

    Parameters
    ----------
    model : CameraModel
        The camera.
    lens : Prescription
        Its prescription.
    stop : (N, 2) ndarray
        Points of the stop, in units of its radius.
    fields : int
        Number of field directions along each axis.
    backend : Backend
        Backend that traces the rays.
    """
    spec, names = model.spec, model.mirrors
    to_stop = assemble(model.bare_assembly(apertures=False), [names[: names.index(spec.stop) + 1]])
    shares = np.linspace(-1.0, 1.0, fields)
    directions = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x in shares for y in shares])
    launch = collimated(backend, to_stop, directions, float(model.apertures[spec.stop].bounds[1]) * stop)
    heading = np.broadcast_to(directions[:, None], launch.shape)
    return make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3))


def _met(model: CameraModel, lens: Prescription, stop: np.ndarray, fields: int, backend: Backend) -> list[np.ndarray]:
    """Return the points, (rays, 3), at which the rays of ``_beams`` meet each surface, in the surface's own frame."""
    rays = _beams(model, lens, stop, fields, backend)
    mirrors = range(len(model.mirrors))
    traced = trace(backend, assemble(model.bare_assembly(apertures=False), ["imaging"]), rays, keep=mirrors)
    return [traced.hit(k)[0] for k in mirrors]


def _compared(
    lens: Prescription, origin: Prescription, model: CameraModel, backend: Backend
) -> tuple[float, int] | None:
    """Return the largest distance at the image between rays of camera and prescription, in metres, and the ray count.

    None if a field is fully vignetted.
    """
    bare = model.bare_assembly(apertures=False)
    angle = 2.0 * np.pi * np.arange(_RIM) / _RIM
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # Middle and rim of a vignetted beam may be missing.
    stop = np.concatenate([np.zeros((1, 2)), *([0.75 * rim, 0.9 * rim] if model.edges else []), rim])
    rays, ends, arrived = _beams(model, lens, stop, 3, backend), [], []
    for assembly, sequence in ((bare, "imaging"), (origin.assembly(apertures=False), SEQUENCE)):
        traced = trace(backend, assemble(assembly, [sequence]), rays, world=True)
        position, _, path, valid = traced.numpy(traced.world)
        ends.append(np.concatenate([position[0], path[0, :, None]], axis=-1))
        arrived.append(valid[0])
    through = arrived[0]
    if model.edges:
        # Rays that an edge blocks need not arrive, but some rays of every field have to.
        hits = _met(model, lens, stop, 3, backend)
        through = through & model.unvignetted(lambda name: hits[model.mirrors.index(name)])
        if not np.any(through.reshape(9, -1), axis=-1).all():
            return None
        lost = not np.array_equal(*arrived)
    else:
        lost = not (arrived[0].all() and arrived[1].all())
    if lost:
        raise lens.error("rays of the full field do not come through", allowed="a smaller field or pupil")
    ends = [place[through] for place in ends]
    return float(np.max(np.abs(ends[0] - ends[1]))), len(ends[0])


def _without_idle_edges(
    model: CameraModel,
    lens: Prescription,
    plain: dict[str, Any],
    names: dict[str, str],
    notes: list[Note],
    backend: Backend,
) -> CameraModel:
    """Return the camera without clear apertures that block no light of its field."""
    if not model.edges:
        return model
    angle = 2.0 * np.pi * np.arange(_FINE_RIM) / _FINE_RIM
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = _met(model, lens, rim, 5, backend)
    idle = 0
    for name, edges in model.edges.items():
        hits = points[model.mirrors.index(name)]
        needed = [
            edge.blocks or (isinstance(edge.shape, Circle) and edge.shape.inner > 0.0)
            or not bool(np.all(edge.passes(hits[:, 0], hits[:, 1])))
            for edge in edges
        ]  # fmt: skip
        idle += needed.count(False)
        surface = plain["mirrors"][name]
        surface["edges"] = [edge for edge, is_needed in zip(surface["edges"], needed, strict=True) if is_needed]
        if not surface["edges"]:
            del surface["edges"]
            if surface.get("light") == "passes" and name != model.spec.stop:
                del plain["mirrors"][name], names[name]
    if not idle:
        return model
    notes.append(Note(0, "clear apertures", f"{idle} of them block no light of the field: omitted"))
    return _derived(lens, plain, backend)


def camera_text(made: ReadCamera, lens: Prescription) -> str:
    """Return the text of the camera's file, with the notes of the conversion in its head."""
    remark = [f"Read from {lens.file} by python -m scenes.lens read."]
    remark += [f"{name}: {surface}" for name, surface in made.names.items() if name != surface]
    remark += [str(note) for note in made.notes]
    return made.camera.file_text("\n".join(printable(line) for line in remark))
