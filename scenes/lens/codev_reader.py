"""CODE V sequential files (.seq) as prescriptions.

Decentres shift along x, y and z and then turn about x, y and z in this order, each about the axes that the turn before
has made. Turns about x and y are left-handed, those about z right-handed: ADE > 0 turns +z toward +y.

| kind | what it does |
|---|---|
| DEC (no keyword) | the surface and all that follow stand in the new frame |
| DAR | the surface alone; what follows stands as if it were not decentred |
| BEN | the turn before the surface and once more behind it: what follows stands about the reflected axis |
| REV | the reverse of the same decentre, behind the surface: it undoes one |
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Edge
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface
from scenes.lens.codev_statements import CodevSurface, CodevSystem, statements, take
from scenes.lens.prescription import LARGEST_ORDER, Prescription, Pupil, clear, even_asphere, polynomial
from scenes.lens.statements import (
    NO_GLASSES,
    Chain,
    Glasses,
    Source,
    Statement,
    index_of,
    named_glasses,
    read_lines,
    require_d_line,
)


def read_codev(path: str | Path, glasses: Glasses = NO_GLASSES) -> Prescription:
    """Read a .seq file.

    Args:
        path: of the file, UTF-8, UTF-16 or ISO 8859-1.
        glasses: that its surfaces may name.

    Raises:
        InputError: the file is damaged, or says something that would be taken wrongly; with the line.
    """
    source = Source(str(path))
    lines = read_lines(source)
    system = CodevSystem(source)
    for statement in statements(lines):
        if system.private:
            system.private = statement.command != "END"
            continue
        take(system, statement)
    if not system.surfaces:
        raise source.error("no surface in this file", len(lines), allowed="SO, S, ... SI of a CODE V sequence")
    if system.surfaces[-1].name != "SI":
        problem = "the sequence has no image: it is cut off"
        raise source.error(problem, system.surfaces[-1].line, allowed="SI at its end")
    if len(system.surfaces) < 3:
        raise source.error("too few surfaces", system.surfaces[-1].line, allowed="object, optics and image")
    return _prescription(system, glasses)


def _prescription(system: CodevSystem, glasses: Glasses) -> Prescription:
    source, scale, read = system.source, system.scale, system.surfaces
    if not system.waves:
        raise source.error("no wavelength in this file", read[0].line, allowed="WL")
    reference = system.reference or (len(system.waves) + 1) // 2
    if reference > len(system.waves):
        raise source.error("the reference wavelength is none of those given", read[0].line, reference)
    wavelength = system.waves[reference - 1]
    chain = Chain(source)
    if read[0].medium:
        raise source.error("an object in glass", read[0].line, read[0].medium)
    for k, surface in enumerate(read[1:], start=1):
        last = k == len(read) - 1
        given = surface.decentre
        if not math.isfinite(surface.thickness):
            raise source.error("an infinite distance behind an optical surface", surface.line)
        shift = [given.get(name, 0.0) * scale for name in ("XDE", "YDE", "ZDE")]
        # left-handed about x and y
        angles = [math.radians(sign * given.get(name, 0.0)) for name, sign in (("ADE", -1), ("BDE", -1), ("CDE", 1))]
        turns = [about_axis(axis, angle) for axis, angle in enumerate(angles)]
        rotation = turns[0] @ turns[1] @ turns[2]
        before = chain.pose
        if last:
            # the image's "thickness" is a defocus: it stands so much farther along the axis that light came along
            chain.move((0.0, 0.0, surface.thickness * scale))
        if surface.kind != "REV":
            chain.move(shift, rotation)
        shape = _shape(system, surface)
        try:
            edges = _edges_of(surface)
        except ValueError as error:
            raise source.error(str(error), surface.line) from None
        behind = _behind(source, surface, wavelength, glasses)
        chain.meet(surface.name, shape, edges, behind, surface.line, surface.stop, last)
        if surface.kind == "DAR":
            chain.pose = before
        elif surface.kind == "BEN":
            if sum(a != 0.0 for a in angles) > 1:
                raise source.error("BEN with turns about several axes", surface.line, allowed="a turn about one axis")
            chain.move((0.0, 0.0, 0.0), rotation)
        elif surface.kind == "REV":
            back = Pose(rotation, np.array(shift)).inverse()
            chain.pose = chain.pose @ back
        if not last:
            chain.move((0.0, 0.0, surface.thickness * scale))
    pupil = system.pupil
    if pupil is not None and pupil.kind == "diameter":
        pupil = Pupil("diameter", pupil.value * scale, pupil.line)
    return chain.prescription(
        "STO",
        read[0].thickness * scale,
        system.name,
        wavelength=wavelength,
        wavelengths=tuple(dict.fromkeys(system.waves)),
        fields=_pairs(system) if system.field_kind == "angles" else (),
        heights=() if system.field_kind == "angles" else tuple((x * scale, y * scale) for x, y in _pairs(system)),
        field_kind=system.field_kind,
        pupil=pupil,
        glasses=named_glasses(glasses, chain.surfaces),
    )


def _pairs(system: CodevSystem) -> tuple[tuple[float, float], ...]:
    count = max(len(system.x), len(system.y))
    x, y = ([*given, *[0.0] * count][:count] for given in (system.x, system.y))
    return tuple(zip(x, y, strict=True))


def _behind(source: Source, surface: CodevSurface, wavelength: float, glasses: Glasses) -> tuple[float, str] | None:
    """Index and name of what lies behind a surface; None for a mirror. Six digits and a point are a fictitious glass,
    index and dispersion.
    """
    medium = surface.medium.strip("'\"")
    match medium.upper():
        case "" | "AIR":
            return 1.0, ""
        case "REFL":
            return None
        case "REFR_TIR" | "TIRO":
            raise source.error("total reflection is not known here", surface.line, medium)
    whole, point, rest = medium.partition(".")
    stated, colon, _ = medium.partition(":")
    if (point and whole.isdigit() and rest.isdigit()) or colon:
        require_d_line(source, "fictitious", medium, wavelength, surface.line)
        statement = Statement(surface.line, "S", (stated,), medium)
        index = source.finite(statement, 0, "the index") if colon else 1.0 + float(f"0.{whole}")
    else:
        index = index_of(source, glasses, medium, wavelength, surface.line)
    return index, "" if index == 1.0 else medium


def _shape(system: CodevSystem, surface: CodevSurface) -> Surface:
    scale = system.scale
    powers = {n: a * scale ** (1 - n) for n, a in surface.powers.items()}
    if not surface.special:
        return even_asphere(surface.curvature / scale, surface.conic, powers)
    if powers:
        raise system.source.error("even powers on a special surface", surface.line, allowed="SCO coefficients")
    conic = surface.polynomial.get(1, surface.conic)
    given = {}
    for m in range(LARGEST_ORDER + 1):
        for n in range(LARGEST_ORDER + 1 - m):
            j = ((m + n) ** 2 + m + 3 * n) // 2 + 1
            if m + n and j in surface.polynomial:
                given[(m, n)] = surface.polynomial[j] * scale ** (1 - m - n)
    sizes = [s for s in surface.sizes.values() if s > 0.0]
    radius = max(sizes, default=1.0)
    scaled = {(m, n): c * radius ** (m + n) for (m, n), c in given.items()}
    return polynomial(even_asphere(surface.curvature / scale, conic, {}), scaled, radius)


def _edges_of(surface: CodevSurface) -> tuple[Aperture | None, tuple[Edge, ...]]:
    """Clear aperture, and the hole in it where it is not round."""
    sizes = surface.sizes
    centre = (surface.centre.get("ADX", 0.0), surface.centre.get("ADY", 0.0))
    blocked = (Edge(Circle(surface.hole, centre), blocks=True),) if surface.hole else ()
    if "REX" in sizes or "REY" in sizes:
        wide = sizes.get("REX", sizes.get("REY", 0.0)), sizes.get("REY", sizes.get("REX", 0.0))
        return clear(rectangle=wide, centre=centre), blocked
    if "ELX" in sizes or "ELY" in sizes:
        wide = sizes.get("ELX", sizes.get("ELY", 0.0)), sizes.get("ELY", sizes.get("ELX", 0.0))
        return clear(ellipse=wide, centre=centre), blocked
    if "CIR" in sizes:
        return clear(sizes["CIR"], surface.hole, centre=centre), ()
    return None, blocked
