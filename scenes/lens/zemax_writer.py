"""A prescription as a Zemax sequential file (.zmx).

Surface 1 is a plane that does nothing: the prescription's own frame. A surface that is turned or off the axis stands
between two coordinate breaks, the second of which undoes the first (order flag 1), so that distances stay those along
the axis. The pupil is the size of the stop, with real ray aiming.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Ellipse, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.sag_terms import XYPolynomial
from optics.geometry.surface import GridFigure, SummedFigure, Surface, ZernikeFigure
from optics.raytrace.assembly import Interaction
from scenes.lens.camera_writer import rounded
from scenes.lens.prescription import LensSurface, Prescription, facing, polynomial_of
from scenes.yaml.errors import InputError

MM = 1e3
LAST_EVEN = 16
"""Highest even power of the radius that EVENASPH and SZERNSAG have."""


def zemax_text(lens: Prescription) -> str:
    """The file's text; write it as UTF-16 with a mark, or as UTF-8.

    Raises:
        InputError: a surface that the format cannot hold exactly.
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
        nonlocal number
        stop = [r for r in rest if r == "STOP"]
        others = [r for r in rest if r != "STOP"]
        far = "INFINITY" if math.isinf(thickness) else _number(thickness * MM)
        # a semi-diameter stands before the edge that it is the size of: readers take the edge as a change of it
        edges = [r for r in others if r.split()[0] in ("DIAM", "CLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "OBDC")]
        shape = [r for r in others if r not in edges]
        body = [*stop, f"TYPE {kind}", f"CURV {_number(curvature / MM)} 0 0 0 0", *shape, f"DISZ {far}", *edges]
        lines.append(f"SURF {number}")
        lines.extend(f"  {line}" for line in body)
        number += 1

    surface("STANDARD", thickness=math.inf)
    poses = [rounded(facing(s).pose) for s in lens.surfaces]
    surface("STANDARD", "COMM frame", thickness=float(poses[0].translation[2]))
    for k, (pose, given) in enumerate(zip(poses, map(facing, lens.surfaces), strict=True)):
        last = k == len(lens.surfaces) - 1
        there = float(poses[k + 1].translation[2] - pose.translation[2]) if not last else 0.0
        out, back = _breaks(pose)
        kind, rest = _shape(lens, given)
        rest = [f"COMM {given.name}", *rest, *_edges(lens, given)]
        if k == lens.stop:
            rest.append("STOP")
        if given.interaction is Interaction.REFLECT:
            rest.append("GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0")
        if out:
            surface("COORDBRK", *out)
        surface(kind, *rest, thickness=0.0 if out and not last else there, curvature=given.surface.curvature)
        if out and not last:
            surface("COORDBRK", *back, thickness=there)
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return repr(float(value))


def _plain(text: str) -> str:
    return "".join(c if " " <= c <= "~" and c != '"' else "?" for c in text)


def _breaks(pose: Pose) -> tuple[list[str], list[str]]:
    """Parameters of the coordinate break before a surface, and of the one behind it; empty for one on the axis."""
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


def _edges(lens: Prescription, given: LensSurface) -> list[str]:
    """Statements of what cuts the light: a clear aperture, an obscuration, or a disk with a hole."""
    aperture, further = given.aperture, given.edges
    if len(further) == 1 and isinstance(aperture, Circle) and not aperture.inner and further[0].blocks:
        hole = further[0].shape
        if isinstance(hole, Circle) and not hole.inner and hole.centre == aperture.centre:
            aperture, further = Circle(aperture.radius, aperture.centre, hole.radius), ()
    blocked = further[0].shape if len(further) == 1 and aperture is None and further[0].blocks else None
    if further and (not isinstance(blocked, Aperture) or further[0].turn):
        what = "edges beyond a clear aperture or an obscuration of its own"
        raise _cannot(lens, given, what, "one circle, rectangle or ellipse, or a batoid YAML")
    if isinstance(blocked, Circle) and blocked.inner:
        raise _cannot(lens, given, "an obscuration with a hole", "one circle, rectangle or ellipse, or a batoid YAML")
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


def _shape(lens: Prescription, given: LensSurface) -> tuple[str, list[str]]:
    """Kind of a surface and the statements of its shape."""
    if given.interaction is Interaction.REFRACT:
        raise _cannot(
            lens, given, "a face of a lens: a .zmx names a glass, and a camera's file an index", "batoid YAML"
        )
    shape = given.surface
    conic = [f"CONI {_number(shape.conic)}"] if shape.conic else []
    if isinstance(shape.figure, GridFigure | SummedFigure):
        raise _cannot(lens, given, "a figure on a grid", "Zernike terms")
    if isinstance(shape.figure, ZernikeFigure) and any(shape.figure.terms.values()):
        if shape.terms:
            raise _cannot(lens, given, "Zernike terms on a surface with other terms of its sag", "one of both")
        return "SZERNSAG", [*conic, *_even(lens, given, shape), *_zernike(shape.figure)]
    if shape.terms:
        return "XPOLYNOM", [*conic, *_polynomial(lens, given, shape)]
    if any(shape.even):
        return "EVENASPH", [*conic, *_even(lens, given, shape)]
    return "STANDARD", conic


def _even(lens: Prescription, given: LensSurface, shape: Surface) -> list[str]:
    if 2 * len(shape.even) + 2 > LAST_EVEN:
        raise _cannot(lens, given, f"even powers beyond r^{LAST_EVEN}", f"A4 to A{LAST_EVEN}")
    terms = [0.0, *(a * MM ** (-2 * n - 3) for n, a in enumerate(shape.even))]
    return [f"PARM {n} {_number(a)}" for n, a in enumerate(terms, start=1)]


def _zernike(figure: ZernikeFigure) -> list[str]:
    last = max(figure.terms)
    lines = [f"PARM 9 {_number(figure.centre[0] * MM)}", f"PARM 10 {_number(figure.centre[1] * MM)}"]
    values = [float(last), figure.radius * MM, *(figure.terms.get(j, 0.0) * MM for j in range(1, last + 1))]
    return lines + [f"XDAT {n} {_number(v)} 0 0 1" for n, v in enumerate(values, start=1)]


def _polynomial(lens: Prescription, given: LensSurface, shape: Surface) -> list[str]:
    if any(not isinstance(term, XYPolynomial) for term in shape.terms):
        raise _cannot(lens, given, "terms of a sag that the format does not have", "polynomial")
    radius = 0.1
    terms: Mapping[tuple[int, int], float] = polynomial_of(shape)
    order = max(a + b for a, b in terms)
    if order > 20:
        raise _cannot(lens, given, "a polynomial beyond order 20", "lower orders")
    pairs = [(n - b, b) for n in range(1, order + 1) for b in range(n + 1)]
    values = [float(len(pairs)), radius * MM, *(terms.get((a, b), 0.0) * radius ** (a + b) * MM for a, b in pairs)]
    return [f"XDAT {n} {_number(v)} 0 0 1" for n, v in enumerate(values, start=1)]


def _cannot(lens: Prescription, given: LensSurface, what: str, allowed: str) -> InputError:
    return lens.error(f"a .zmx cannot carry {what}", given.line, given.name, allowed)
