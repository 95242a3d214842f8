"""Reader of CODE V sequential files (.seq).

Decentres shift along x, y and z and then rotate about x, y and z in this order, each about the axes left by the
rotation before. Rotations about x and y are left-handed, those about z right-handed: ADE > 0 rotates +z toward +y.

| kind | effect |
|---|---|
| DEC (no keyword) | the surface and all that follow are in the new frame |
| DAR | the surface alone; what follows is placed as if it were not decentred |
| BEN | the rotation before the surface and once more behind it: what follows is placed about the reflected axis |
| REV | the inverse of the same decentre, behind the surface: it undoes one |
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Rectangle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface
from scenes.lens.prescription import LARGEST_ORDER, Prescription, Pupil, even_asphere, polynomial
from scenes.lens.statements import (
    MOST_SURFACES,
    NO_GLASSES,
    Chain,
    Glasses,
    Source,
    Statement,
    index_of,
    is_number,
    joined,
    named_glasses,
    paired,
    read_lines,
    require_d_line,
    statement_of,
)

UNITS = {"M": 1e-3, "MM": 1e-3, "C": 1e-2, "CM": 1e-2, "I": 25.4e-3, "IN": 25.4e-3}
_POWERS = {name: 4 + 2 * k for k, name in enumerate("ABCDEFGHJ")}
"""Name of a CODE V command for an aspheric coefficient, A to J -> power of the radius; CODE V skips the letter I."""

OF_NO_EFFECT = frozenset(
    # the program's version and author, weights, vignetting solves, variables, couplings, zoom lists, colours,
    # derivatives of tolerances, drawing, temperature of a prescription that is taken as it stands
    "LEN TIT TITLE INI WTW WTF POL CA GO END CLS DER CCY THC KC AC BC CC DC EC FC GC HC JC CUM THM CCM GLC SLB LAB "
    "RGL TEM PRE XDC YDC ZDC ADC BDC CDC IWT COM TOL DLT DLR DLN DLZ VIE OUT CUR PIM PIK MHT MWT EDI PUI PUX "
    "PUY".split()
)
_SYSTEM = frozenset("RDM DIM EPD FNO NA NAO WL REF TIT TITLE PRV ZOO FLD VUX VLX VUY VLY".split())
_GEOMETRY = frozenset("XDE YDE ZDE ADE BDE CDE".split())
_REFUSED = {
    "RET": "a return to the frame of another surface",
    "GLB": "a global decentre",
    "NSS": "a non-sequential surface",
    "NSE": "the end of a non-sequential range",
    "TOR": "a toroid",
    "CYL": "a cylinder",
    "AAS": "an anamorphic asphere",
    "YTO": "a toroid",
    "SPL": "a spline surface",
    "DIF": "a diffractive surface",
    "GRT": "a grating",
    "GRO": "a grating",
    "HOE": "a hologram",
    "INT": "an interferogram on a surface",
    "ARR": "an array of surfaces",
    "PHM": "a phase surface",
    "THO": "an optical thickness",
    "XOF": "an offset of the point of turning",
    "YOF": "an offset of the point of turning",
    "ZOF": "an offset of the point of turning",
    "FRE": "a Fresnel surface",
    "BAS": "a new base of coordinates",
}


@dataclass
class CodevSurface:
    """Surface of a CODE V file: what the statements read so far say about it."""

    name: str
    line: int
    curvature: float = 0.0
    thickness: float = 0.0
    medium: str = ""
    stop: bool = False
    conic: float = 0.0
    powers: dict[int, float] = field(default_factory=dict)
    polynomial: dict[int, float] = field(default_factory=dict)
    special: str = ""
    decentre: dict[str, float] = field(default_factory=dict)
    kind: str = "DEC"
    sizes: dict[str, float] = field(default_factory=dict)
    hole: float = 0.0
    centre: dict[str, float] = field(default_factory=dict)


@dataclass
class CodevSystem:
    """Optical system of a CODE V file: surfaces and settings from the statements read so far."""

    source: Source
    scale: float = 1e-3
    radii: bool | None = None
    name: str = ""
    pupil: Pupil | None = None
    waves: tuple[float, ...] = ()
    reference: int = 0
    x: tuple[float, ...] = ()
    y: tuple[float, ...] = ()
    field_kind: str = "angles"
    private: bool = False
    surfaces: list[CodevSurface] = field(default_factory=list)


def statements(lines: list[str]) -> list[Statement]:
    """Return the statements of a file: commands end at semicolons, & continues a line, ! starts a comment."""
    out: list[Statement | None] = []
    pending, first_line = "", 0
    for number, text in enumerate(lines, start=1):
        text, first_line = _split(text, "!")[0], first_line or number
        if text.rstrip().endswith("&"):
            pending += text.rstrip()[:-1] + " "
            continue
        out += [statement_of(first_line, part) for part in _split(pending + text, ";")]
        pending, first_line = "", 0
    out += [statement_of(first_line, part) for part in _split(pending, ";")]
    return [statement for statement in out if statement is not None]


def _split(text: str, mark: str) -> list[str]:
    """Return the parts of a text between separators, ignoring separators inside quotes.

    Parameters
    ----------
    text : str
        The text.
    mark : str
        Separator: a single character.
    """
    parts, quote = [""], ""
    for k, c in enumerate(text):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'" and c in text[k + 1 :]:
            quote = c
        elif c == mark:
            parts.append("")
            continue
        parts[-1] += c
    return parts


def take(system: CodevSystem, s: Statement) -> None:
    """Apply one statement of the file to the system that is being read."""
    source, command = system.source, s.command
    if command in ("SO", "S", "SI") or (command[0] == "S" and command[1:].isdigit()):
        _surface(system, s)
    elif command in _SYSTEM or command in _FIELDS:
        _take_system(system, s)
    elif command in _REFUSED:
        raise source.error(f"{_REFUSED[command]} is not supported", s.line, s.text)
    elif command in OF_NO_EFFECT or (command in ("CUF", "HOR") and not any(source.numbers(s))):
        pass
    elif command in ("RDY", "THI", "CUY", "GLA", "INS", "DEL", "REFL", "RMD", "SCA", "FLY"):
        problem = "a change of earlier surfaces is not supported"
        raise source.error(problem, s.line, s.text, "the sequence of surfaces")
    elif _qualified(s):
        # The statement is for a surface that it names, not for the last one.
        if command in (*_GEOMETRY, "K", "CON", "ASP", *_POWERS, "STO", "DAR", "BEN", "REV", "SPS", "SCO"):
            problem = "a change of an earlier surface is not supported"
            raise source.error(problem, s.line, s.text, "statements below the surface")
        source.note(s, "not understood")
    elif system.surfaces and _take_surface(system, system.surfaces[-1], s):
        pass
    else:
        source.note(s, "not understood")


_KINDS = {"AN": "angles", "OB": "object heights", "IM": "image heights", "RI": "real image heights"}
_FIELDS = {f"{axis}{ending}": kind for ending, kind in _KINDS.items() for axis in "XY"}


def _qualified(s: Statement) -> bool:
    """Return True if the first word names a surface: S4, SI, S3..5."""
    word = s.words[0].upper() if s.words else ""
    return word in ("SI", "SO", "SS") or (word[:1] == "S" and word[1:2].isdigit())


def _take_system(system: CodevSystem, s: Statement) -> None:
    """Apply a statement about the whole system: title, units, pupil, wavelengths, fields."""
    source = system.source
    match s.command:
        case "RDM":
            word = s.words[0].upper() if s.words else "Y"
            if word[:1] not in "YN":
                raise source.error("radii or curvatures?", s.line, s.text, "RDM Y, RDM N")
            if system.surfaces:
                raise source.error("RDM follows the first surface", s.line, s.text)
            system.radii = word[0] == "Y"
        case "DIM":
            unit = s.words[0].upper() if s.words else ""
            if unit not in UNITS:
                raise source.error("unknown unit of lengths", s.line, unit, "M (millimetres), C, I")
            system.scale = UNITS[unit]
        case "EPD" | "FNO" | "NAO" | "NA":
            value = source.finite(s, 0, "its number")
            if not value > 0.0:
                raise source.error(f"{s.command} is not greater than zero", s.line, s.text)
            if s.command == "NA":
                source.note(s, "a numerical aperture in image space: omitted, so that the pupil's diameter is unknown")
            else:
                kind = {"EPD": "diameter", "FNO": "f_number", "NAO": "object_na"}[s.command]
                system.pupil = Pupil(kind, value, s.line)
        case "WL":
            waves = tuple(v / 1e9 for v in source.numbers(s))
            wrong = [w for w in waves if not 1e-7 <= w <= 1e-4]
            if wrong or not waves:
                raise source.error("no wavelength of light", s.line, s.text, "100 to 100000 nm")
            system.waves = waves
        case "REF":
            system.reference = source.whole(s, 0, "the number of the reference wavelength", 1, 1000)
        case "TIT" | "TITLE":
            system.name = joined(s.words)
        case "PRV":
            system.private = True
            source.note(s, "private glasses are omitted")
        case "ZOO" | "FLD":
            source.note(s, "not understood")
        case "VUX" | "VLX" | "VUY" | "VLY":
            if any(source.numbers(s)):
                source.note(s, "vignetting factors are omitted; beams are limited by the stop")
        case _:
            values = source.numbers(s)
            system.field_kind = _FIELDS[s.command]
            if system.field_kind == "angles":
                if any(not abs(v) < 89.0 for v in values):
                    raise source.error("a field beyond 89 deg", s.line, s.text)
                values = tuple(math.radians(v) for v in values)
            if s.command[0] == "X":
                system.x = values
            else:
                system.y = values


def _surface(system: CodevSystem, s: Statement) -> None:
    """Append the surface of an SO, S or SI statement: radius or curvature, thickness, medium behind it."""
    source = system.source
    if system.surfaces and system.surfaces[-1].name == "SI":
        raise source.error("a surface behind the image", s.line, s.text)
    if (s.command == "SO") != (not system.surfaces):
        raise source.error("there must be one object, before all surfaces", s.line, s.text, "SO, then S, last SI")
    if len(system.surfaces) > MOST_SURFACES:
        raise source.error("too many surfaces", s.line, allowed=f"at most {MOST_SURFACES}")
    number = len(system.surfaces)
    if s.command[1:].isdigit() and int(s.command[1:]) != number:
        raise source.error("surfaces are not in order", s.line, s.command, f"S{number}")
    if system.radii is None:
        problem = "the file does not state if it has radii or curvatures"
        raise source.error(problem, s.line, s.text, "RDM Y or RDM N before the first surface")
    name = s.command if s.command in ("SO", "SI") else f"S{number}"
    first = source.finite(s, 0, "radius" if system.radii else "curvature", 0.0)
    thickness = source.number(s, 1, "the thickness", 0.0)
    curvature = first if not system.radii else (1.0 / first if first else 0.0)
    medium = ""
    for word in s.words[2:]:
        if medium:
            source.note(s, f"{word}: not understood")
        medium = medium or word
    system.surfaces.append(CodevSurface(name, s.line, curvature, thickness, medium))


def _take_surface(system: CodevSystem, surface: CodevSurface, s: Statement) -> bool:
    """Process a statement about the last surface; return False if it is unknown."""
    source = system.source
    match s.command:
        case "STO":
            surface.stop = True
        case "CON" | "ASP" | "SPH":
            surface.special = "" if surface.special == "XYP" and s.command == "SPH" else surface.special
        case "K":
            surface.conic = source.finite(s, 0, "the conic constant")
        case "SPS":
            surface.special = s.words[0].upper() if s.words else ""
            if surface.special != "XYP":
                raise source.error("this special surface is not supported", s.line, s.text, "SPS XYP")
        case "SCO":
            word = s.words[0].upper() if s.words else ""
            if word == "K" and len(s.words) == 2:
                surface.polynomial[1] = source.finite(s, 1, "the coefficient")
            elif word[:1] == "C" and word[1:].isdigit() and 1 <= int(word[1:]) <= 66:
                surface.polynomial[int(word[1:])] = source.finite(s, 1, "the coefficient")
            else:
                raise source.error("this coefficient is not supported", s.line, s.text, "SCO C1 to SCO C66")
        case "CUF":
            if any(source.numbers(s)):
                raise source.error("a curvature of a Fresnel base is not supported", s.line, s.text)
        case "DAR" | "BEN" | "REV":
            surface.kind = s.command
        case "CIR" | "REX" | "REY" | "ELX" | "ELY" | "ADX" | "ADY" | "ARO":
            return _edge(system, surface, s)
        case name if name in _GEOMETRY:
            surface.decentre[name] = source.finite(s, 0, "the decentre")
        case name if name in _POWERS:
            surface.powers[_POWERS[name]] = source.finite(s, 0, "the coefficient")
        case _:
            return False
    return True


def _edge(system: CodevSystem, surface: CodevSurface, s: Statement) -> bool:
    """Process an aperture: CIR r, CIR OBS r, CIR HOL r, REX, REY, ELX, ELY with ADX, ADY."""
    source = system.source
    words = [w.upper() for w in s.words if not (w[:1] in "'\"" or w.upper()[:2] == "L'")]
    kinds = [w for w in words if not is_number(w) and w not in ("'", '"')]
    numbers = [w for w in words if is_number(w)]
    if len(numbers) != 1:
        source.note(s, "not understood")
        return True
    value = source.value(s, numbers[0], "the size") * system.scale
    if kinds in (["OBS"], ["HOL"]) and s.command == "CIR":
        surface.hole = max(surface.hole, value)
    elif kinds == ["EDG"]:
        pass  # The edge of the glass does not limit the light.
    elif kinds or s.command == "ARO":
        source.note(s, "this aperture is omitted")
    elif s.command in ("ADX", "ADY"):
        surface.centre[s.command] = value
    else:
        surface.sizes[s.command] = value
    return True


def read_codev(path: str | Path, glasses: Glasses = NO_GLASSES) -> Prescription:
    """Read a .seq file.

    Parameters
    ----------
    path : str or Path
        Path of the file, in UTF-8, UTF-16 or ISO 8859-1.
    glasses : Mapping[str, callable]
        Glasses that its surfaces may name.

    Raises
    ------
    InputError
        The file is damaged, or has a statement that would be misread; the message names the line.
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
        problem = "the sequence has no image: the file is truncated"
        raise source.error(problem, system.surfaces[-1].line, allowed="SI at its end")
    if len(system.surfaces) < 3:
        raise source.error("too few surfaces", system.surfaces[-1].line, allowed="object, optics and image")
    return _prescription(system, glasses)


def _prescription(system: CodevSystem, glasses: Glasses) -> Prescription:
    """Return the prescription of a file whose statements are read."""
    source, scale, read = system.source, system.scale, system.surfaces
    if not system.waves:
        raise source.error("no wavelength in this file", read[0].line, allowed="WL")
    reference = system.reference or (len(system.waves) + 1) // 2
    if reference > len(system.waves):
        raise source.error("the reference wavelength is not in the list", read[0].line, reference)
    wavelength = system.waves[reference - 1]
    chain = Chain(source)
    if read[0].medium:
        raise source.error("an object in glass", read[0].line, read[0].medium)
    for k, surface in enumerate(read[1:], start=1):
        last = k == len(read) - 1
        decentre = surface.decentre
        if not math.isfinite(surface.thickness):
            raise source.error("an infinite distance behind an optical surface", surface.line)
        shift = [decentre.get(name, 0.0) * scale for name in ("XDE", "YDE", "ZDE")]
        # Rotations about x and y are left-handed.
        angles = [math.radians(sign * decentre.get(name, 0.0)) for name, sign in (("ADE", -1), ("BDE", -1), ("CDE", 1))]
        rotations = [about_axis(axis, angle) for axis, angle in enumerate(angles)]
        rotation = rotations[0] @ rotations[1] @ rotations[2]
        before = chain.pose
        if last:
            # The image's "thickness" is a defocus along the axis of the arriving light.
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
    pupil, pairs = system.pupil, paired(system.x, system.y)
    if pupil is not None and pupil.kind == "diameter":
        pupil = Pupil("diameter", pupil.value * scale, pupil.line)
    light = {"wavelength": wavelength, "wavelengths": tuple(dict.fromkeys(system.waves)), "pupil": pupil}
    heights = tuple((x * scale, y * scale) for x, y in pairs)
    field = {"fields": pairs} if system.field_kind == "angles" else {"heights": heights}
    light |= {**field, "field_kind": system.field_kind, "glasses": named_glasses(glasses, chain.surfaces)}
    return chain.prescription("STO", read[0].thickness * scale, system.name, **light)


def _behind(source: Source, surface: CodevSurface, wavelength: float, glasses: Glasses) -> tuple[float, str] | None:
    """Return index and name of the medium behind a surface; None for a mirror.

    Six digits and a point are a fictitious glass, index and dispersion.
    """
    medium = surface.medium.strip("'\"")
    match medium.upper():
        case "" | "AIR":
            return 1.0, ""
        case "REFL":
            return None
        case "REFR_TIR" | "TIRO":
            raise source.error("total reflection is not supported", surface.line, medium)
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
    """Return the optical shape of a surface from the statements read for it, in metres."""
    scale = system.scale
    powers = {n: a * scale ** (1 - n) for n, a in surface.powers.items()}
    if not surface.special:
        return even_asphere(surface.curvature / scale, surface.conic, powers)
    if powers:
        raise system.source.error("even powers on a special surface", surface.line, allowed="SCO coefficients")
    conic = surface.polynomial.get(1, surface.conic)
    coefficients = {}
    for m in range(LARGEST_ORDER + 1):
        for n in range(LARGEST_ORDER + 1 - m):
            j = ((m + n) ** 2 + m + 3 * n) // 2 + 1
            if m + n and j in surface.polynomial:
                coefficients[(m, n)] = surface.polynomial[j] * scale ** (1 - m - n)
    sizes = [s for s in surface.sizes.values() if s > 0.0]
    radius = max(sizes, default=1.0)
    scaled = {(m, n): c * radius ** (m + n) for (m, n), c in coefficients.items()}
    return polynomial(even_asphere(surface.curvature / scale, conic, {}), scaled, radius)


def _edges_of(surface: CodevSurface) -> tuple[Aperture | None, tuple[Edge, ...]]:
    """Return the clear aperture, and the hole in it as a separate edge if it is not round."""
    sizes = surface.sizes
    centre = (surface.centre.get("ADX", 0.0), surface.centre.get("ADY", 0.0))
    blocked = (Edge(Circle(surface.hole, centre), blocks=True),) if surface.hole else ()
    if "REX" in sizes or "REY" in sizes:
        wide = sizes.get("REX", sizes.get("REY", 0.0)), sizes.get("REY", sizes.get("REX", 0.0))
        return Rectangle(*wide, centre), blocked
    if "ELX" in sizes or "ELY" in sizes:
        wide = sizes.get("ELX", sizes.get("ELY", 0.0)), sizes.get("ELY", sizes.get("ELX", 0.0))
        return Ellipse(*wide, centre), blocked
    if "CIR" in sizes:
        return Circle(sizes["CIR"], centre, surface.hole), ()
    return None, blocked
