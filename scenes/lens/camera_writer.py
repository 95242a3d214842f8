"""Writers of a camera, as designed or in a job's perturbed state, as a Zemax sequential file or a batoid YAML file.

Zemax (.zmx): surface 1 is a dummy plane, the frame of the prescription. A rotated or off-axis surface lies between two
coordinate breaks, the second of which undoes the first (order flag 1), so that distances remain those along the axis.
The pupil is defined by the size of the stop, with real ray aiming.

batoid: there light comes down from +z; here it enters toward +z. Everything is rotated about x by 180 deg.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.sag_terms import XYPolynomial
from optics.geometry.surface import GridFigure, SummedFigure, Surface, ZernikeFigure, plane
from optics.geometry.tree import AT_REST, State
from optics.raytrace.assembly import Interaction
from scenes.lens import prescription
from scenes.lens.prescription import LensSurface, Note, Prescription, Pupil, facing, joined, polynomial_of
from scenes.models.camera_model import IMAGE, LIGHT, CameraModel, line_body
from scenes.models.instrument_model import Instrument
from scenes.specs.instrument import BASE
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml


def prescription_of(model: CameraModel) -> Prescription:
    """Return the prescription of a camera as designed."""
    spec, index_behind, index = model.spec, {}, 1.0
    for name, mirror in spec.mirrors.items():
        index = spec.index_behind(name) if mirror.light == "refracts" else index
        index_behind[name] = index
    surfaces = [
        LensSurface(
            name, model.mirror_pose(name), joined(model.surfaces[name]), how, index_behind[name], *_bounds(model, name)
        )
        for name, how in ((name, LIGHT[mirror.light]) for name, mirror in spec.mirrors.items())
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
        # The size of the stop, because every program defines a pupil's diameter by another ray.
        Pupil("stop", float(model.apertures[spec.stop].bounds[1])),
    )


def _bounds(model: CameraModel, name: str) -> tuple[Any, ...]:
    """Return a surface's clear aperture, line of the file and glass (both empty here), and its further edges."""
    edges = model.edges.get(name, ())
    if name == model.spec.stop or not edges:
        return model.apertures[name], 0, "", edges
    first = edges[0].shape
    if not edges[0].blocks and not edges[0].rotation and isinstance(first, Aperture):
        return first, 0, "", edges[1:]
    # Write the edges of the file, not the box around the beams.
    return None, 0, "", edges


def field_angles(model: CameraModel) -> tuple[tuple[float, float], ...]:
    """Return centre, ends and corners of the field as angles along and across the line, in radians.

    Each direction is (tan x, tan y, 1) for the angles (x, y).
    """
    spec = model.spec
    sides = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    shares = [(0.0, 0.0), *sides, *product((1.0, -1.0), repeat=2)]
    return tuple((x * spec.field.x, spec.field_bias + y * spec.field.y) for x, y in shares)


def perturbed_prescription(instrument: Instrument, camera: str, state: State) -> Prescription:
    """Return the prescription of a camera in a perturbed instrument, in the frame in which it was designed.

    Poses of the mirrors include the motions of all bodies that carry them, shapes include thermal expansion, and
    figures lie on the surfaces. Parts that do not belong to the camera, such as prisms, are omitted and listed in the
    notes.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    camera : str
        Name of the camera in it.
    state : State
        Path of each moved body -> its motion.

    Raises
    ------
    ValueError
        A figure cannot be represented on its surface.
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
        shape = joined(element.figured(state.get(body, AT_REST)).scaled(size))
        aperture = None if element.aperture is None else element.aperture.scaled(size)
        surfaces.append(LensSurface(name, pose, shape, element.interaction, 1.0, aperture))
    k = placed.index[line_body(root)]
    line = design @ Pose(placed.rotation[0, k], placed.translation[0, k])
    image = line @ model.focal_plane.inverse() @ model.image_body
    surfaces.append(replace(nominal.image, pose=image))
    radius = float(surfaces[nominal.stop].aperture.bounds[1])  # type: ignore[union-attr]
    moved = replace(nominal, surfaces=tuple(surfaces), pupil=Pupil("stop", radius))
    return moved.with_notes(*_omitted_bodies(state, root))


def _omitted_bodies(state: Mapping[str, object], root: str) -> list[Note]:
    """Return notes on the bodies of a state that do not belong to a camera's prescription."""
    ours = {BASE, root}
    carried = [
        p for p in state if p in ours or (p.startswith(f"{root}/") and "/monitor" not in p and "area_ccd" not in p)
    ]
    count_unknown = [p for p in state if p not in carried]
    return [Note(0, path, "not part of this camera: omitted") for path in count_unknown]


def rounded(pose: Pose) -> Pose:
    """Return the pose with rounding errors of pose products, below 1e-15 m and 1e-15 rad, set to zero."""
    rotation = np.where(np.abs(pose.rotation) < 1e-15, 0.0, pose.rotation)
    if np.allclose(rotation, np.eye(3), rtol=0.0, atol=2e-16):
        rotation = np.eye(3)
    return Pose(rotation, np.where(np.abs(pose.translation) < 1e-15, 0.0, pose.translation))


MM = 1e3
LAST_EVEN = 16
"""Highest even power of the radius in EVENASPH and SZERNSAG."""


def zemax_text(lens: Prescription) -> str:
    """Return the text of a Zemax file; encode it as UTF-16 with a byte order mark, or as UTF-8.

    Raises
    ------
    InputError
        The format cannot represent a surface exactly.
    """
    lines = [
        "VERS 161019 0 0",
        "MODE SEQ",
        f'NAME "{_plain(lens.name)}"',
        "UNIT MM X W X CM MR CPMM",
        "FLOA",
        "GFAC 0 0",
        "RAIM 0 2 1 1 0 0 0 0 0",
        f"FTYP 0 0 {len(lens.fields)} 1 0 0 0",
        "XFLN " + " ".join(_number(math.degrees(x)) for x, _ in lens.fields),
        "YFLN " + " ".join(_number(math.degrees(y)) for _, y in lens.fields),
        "FWGN " + " ".join("1" for _ in lens.fields),
        f"WAVM 1 {_number(lens.wavelength * 1e6)} 1",
        "PWAV 1",
    ]
    lines += [f'NOTE 0 "{_plain(str(note))}"' for note in lens.notes]
    number = 0

    def surface(kind: str, *rest: str, thickness: float = 0.0, curvature: float = 0.0) -> None:
        """Append the Zemax statements of one surface, of a type, with further statements, thickness and curvature."""
        nonlocal number
        stop = [r for r in rest if r == "STOP"]
        others = [r for r in rest if r != "STOP"]
        far = "INFINITY" if math.isinf(thickness) else _number(thickness * MM)
        # A semi-diameter precedes the edge that it belongs to: readers treat the edge as a change of it.
        edges = [r for r in others if r.split()[0] in ("DIAM", "CLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "OBDC")]
        shape = [r for r in others if r not in edges]
        body = [*stop, f"TYPE {kind}", f"CURV {_number(curvature / MM)} 0 0 0 0", *shape, f"DISZ {far}", *edges]
        lines.append(f"SURF {number}")
        lines.extend(f"  {line}" for line in body)
        number += 1

    surface("STANDARD", thickness=math.inf)
    poses = [rounded(facing(s).pose) for s in lens.surfaces]
    surface("STANDARD", "COMM frame", thickness=float(poses[0].translation[2]))
    for k, (pose, optic) in enumerate(zip(poses, map(facing, lens.surfaces), strict=True)):
        last = k == len(lens.surfaces) - 1
        there = float(poses[k + 1].translation[2] - pose.translation[2]) if not last else 0.0
        out, back = _breaks(pose)
        kind, rest = _shape(lens, optic)
        rest = [f"COMM {optic.name}", *rest, *_edges(lens, optic)]
        if k == lens.stop:
            rest.append("STOP")
        if optic.interaction is Interaction.REFLECT:
            rest.append("GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0")
        if out:
            surface("COORDBRK", *out)
        surface(kind, *rest, thickness=0.0 if out and not last else there, curvature=optic.surface.curvature)
        if out and not last:
            surface("COORDBRK", *back, thickness=there)
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Return a number as text with all digits of the float."""
    return repr(float(value))


def _plain(text: str) -> str:
    """Return a text in which double quotes and characters other than printable ASCII are replaced by question marks."""
    return "".join(c if " " <= c <= "~" and c != '"' else "?" for c in text)


def _breaks(pose: Pose) -> tuple[list[str], list[str]]:
    """Return the Zemax parameters of the coordinate breaks before and behind a surface; empty if it is on the axis."""
    r, (x, y, _) = pose.rotation, pose.translation
    if np.array_equal(r, np.eye(3)) and x == 0.0 and y == 0.0:
        return [], []
    # R = Rx Ry Rz
    tilt_y = math.atan2(r[0, 2], math.hypot(r[0, 0], r[0, 1]))
    tilt_x, tilt_z = math.atan2(-r[1, 2], r[2, 2]), math.atan2(-r[0, 1], r[0, 0])
    values = [x * MM, y * MM, *(math.degrees(t) for t in (tilt_x, tilt_y, tilt_z))]
    out = [f"PARM {n} {_number(v)}" for n, v in enumerate(values, start=1)]
    back = [f"PARM {n} {_number(-v)}" for n, v in enumerate(values, start=1)]
    return [*out, "PARM 6 0"], [*back, "PARM 6 1"]


def _edges(lens: Prescription, optic: LensSurface) -> list[str]:
    """Return the statements of a surface's edge: a clear aperture, an obscuration, or a disk with a hole."""
    aperture, further = optic.aperture, optic.edges
    if len(further) == 1 and isinstance(aperture, Circle) and not aperture.inner and further[0].blocks:
        hole = further[0].shape
        if isinstance(hole, Circle) and not hole.inner and hole.centre == aperture.centre:
            aperture, further = Circle(aperture.radius, aperture.centre, hole.radius), ()
    blocked = further[0].shape if len(further) == 1 and aperture is None and further[0].blocks else None
    if further and (not isinstance(blocked, Aperture) or further[0].rotation):
        what = "edges other than a clear aperture or an obscuration"
        raise _cannot(lens, optic, what, "one circle, rectangle or ellipse, or a batoid YAML")
    if isinstance(blocked, Circle) and blocked.inner:
        raise _cannot(lens, optic, "an obscuration with a hole", "one circle, rectangle or ellipse, or a batoid YAML")
    match blocked or aperture:
        case None:
            return []
        case Circle(radius, centre, inner):
            size, line = radius, f"{'OBSC' if blocked else 'CLAP'} {_number(inner * MM)} {_number(radius * MM)} 0"
        case Rectangle(half_x, half_y, centre):
            kind = "SQOB" if blocked else "SQAP"
            size, line = math.hypot(half_x, half_y), f"{kind} {_number(half_x * MM)} {_number(half_y * MM)} 0"
        case Ellipse(half_x, half_y, centre):
            kind = "ELOB" if blocked else "ELAP"
            size, line = max(half_x, half_y), f"{kind} {_number(half_x * MM)} {_number(half_y * MM)} 0"
    lines = [f"DIAM {_number((size + math.hypot(*centre)) * MM)} 1 0 0 1", line]
    if any(centre):
        lines.append(f"OBDC {_number(centre[0] * MM)} {_number(centre[1] * MM)}")
    return lines


def _shape(lens: Prescription, optic: LensSurface) -> tuple[str, list[str]]:
    """Return the Zemax kind of a surface and the statements of its shape."""
    if optic.interaction is Interaction.REFRACT:
        raise _cannot(
            lens, optic, "a face of a lens: it names a glass where a camera's file has an index", "batoid YAML"
        )
    shape = optic.surface
    conic = [f"CONI {_number(shape.conic)}"] if shape.conic else []
    if isinstance(shape.figure, GridFigure | SummedFigure):
        raise _cannot(lens, optic, "a figure on a grid", "Zernike terms")
    if isinstance(shape.figure, ZernikeFigure) and any(shape.figure.terms.values()):
        if shape.terms:
            raise _cannot(lens, optic, "Zernike terms on a surface with other sag terms", "one kind of terms")
        return "SZERNSAG", [*conic, *_even(lens, optic, shape), *_zernike(shape.figure)]
    if shape.terms:
        return "XPOLYNOM", [*conic, *_polynomial(lens, optic, shape)]
    if any(shape.even):
        return "EVENASPH", [*conic, *_even(lens, optic, shape)]
    return "STANDARD", conic


def _even(lens: Prescription, optic: LensSurface, shape: Surface) -> list[str]:
    """Return the Zemax statements of a surface's even powers of the radius."""
    if 2 * len(shape.even) + 2 > LAST_EVEN:
        raise _cannot(lens, optic, f"even powers beyond r^{LAST_EVEN}", f"A4 to A{LAST_EVEN}")
    terms = [0.0, *(a * MM ** (-2 * n - 3) for n, a in enumerate(shape.even))]
    return [f"PARM {n} {_number(a)}" for n, a in enumerate(terms, start=1)]


def _zernike(figure: ZernikeFigure) -> list[str]:
    """Return the Zemax statements of a figure's Zernike terms."""
    last = max(figure.terms)
    lines = [f"PARM 9 {_number(figure.centre[0] * MM)}", f"PARM 10 {_number(figure.centre[1] * MM)}"]
    values = [float(last), figure.radius * MM, *(figure.terms.get(j, 0.0) * MM for j in range(1, last + 1))]
    return lines + [f"XDAT {n} {_number(v)} 0 0 1" for n, v in enumerate(values, start=1)]


def _polynomial(lens: Prescription, optic: LensSurface, shape: Surface) -> list[str]:
    """Return the Zemax statements of a surface's polynomial in x and y."""
    if any(not isinstance(term, XYPolynomial) for term in shape.terms):
        raise _cannot(lens, optic, "sag terms that the format does not have", "polynomial")
    radius = 0.1
    terms: Mapping[tuple[int, int], float] = polynomial_of(shape)
    order = max(a + b for a, b in terms)
    if order > 20:
        raise _cannot(lens, optic, "a polynomial beyond order 20", "lower orders")
    pairs = [(n - b, b) for n in range(1, order + 1) for b in range(n + 1)]
    values = [float(len(pairs)), radius * MM, *(terms.get((a, b), 0.0) * radius ** (a + b) * MM for a, b in pairs)]
    return [f"XDAT {n} {_number(v)} 0 0 1" for n, v in enumerate(values, start=1)]


def _cannot(lens: Prescription, optic: LensSurface, what: str, allowed: str) -> InputError:
    """Return an error about content that a .zmx file cannot represent."""
    return lens.error(f"a .zmx file cannot represent {what}", optic.line, optic.name, allowed)


def batoid_text(lens: prescription.Prescription) -> tuple[str, tuple[prescription.Note, ...]]:
    """Return the text of a batoid file, and notes on what it omits.

    Raises
    ------
    InputError
        Batoid has no such surface.
    """
    notes: list[prescription.Note] = []
    items: list[dict[str, Any]] = []
    index = 1.0
    for k, surface in enumerate(lens.surfaces):
        try:
            over = prescription.turned_over(surface)
        except TypeError as error:
            problem = f"a batoid file cannot represent this: {error}"
            raise lens.error(problem, surface.line, surface.name, "polynomials and Zernike terms") from None
        pose = rounded(prescription.OVER @ over.pose)
        last = k == len(lens.surfaces) - 1
        kind = {Interaction.REFLECT: "Mirror", Interaction.REFRACT: "RefractiveInterface"}.get(surface.interaction)
        item: dict[str, Any] = {"type": "Detector" if last else kind or "Interface", "name": surface.name}
        item["surface"] = _surface(lens, over)
        place = _place(pose)
        if place:
            item["coordSys"] = place
        item["inMedium"] = index
        if surface.interaction is Interaction.REFRACT:
            index = surface.index
        item["outMedium"] = index
        cuts = over.every_edge
        if item["type"] == "Interface" and cuts and k != lens.stop:
            item["type"] = "Baffle"
        parts = [part for edge in cuts if (part := _obscuration(edge)) is not None]
        if parts and item["type"] != "Interface":
            item["obscuration"] = parts[0] if len(parts) == 1 else {"type": "ObscUnion", "items": parts}
        if len(parts) < len(cuts) or (cuts and item["type"] == "Interface"):
            notes.append(prescription.Note(0, surface.name, "its aperture is omitted"))
        if item["type"] == "Interface":
            item.pop("inMedium"), item.pop("outMedium")
        items.append(item)
    system = {"type": "CompoundOptic", "name": lens.name, "inMedium": 1.0, "items": items}
    remarks = [
        f"# {lens.name} at {lens.wavelength * 1e9:.6g} nm, written by python -m scenes.lens write. Metres, radians.",
        "# Light comes down from +z: batoid's x is the prescription's, y and z are rotated about it by 180 deg.",
        *(f"# {note}" for note in (*lens.notes, *notes)),
    ]
    return "\n".join(remarks) + "\n" + dump_yaml({"opticalSystem": system}), tuple(notes)


def _place(pose: Pose) -> dict[str, float]:
    """Return a pose in batoid's keys: shifts along x, y, z, then rotations about the moved x, y and z."""
    out = {name: float(v) for name, v in zip("xyz", pose.translation, strict=True) if v}
    r = pose.rotation
    if not np.array_equal(r, np.eye(3)):
        rotations = {
            "rotX": math.atan2(-r[1, 2], r[2, 2]),
            "rotY": math.atan2(r[0, 2], math.hypot(r[0, 0], r[0, 1])),
            "rotZ": math.atan2(-r[0, 1], r[0, 0]),
        }
        out.update({name: angle for name, angle in rotations.items() if angle})
    return out


def _surface(lens: prescription.Prescription, optic: prescription.LensSurface) -> dict[str, Any]:
    """Return the keys and values of a surface's shape in a batoid file."""
    shape = optic.surface
    freeform = prescription.polynomial_of(Surface(terms=shape.terms)) if shape.terms else {}
    radius = 0.0
    figure = shape.figure
    if isinstance(figure, ZernikeFigure) and any(figure.terms.values()):
        radius = figure.radius
        if any(figure.centre) or freeform:
            radius += math.hypot(*figure.centre)
            for pair, value in prescription.about_vertex(figure).items():
                freeform[pair] = freeform.get(pair, 0.0) + value
    base: dict[str, Any] = {"type": "Plane"}
    if shape.curvature:
        base = {"type": "Quadric", "R": 1.0 / shape.curvature, "conic": shape.conic}
        if any(shape.even):
            base = {**base, "type": "Asphere", "coefs": [float(a) for a in shape.even]}
        elif shape.conic == -1.0:
            # For a ray along the axis of a Quadric with this conic, batoid divides by zero.
            base = {"type": "Paraboloid", "R": 1.0 / shape.curvature}
    elif any(shape.even):
        for pair, value in prescription.polynomial_of(Surface(even=shape.even)).items():
            freeform[pair] = freeform.get(pair, 0.0) + value
    terms: dict[int, float] = {}
    if freeform:
        radius = radius or (0.5 * float(np.ptp(optic.aperture.bounds[:2])) if optic.aperture else 0.1)
        if max(a + b for a, b in freeform) > prescription.LARGEST_ORDER:
            raise lens.error("a batoid file cannot represent a polynomial of so high an order", optic.line, optic.name)
        terms = prescription.zernike_of({(a, b): c * radius ** (a + b) for (a, b), c in freeform.items()})
    elif isinstance(figure, ZernikeFigure):
        terms = {j: a for j, a in figure.terms.items() if a}
    if not terms:
        return base
    listed = [float(terms.get(j, 0.0)) for j in range(max(terms) + 1)]
    return {"type": "Sum", "items": [base, {"type": "Zernike", "coef": listed, "R_outer": radius, "R_inner": 0.0}]}


def _obscuration(edge: Edge) -> dict[str, Any] | None:
    """Return the keys and values of an edge in a batoid file; None for a kind that batoid lacks."""
    kind, shape = "Obsc" if edge.blocks else "Clear", edge.shape
    x, y = shape.centre
    theta = {"theta": edge.rotation} if edge.rotation else {}
    match shape:
        case Circle(radius, _, inner):
            if inner:
                return {"type": f"{kind}Annulus", "inner": inner, "outer": radius, "x": x, "y": y}
            return {"type": f"{kind}Circle", "radius": radius, "x": x, "y": y}
        case Rectangle(half_x, half_y):
            return {"type": f"{kind}Rectangle", "width": 2.0 * half_x, "height": 2.0 * half_y, "x": x, "y": y, **theta}
        case Ray(width):
            return {"type": f"{kind}Ray", "width": width, "x": x, "y": y, **theta}
        case Polygon(corners):
            xs, ys = ([float(value) for value in axis] for axis in zip(*corners, strict=True))
            return {"type": f"{kind}Polygon", "xs": xs, "ys": ys}
        case Ellipse():
            return None
