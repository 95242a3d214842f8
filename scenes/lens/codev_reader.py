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
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface
from optics.raytrace.assembly import Interaction
from scenes.lens.prescription import (
    FARTHEST,
    NO_GLASSES,
    Chain,
    Glasses,
    LensSurface,
    Note,
    Prescription,
    Pupil,
    glass_key,
)
from scenes.lens.shapes import LARGEST_ORDER, clear, even_asphere, polynomial
from scenes.lens.statements import (
    MOST_SURFACES,
    Source,
    Statement,
    decoded,
    is_number,
    joined,
    read_bytes,
    split_words,
)

UNITS = {"M": 1e-3, "MM": 1e-3, "C": 1e-2, "CM": 1e-2, "I": 25.4e-3, "IN": 25.4e-3}
_POWERS = {name: 4 + 2 * k for k, name in enumerate("ABCDEFGHJ")}
"""CODE V leaves I out."""
_D_LINE, _D_WIDTH = 587.5618e-9, 0.1e-9

OF_NO_EFFECT = frozenset(
    # the program's version and author, weights, vignetting solves, variables, couplings, zoom lists, colours,
    # derivatives of tolerances, drawing, temperature of a prescription that is taken as it stands
    "LEN TIT TITLE INI WTW WTF POL CA GO END CLS DER CCY THC KC AC BC CC DC EC FC GC HC JC CUM THM CCM GLC SLB LAB RGL "
    "TEM PRE XDC YDC ZDC ADC BDC CDC IWT COM TOL DLT DLR DLN DLZ VIE OUT CUR PIM PIK MHT MWT EDI PUI PUX PUY NAO_".split()
)
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
class _Surface:
    """A surface while its statements are read."""

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
class _System:
    """A file while it is read."""

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
    surfaces: list[_Surface] = field(default_factory=list)


def read_codev(path: str | Path, glasses: Glasses = NO_GLASSES) -> Prescription:
    """Read a .seq file.

    Args:
        path: of the file, UTF-8, UTF-16 or ISO 8859-1.
        glasses: that its surfaces may name.

    Raises:
        InputError: the file is damaged, or says something that would be taken wrongly; with the line.
    """
    source = Source(str(path))
    lines = decoded(read_bytes(path), source)
    system = _System(source)
    for statement in _statements(lines):
        if system.private:
            system.private = statement.command != "END"
            continue
        _take(system, statement)
    if not system.surfaces:
        raise source.error("no surface in this file", len(lines), allowed="SO, S, ... SI of a CODE V sequence")
    if system.surfaces[-1].name != "SI":
        raise source.error(
            "the sequence has no image: it is cut off", system.surfaces[-1].line, allowed="SI at its end"
        )
    if len(system.surfaces) < 3:
        raise source.error("too few surfaces", system.surfaces[-1].line, allowed="object, optics and image")
    return _prescription(system, glasses)


def _statements(lines: list[str]) -> list[Statement]:
    """Commands between semicolons; & at the end of a line goes on, ! begins a remark."""
    out, pending, begun = [], "", 0
    for number, text in enumerate(lines, start=1):
        text, begun = _without_remark(text), begun or number
        if text.rstrip().endswith("&"):
            pending += text.rstrip()[:-1] + " "
            continue
        for part in _parts(pending + text):
            words = split_words(part)
            if words:
                out.append(Statement(begun, words[0].upper(), words[1:], part.strip()))
        pending, begun = "", 0
    for part in _parts(pending):
        words = split_words(part)
        if words:
            out.append(Statement(begun, words[0].upper(), words[1:], part.strip()))
    return out


def _without_remark(text: str) -> str:
    return _cut(text, "!")[0]


def _parts(text: str) -> list[str]:
    return _cut(text, ";")


def _cut(text: str, mark: str) -> list[str]:
    """Pieces of a text between marks that stand outside of quotes."""
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


def _take(system: _System, s: Statement) -> None:
    """What one statement says."""
    source, command = system.source, s.command
    if command in ("SO", "S", "SI") or (command[0] == "S" and command[1:].isdigit()):
        _surface(system, s)
    elif command in (
        "RDM",
        "DIM",
        "EPD",
        "FNO",
        "NA",
        "NAO",
        "WL",
        "REF",
        "TIT",
        "TITLE",
        "PRV",
        "ZOO",
        "FLD",
    ) or command in (
        *_FIELDS,
        "VUX",
        "VLX",
        "VUY",
        "VLY",
    ):
        _take_system(system, s)
    elif command in _REFUSED:
        raise source.error(f"{_REFUSED[command]} is not known here", s.line, s.text)
    elif command in OF_NO_EFFECT or (command in ("CUF", "HOR") and not any(_numbers(source, s))):
        pass
    elif command in ("RDY", "THI", "CUY", "GLA", "INS", "DEL", "REFL", "RMD", "SCA", "FLY"):
        raise source.error(
            "a change of surfaces that have been given before", s.line, s.text, "the sequence of surfaces"
        )
    elif _qualified(s):
        # a statement for a surface that it names, not for the last one
        if command in (*_GEOMETRY, "K", "CON", "ASP", *_POWERS, "STO", "DAR", "BEN", "REV", "SPS", "SCO"):
            raise source.error(
                "a change of a surface that was given before", s.line, s.text, "statements below the surface"
            )
        source.note(s, "not understood")
    elif system.surfaces and _take_surface(system, system.surfaces[-1], s):
        pass
    else:
        source.note(s, "not understood")


_FIELDS = {
    "XAN": "angles",
    "YAN": "angles",
    "XOB": "object heights",
    "YOB": "object heights",
    "XIM": "image heights",
    "YIM": "image heights",
    "XRI": "real image heights",
    "YRI": "real image heights",
}


def _qualified(s: Statement) -> bool:
    """Whether the first word names a surface: S4, SI, S3..5."""
    word = s.words[0].upper() if s.words else ""
    return word in ("SI", "SO", "SS") or (word[:1] == "S" and word[1:2].isdigit())


def _numbers(source: Source, s: Statement) -> tuple[float, ...]:
    return tuple(source.finite(s, k, "a number") for k in range(len(s.words)))


def _take_system(system: _System, s: Statement) -> None:
    source = system.source
    match s.command:
        case "RDM":
            word = s.words[0].upper() if s.words else "Y"
            if word[:1] not in "YN":
                raise source.error("radii or curvatures?", s.line, s.text, "RDM Y, RDM N")
            if system.surfaces:
                raise source.error("radii or curvatures is said after the first surface", s.line, s.text)
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
                source.note(s, "a numerical aperture in image space: the pupil's diameter is not carried")
            else:
                kind = {"EPD": "diameter", "FNO": "f_number", "NAO": "object_na"}[s.command]
                system.pupil = Pupil(kind, value, s.line)
        case "WL":
            waves = tuple(v * 1e-9 for v in _numbers(source, s))
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
            source.note(s, "private glasses are not carried")
        case "ZOO" | "FLD":
            source.note(s, "not understood")
        case "VUX" | "VLX" | "VUY" | "VLY":
            if any(_numbers(source, s)):
                source.note(s, "vignetting factors are not carried; beams are as wide as the stop lets them")
        case _:
            values = _numbers(source, s)
            system.field_kind = _FIELDS[s.command]
            if system.field_kind == "angles":
                if any(not abs(v) < 89.0 for v in values):
                    raise source.error("a field beyond 89 deg", s.line, s.text)
                values = tuple(math.radians(v) for v in values)
            if s.command[0] == "X":
                system.x = values
            else:
                system.y = values


def _surface(system: _System, s: Statement) -> None:
    """SO, S or SI: radius or curvature, thickness, what lies behind."""
    source = system.source
    if system.surfaces and system.surfaces[-1].name == "SI":
        raise source.error("a surface behind the image", s.line, s.text)
    if (s.command == "SO") != (not system.surfaces):
        raise source.error("the object stands first, and once", s.line, s.text, "SO, then S, last SI")
    if len(system.surfaces) > MOST_SURFACES:
        raise source.error("too many surfaces", s.line, allowed=f"at most {MOST_SURFACES}")
    number = len(system.surfaces)
    if s.command[1:].isdigit() and int(s.command[1:]) != number:
        raise source.error("surfaces are not in their order", s.line, s.command, f"S{number}")
    if system.radii is None:
        problem = "does this file give radii or curvatures? It does not say"
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
    system.surfaces.append(_Surface(name, s.line, curvature, thickness, medium))


def _take_surface(system: _System, surface: _Surface, s: Statement) -> bool:
    """What a statement says of the last surface; False if it says nothing that is known."""
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
                raise source.error("a special surface that is not known here", s.line, s.text, "SPS XYP")
        case "SCO":
            word = s.words[0].upper() if s.words else ""
            if word == "K" and len(s.words) == 2:
                surface.polynomial[1] = source.finite(s, 1, "the coefficient")
            elif word[:1] == "C" and word[1:].isdigit() and 1 <= int(word[1:]) <= 66:
                surface.polynomial[int(word[1:])] = source.finite(s, 1, "the coefficient")
            else:
                raise source.error("a coefficient that is not known here", s.line, s.text, "SCO C1 to SCO C66")
        case "CUF":
            if any(_numbers(source, s)):
                raise source.error("a curvature of a Fresnel base is not known here", s.line, s.text)
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


def _edge(system: _System, surface: _Surface, s: Statement) -> bool:
    """Apertures: CIR r, CIR OBS r, CIR HOL r, REX, REY, ELX, ELY with ADX, ADY."""
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
        pass  # of the glass, not of the light
    elif kinds or s.command == "ARO":
        source.note(s, "this aperture is not carried")
    elif s.command in ("ADX", "ADY"):
        surface.centre[s.command] = value
    else:
        surface.sizes[s.command] = value
    return True


def _prescription(system: _System, glasses: Glasses) -> Prescription:
    source, scale, read = system.source, system.scale, system.surfaces
    if not system.waves:
        raise source.error("no wavelength in this file", read[0].line, allowed="WL")
    reference = system.reference or (len(system.waves) + 1) // 2
    if reference > len(system.waves):
        raise source.error("the reference wavelength is none of those given", read[0].line, reference)
    wavelength = system.waves[reference - 1]
    chain, index, glass, stop = Chain(), 1.0, "", -1
    if read[0].medium:
        raise source.error("an object in glass", read[0].line, read[0].medium)
    for k, surface in enumerate(read[1:], start=1):
        last = k == len(read) - 1
        given = surface.decentre
        shift = [given.get(name, 0.0) * scale for name in ("XDE", "YDE", "ZDE")]
        # left-handed about x and y
        angles = [math.radians(sign * given.get(name, 0.0)) for name, sign in (("ADE", -1), ("BDE", -1), ("CDE", 1))]
        turns = [about_axis(axis, angle) for axis, angle in enumerate(angles)]
        rotation = turns[0] @ turns[1] @ turns[2]
        before = chain.pose
        if surface.kind != "REV":
            chain.move(shift, rotation)
        made, index, glass = _made(system, surface, chain.pose, index, glass, wavelength, glasses)
        if surface.stop:
            if stop >= 0:
                raise source.error("a second stop", surface.line)
            stop = len(chain.surfaces)
        idle = made.interaction is Interaction.PASS and made.aperture is None and made.surface.is_plane
        if last and surface.thickness != 0.0:
            # the image's "thickness" is a defocus: it stands that much farther along its own axis
            chain.move((0.0, 0.0, surface.thickness * scale))
            made = _moved(made, chain.pose)
        if not idle or surface.stop or last:
            chain.add(made)
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
            if not math.isfinite(surface.thickness):
                raise source.error("an infinite distance behind an optical surface", surface.line)
            chain.move((0.0, 0.0, surface.thickness * scale))
    if stop < 0:
        stop = 0
        source.notes.append(Note(0, "", f"no STO: taken to be {chain.surfaces[0].name}"))
    if stop == len(chain.surfaces) - 1:
        raise source.error("the image is the stop", chain.surfaces[stop].line)
    pupil = system.pupil
    if pupil is not None and pupil.kind == "diameter":
        pupil = Pupil("diameter", pupil.value * scale, pupil.line)
    distance = read[0].thickness * scale
    return Prescription(
        system.name or Path(source.file).stem,
        source.file,
        tuple(chain.surfaces),
        stop,
        wavelength,
        tuple(dict.fromkeys(system.waves)),
        _fields(system),
        system.field_kind,
        pupil,
        distance if abs(distance) < FARTHEST else math.inf,
        tuple(source.notes),
    )


def _moved(surface: LensSurface, pose: Pose) -> LensSurface:
    return LensSurface(
        surface.name,
        pose,
        surface.surface,
        surface.interaction,
        surface.index,
        surface.aperture,
        surface.line,
        surface.glass,
    )


def _fields(system: _System) -> tuple[tuple[float, float], ...]:
    if system.field_kind != "angles":
        return ()
    count = max(len(system.x), len(system.y))
    x, y = ([*given, *[0.0] * count][:count] for given in (system.x, system.y))
    return tuple(zip(x, y, strict=True))


def _made(
    system: _System, surface: _Surface, pose: Pose, index: float, glass: str, wavelength: float, glasses: Glasses
) -> tuple[LensSurface, float, str]:
    """A surface with what lies behind it."""
    source, medium = system.source, surface.medium.strip("'\"")
    shape = _shape(system, surface)
    try:
        aperture = _aperture(system, surface)
    except ValueError as error:
        raise source.error(str(error), surface.line) from None
    if medium.upper() in ("REFL", "REFR_TIR", "TIRO"):
        if medium.upper() != "REFL":
            raise source.error("total reflection is not known here", surface.line, medium)
        made = LensSurface(surface.name, pose, shape, Interaction.REFLECT, index, aperture, surface.line, glass)
        return made, index, glass
    behind = 1.0 if medium.upper() in ("", "AIR") else _index(source, surface, medium, wavelength, glasses)
    how = Interaction.PASS if behind == index else Interaction.REFRACT
    glass = "" if behind == 1.0 else medium
    return LensSurface(surface.name, pose, shape, how, behind, aperture, surface.line, glass), behind, glass


def _index(source: Source, surface: _Surface, medium: str, wavelength: float, glasses: Glasses) -> float:
    """Of the glass behind a surface; six digits and a point are a fictitious glass, index and dispersion."""
    whole, point, rest = medium.partition(".")
    if (point and whole.isdigit() and rest.isdigit()) or ":" in medium:
        if abs(wavelength - _D_LINE) > _D_WIDTH:
            problem = "a fictitious glass, whose index is stated at 587.56 nm alone"
            raise source.error(problem, surface.line, f"{medium} at {wavelength * 1e9:.6g} nm", "a catalogue's glass")
        if ":" in medium:
            word = medium.partition(":")[0]
            statement = Statement(surface.line, "S", (word,), medium)
            return source.finite(statement, 0, "the index")
        return 1.0 + float(f"0.{whole}")
    found = glasses.get(glass_key(medium))
    if found is None:
        problem, allowed = "unknown glass", "glasses of the twin, and of a catalogue given with --glasses FILE.agf"
        raise source.error(problem, surface.line, medium, allowed)
    try:
        return found(wavelength)
    except ValueError as error:
        raise source.error(str(error), surface.line) from None


def _shape(system: _System, surface: _Surface) -> Surface:
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


def _aperture(system: _System, surface: _Surface) -> Aperture | None:
    sizes = surface.sizes
    centre = (surface.centre.get("ADX", 0.0), surface.centre.get("ADY", 0.0))
    if "REX" in sizes or "REY" in sizes:
        wide = sizes.get("REX", sizes.get("REY", 0.0)), sizes.get("REY", sizes.get("REX", 0.0))
        return clear(rectangle=wide, centre=centre)
    if "ELX" in sizes or "ELY" in sizes:
        wide = sizes.get("ELX", sizes.get("ELY", 0.0)), sizes.get("ELY", sizes.get("ELX", 0.0))
        return clear(ellipse=wide, centre=centre)
    if "CIR" in sizes:
        return clear(sizes["CIR"], surface.hole, centre=centre)
    if surface.hole:
        system.source.notes.append(Note(surface.line, surface.name, "a hole without an outer edge is not carried"))
    return None
