"""Statements of CODE V sequential files (.seq), taken into the surfaces and the system that they describe."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from scenes.lens.prescription import Pupil
from scenes.lens.statements import MOST_SURFACES, Source, Statement, is_number, joined, statement_of

UNITS = {"M": 1e-3, "MM": 1e-3, "C": 1e-2, "CM": 1e-2, "I": 25.4e-3, "IN": 25.4e-3}
_POWERS = {name: 4 + 2 * k for k, name in enumerate("ABCDEFGHJ")}
"""CODE V leaves I out."""

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
class CodevSystem:
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
    surfaces: list[CodevSurface] = field(default_factory=list)


def statements(lines: list[str]) -> list[Statement]:
    """Commands between semicolons; & at the end of a line goes on, ! begins a remark."""
    out: list[Statement | None] = []
    pending, begun = "", 0
    for number, text in enumerate(lines, start=1):
        text, begun = _cut(text, "!")[0], begun or number
        if text.rstrip().endswith("&"):
            pending += text.rstrip()[:-1] + " "
            continue
        out += [statement_of(begun, part) for part in _cut(pending + text, ";")]
        pending, begun = "", 0
    out += [statement_of(begun, part) for part in _cut(pending, ";")]
    return [one for one in out if one is not None]


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


def take(system: CodevSystem, s: Statement) -> None:
    """What one statement says."""
    source, command = system.source, s.command
    if command in ("SO", "S", "SI") or (command[0] == "S" and command[1:].isdigit()):
        _surface(system, s)
    elif command in _SYSTEM or command in _FIELDS:
        _take_system(system, s)
    elif command in _REFUSED:
        raise source.error(f"{_REFUSED[command]} is not known here", s.line, s.text)
    elif command in OF_NO_EFFECT or (command in ("CUF", "HOR") and not any(source.numbers(s))):
        pass
    elif command in ("RDY", "THI", "CUY", "GLA", "INS", "DEL", "REFL", "RMD", "SCA", "FLY"):
        problem = "a change of surfaces that have been given before"
        raise source.error(problem, s.line, s.text, "the sequence of surfaces")
    elif _qualified(s):
        # a statement for a surface that it names, not for the last one
        if command in (*_GEOMETRY, "K", "CON", "ASP", *_POWERS, "STO", "DAR", "BEN", "REV", "SPS", "SCO"):
            problem = "a change of a surface that was given before"
            raise source.error(problem, s.line, s.text, "statements below the surface")
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


def _take_system(system: CodevSystem, s: Statement) -> None:
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
            source.note(s, "private glasses are not carried")
        case "ZOO" | "FLD":
            source.note(s, "not understood")
        case "VUX" | "VLX" | "VUY" | "VLY":
            if any(source.numbers(s)):
                source.note(s, "vignetting factors are not carried; beams are as wide as the stop lets them")
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
    system.surfaces.append(CodevSurface(name, s.line, curvature, thickness, medium))


def _take_surface(system: CodevSystem, surface: CodevSurface, s: Statement) -> bool:
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
            if any(source.numbers(s)):
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


def _edge(system: CodevSystem, surface: CodevSurface, s: Statement) -> bool:
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
