"""Reader of Zemax sequential files (.zmx).

A coordinate break shifts and then rotates about x, y and z in this order, each about the axes left by the rotation
before; with its order flag set it does the reverse: rotations about z, y and x, then shifts. Rotations are
right-handed.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from optics.geometry.aperture import Aperture, Circle, Edge, EdgeShape, Ellipse, Rectangle
from optics.geometry.pose import about_axis
from optics.geometry.surface import Surface, ZernikeFigure
from optics.geometry.zernike import MAX_NOLL
from scenes.lens import statements
from scenes.lens.prescription import Prescription, Pupil, even_asphere, polynomial

UNITS = {"MM": 1e-3, "CM": 1e-2, "IN": 25.4e-3, "INCH": 25.4e-3, "ME": 1.0, "M": 1.0, "METER": 1.0}

SHAPES = ("STANDARD", "EVENASPH", "ODDASPHE", "XPOLYNOM", "SZERNSAG", "COORDBRK")
"""Zemax names of the surface types that are supported."""

OF_NO_EFFECT = frozenset(
    # the program's version and windows, drawings, solves whose values stand in the file, optimisation, tolerances,
    # coatings and polarisation, weights of fields and wavelengths, physical optics, hammer settings
    "VERS AUTH IWDP STUD PFIL LANG GFAC RAIM PUSH SDMA OMMA ROPD HYPR PICB FWGN VANN POLS GLRS GSTD NSCD "
    "COFN LUID EERA SSID FIMP HIDE MIRR SLAB POPS MEMA PPAR VPAR PZUP MAZH OPDX EFFL EFLY WFNO BLNK TOL TOLE MOFF "
    "TRAC DMFS ACOS GLCB REAX REAY REAZ COAT PKUP VCON VDSZ EDGE ZVDX ZVDY ZVCX ZVCY ZVAN WWGN WWGT NOTE TCMM "
    "TCED CONF GLCZ GLCA GLCC MNCA MXCA MNEA MNCG MXCG MNEG RGLA PMAG TOTR OPTH PRIM COMM ENVD".split()
)

_SYSTEM = frozenset(
    "MODE NAME UNIT GCAT ENPD FNUM OBNA FLOA FTYP XFLN YFLN WAVM WAVL WAVN PWAV VDXN VDYN VCXN VCYN".split()
)
_ON_SURFACES = frozenset(
    "TYPE STOP CURV CONI PARM XDAT DISZ GLAS DIAM FLAP CLAP SQAP ELAP OBSC SQOB ELOB OBDC USAP SCBD".split()
)

_EDGES = {
    "CLAP": "clear",
    "FLAP": "clear",
    "SQAP": "rectangle",
    "ELAP": "ellipse",
    "OBSC": "hole",
    "SQOB": "blocked rectangle",
    "ELOB": "blocked ellipse",
}
"""Zemax statement of an aperture -> kind of edge."""


@dataclass
class _Surface:
    """Surface of a Zemax file: what the statements read so far say about it."""

    number: int
    line: int
    kind: str = "STANDARD"
    kind_line: int = 0
    stop: bool = False
    curvature: float = 0.0
    conic: float = 0.0
    thickness: float = 0.0
    name: str = ""
    glass: tuple[str, ...] = ()
    glass_line: int = 0
    radius: float = 0.0
    parameters: dict[int, float] = field(default_factory=dict)
    extra: dict[int, float] = field(default_factory=dict)
    edges: dict[str, tuple[statements.Statement, float, float]] = field(default_factory=dict)
    centre: tuple[float, float] = (0.0, 0.0)


@dataclass
class _System:
    """Optical system of a Zemax file: surfaces and settings from the statements read so far."""

    source: statements.Source
    scale: float = 1e-3
    name: str = ""
    catalogues: tuple[str, ...] = ()
    pupil: Pupil | None = None
    field_type: int = 0
    field_count: int = 0
    field_line: int = 1
    wave_count: int = 0
    x: tuple[float, ...] = ()
    y: tuple[float, ...] = ()
    waves: dict[int, float] = field(default_factory=dict)
    primary: int = 1
    surfaces: list[_Surface] = field(default_factory=list)


def read_zemax(path: str | Path, glasses: statements.Glasses = statements.NO_GLASSES) -> Prescription:
    """Read a .zmx file.

    Parameters
    ----------
    path : str or Path
        Path of the file, in UTF-16 of either order, UTF-8 or ISO 8859-1.
    glasses : Mapping[str, callable]
        Glasses that its surfaces may name.

    Raises
    ------
    InputError
        The file is damaged, or has a statement that would be misread; the message names the line.
    """
    source = statements.Source(str(path))
    lines = statements.read_lines(source)
    system = _System(source)
    for number, text in enumerate(lines, start=1):
        if (statement := statements.statement_of(number, text.rstrip("\x1a"))) is not None:
            _take(system, statement)
    if not system.surfaces:
        raise source.error("no surface in this file", len(lines), allowed="SURF 0, SURF 1, ... of a Zemax file")
    if len(system.surfaces) < 3:
        problem = "too few surfaces: the file is truncated or not an optical system"
        value = f"{len(system.surfaces)} surfaces"
        raise source.error(problem, system.surfaces[-1].line, value, "object, optics and image")
    return _prescription(system, glasses)


def _take(system: _System, s: statements.Statement) -> None:
    """Apply one statement of the file to the system that is being read."""
    source = system.source
    if s.command == "SURF":
        number = source.whole(s, 0, "the surface's number", 0, statements.MOST_SURFACES)
        if number != len(system.surfaces):
            raise source.error("surfaces are not in order", s.line, number, f"SURF {len(system.surfaces)}")
        system.surfaces.append(_Surface(number, s.line))
    elif s.command in _SYSTEM:
        _take_system(system, s)
    elif s.command in _ON_SURFACES or (s.command == "COMM" and system.surfaces):
        if not system.surfaces:
            raise source.error(f"{s.command} precedes all surfaces", s.line, s.text, "SURF 0 first")
        _take_surface(system, system.surfaces[-1], s)
    elif s.command == "MNUM":
        if source.whole(s, 0, "the number of configurations", 0, 10_000, 1) > 1:
            source.note(s, "of several configurations only the present one, whose values are in the surfaces, is read")
    elif s.command == "IGNR":
        if s.words[:1] not in ((), ("0",)):
            raise source.error("a surface with IGNR is not supported", s.line, s.text, "a file without it")
    elif s.command not in OF_NO_EFFECT:
        source.note(s, "not understood")


def _take_system(system: _System, s: statements.Statement) -> None:
    """Apply a statement about the whole system: title, units, pupil, wavelengths, fields."""
    source = system.source
    match s.command:
        case "MODE":
            if s.words[:1] != ("SEQ",):
                raise source.error("not a sequential system", s.line, s.text, "MODE SEQ")
        case "GCAT":
            system.catalogues = tuple(word.upper() for word in s.words)
        case "NAME":
            system.name = statements.joined(s.words)
        case "UNIT":
            unit = s.words[0].upper() if s.words else ""
            if unit not in UNITS:
                raise source.error("unknown unit of lengths", s.line, unit, ", ".join(UNITS))
            system.scale = UNITS[unit]
        case "ENPD":
            system.pupil = Pupil("diameter", _positive(source, s, "the pupil's diameter"), s.line)
        case "FNUM":
            system.pupil = Pupil("f_number", _positive(source, s, "the F-number"), s.line)
            if len(s.words) > 1 and source.finite(s, 1, "the kind of F-number") != 0.0:
                source.note(s, "a paraxial working F-number: omitted, so that the pupil's diameter is unknown")
                system.pupil = None
        case "OBNA":
            system.pupil = Pupil("object_na", _positive(source, s, "the aperture"), s.line)
        case "FLOA":
            system.pupil = Pupil("stop", 0.0, s.line)
        case "FTYP":
            system.field_type = source.whole(s, 0, "the kind of fields", 0, 9)
            system.field_count = source.whole(s, 2, "the number of fields", 0, 10_000, 1)
            system.wave_count = source.whole(s, 3, "the number of wavelengths", 0, 10_000, 1)
        case "XFLN":
            system.x, system.field_line = source.numbers(s, "a field"), s.line
        case "YFLN":
            system.y, system.field_line = source.numbers(s, "a field"), s.line
        case "WAVM":
            number = source.whole(s, 0, "the wavelength's number", 1, 10_000)
            system.waves[number] = _wave(source, s, source.finite(s, 1, "the wavelength"))
        case "WAVL" | "WAVN":
            for k, value in enumerate(source.numbers(s, "a wavelength"), start=1):
                system.waves[k] = _wave(source, s, value)
            system.wave_count = system.wave_count or len(s.words)
        case "PWAV":
            system.primary = source.whole(s, 0, "the primary wavelength's number", 1, 10_000)
        case _:  # vignetting factors: shares by which a field's pupil is compressed
            if any(v != 0.0 for v in source.numbers(s, "a vignetting factor")):
                source.note(s, "vignetting factors are omitted; beams are limited by the stop")


def _positive(source: statements.Source, s: statements.Statement, what: str) -> float:
    """Return the first number of a statement; raise InputError if it is not positive."""
    value = source.finite(s, 0, what)
    if not value > 0.0:
        raise source.error(f"{what} is not greater than zero", s.line, s.text)
    return value


def _wave(source: statements.Source, s: statements.Statement, micrometres: float) -> float:
    """Return a wavelength in metres from one in micrometres, after checking it."""
    if not 0.1 <= micrometres <= 100.0:
        raise source.error("no wavelength of light", s.line, s.text, "0.1 to 100 um")
    return micrometres / 1e6


def _take_surface(system: _System, surface: _Surface, s: statements.Statement) -> None:
    """Apply a statement about one surface: its type, curvature, thickness, glass, parameters or aperture."""
    source = system.source
    match s.command:
        case "TYPE":
            surface.kind, surface.kind_line = (s.words[0].upper() if s.words else ""), s.line
        case "STOP":
            surface.stop = True
        case "COMM":
            surface.name = statements.joined(s.words)
        case "CURV":
            surface.curvature = source.finite(s, 0, "the curvature")
        case "CONI":
            surface.conic = source.finite(s, 0, "the conic constant")
        case "PARM":
            number = source.whole(s, 0, "the parameter's number", 0, 250)
            surface.parameters[number] = source.finite(s, 1, "the parameter")
        case "XDAT":
            surface.extra[source.whole(s, 0, "the number of the datum", 1, 1000)] = source.finite(s, 1, "the datum")
        case "DISZ":
            surface.thickness = source.number(s, 0, "the thickness")
        case "GLAS":
            surface.glass, surface.glass_line = s.words, s.line
        case "DIAM":
            surface.radius = source.finite(s, 0, "the semi-diameter")
        case "OBDC":
            surface.centre = (source.finite(s, 0, "the decentre"), source.finite(s, 1, "the decentre"))
        case "USAP":
            source.note(s, "an aperture of arbitrary outline is omitted")
        case "SCBD":
            if any(v not in ("0",) and float(source.value(s, v, "a tilt")) != 0.0 for v in s.words[2:]):
                problem = "tilts and decentres of a surface are not supported"
                raise source.error(problem, s.line, s.text, "coordinate breaks (COORDBRK) in its place")
        case _:
            what = _EDGES.get(s.command)
            if what is None:
                source.note(s, "this obscuration is omitted")
                return
            surface.edges[what] = (s, source.finite(s, 0, "its size"), source.finite(s, 1, "its size"))


def _prescription(system: _System, glasses: statements.Glasses) -> Prescription:
    """Return the prescription of a file whose statements are read."""
    source, scale = system.source, system.scale
    waves = [system.waves[k] for k in sorted(system.waves) if not system.wave_count or k <= system.wave_count]
    if not waves:
        raise source.error("no wavelength in this file", 1, allowed="WAVM or WAVL")
    primary = system.waves.get(system.primary, waves[0])
    chain, read, glasses = statements.Chain(source), system.surfaces, statements.of_makers(glasses, system.catalogues)
    if read[0].kind == "COORDBRK" or read[0].glass:
        raise source.error("the object is a coordinate break or in glass", read[0].line)
    for k, surface in enumerate(read[1:], start=1):
        last = k == len(read) - 1
        if surface.kind == "COORDBRK":
            if surface.glass:
                raise source.error("a coordinate break with a glass", surface.glass_line)
            _break(source, chain, surface, scale)
        else:
            name = surface.name if surface.name.isidentifier() else f"S{k}"
            shape = _shape(source, surface, scale)
            try:
                edges = _edges_of(surface, scale)
            except ValueError as error:
                raise source.error(str(error), max(s.line for s, _, _ in surface.edges.values())) from None
            behind = _behind(source, surface, primary, glasses)
            chain.meet(name, shape, edges, behind, surface.line, surface.stop, last)
        if not last:
            if not math.isfinite(surface.thickness):
                raise source.error("an infinite distance behind an optical surface", surface.line)
            chain.move((0.0, 0.0, surface.thickness * scale))
    pupil = system.pupil
    if pupil is not None and pupil.kind == "diameter":
        pupil = Pupil("diameter", pupil.value * scale, pupil.line)
    elif pupil is not None and pupil.kind == "stop":
        radius = next((s.radius for s in read if s.stop), 0.0) * scale
        pupil = Pupil("stop", radius, pupil.line) if radius > 0.0 else None
    kinds = ("angles", "object heights", "paraxial image heights", "real image heights", "theodolite angles")
    light: dict[str, Any] = {"wavelength": primary, "wavelengths": tuple(dict.fromkeys(waves)), "pupil": pupil}
    light |= {"fields": _fields(system)} if system.field_type == 0 else {}
    if 1 <= system.field_type <= 3:
        light["heights"] = tuple((x * scale, y * scale) for x, y in _pairs(system))
    light |= {"field_kind": kinds[min(system.field_type, 4)]}
    light |= {"glasses": statements.named_glasses(glasses, chain.surfaces)}
    return chain.prescription("STOP", read[0].thickness * scale, system.name, **light)


def _pairs(system: _System) -> tuple[tuple[float, float], ...]:
    """Return the field coordinates (x, y) of the file; missing numbers are 0."""
    return statements.paired(system.x, system.y, system.field_count)


def _fields(system: _System) -> tuple[tuple[float, float], ...]:
    """Return the field angles (x, y), in radians."""
    for value in (value for pair in _pairs(system) for value in pair):
        if not abs(value) < 89.0:
            raise system.source.error("a field beyond 89 deg", system.field_line, value)
    return tuple((math.radians(a), math.radians(b)) for a, b in _pairs(system))


def _break(source: statements.Source, chain: statements.Chain, surface: _Surface, scale: float) -> None:
    """Move the frame of the following surfaces by a coordinate break."""
    p = surface.parameters
    shift = (p.get(1, 0.0) * scale, p.get(2, 0.0) * scale, 0.0)
    rotations = [about_axis(axis, math.radians(p.get(3 + axis, 0.0))) for axis in range(3)]
    if p.get(6, 0.0) == 0.0:
        chain.move(shift, rotations[0] @ rotations[1] @ rotations[2])
    else:
        chain.move((0.0, 0.0, 0.0), rotations[2] @ rotations[1] @ rotations[0])
        chain.move(shift)


def _behind(
    source: statements.Source, surface: _Surface, wavelength: float, glasses: statements.Glasses
) -> tuple[float, str] | None:
    """Return index at the primary wavelength, and name, of the medium behind a surface; None for a mirror."""
    words, line = surface.glass, surface.glass_line
    if not words:
        return 1.0, ""
    if words[0].upper() == "MIRROR":
        return None
    if words[0] == "___BLANK" or (len(words) > 1 and words[1] == "1"):
        stated = source.finite(statements.Statement(line, "GLAS", words, " ".join(words)), 3, "the index")
        statements.require_d_line(source, "model", words[0], wavelength, line)
        return stated, words[0]
    return statements.index_of(source, glasses, words[0], wavelength, line), words[0]


def _shape(source: statements.Source, surface: _Surface, scale: float) -> Surface:
    """Return the shape of a surface, in metres."""
    line = surface.kind_line or surface.line
    if surface.kind not in SHAPES:
        raise source.error("this type of surface is not supported", line, surface.kind, ", ".join(SHAPES))
    c, k, p, x = surface.curvature / scale, surface.conic, surface.parameters, surface.extra
    powers: dict[int, float] = {}
    if surface.kind in ("EVENASPH", "SZERNSAG"):
        powers = {2 * n: p.get(n, 0.0) * scale ** (1 - 2 * n) for n in range(1, 9)}
    elif surface.kind == "ODDASPHE":
        powers = {n: p.get(n, 0.0) * scale ** (1 - n) for n in range(1, 9)}
        odd = [n for n, a in powers.items() if n % 2 and a != 0.0]
        if odd:
            raise source.error("odd powers of the radius are not supported", line, f"r^{odd[0]}", "even powers")
    shape = even_asphere(c, k, powers)
    if surface.kind == "XPOLYNOM":
        count, radius = int(x.get(1, 0.0)), x.get(2, 0.0) * scale
        if count and not radius > 0.0:
            raise source.error("a polynomial without a normalisation radius", line)
        pairs = [(order - b, b) for order in range(1, 23) for b in range(order + 1)]
        coefficients = {pair: x.get(3 + n, 0.0) * scale for n, pair in enumerate(pairs[:count])}
        try:
            return polynomial(shape, coefficients, radius)
        except ValueError as error:
            raise source.error(str(error), line) from None
    if surface.kind == "SZERNSAG":
        count, radius = int(x.get(1, 0.0)), x.get(2, 0.0) * scale
        terms = {j: x.get(2 + j, 0.0) * scale for j in range(1, count + 1) if x.get(2 + j, 0.0) != 0.0}
        if terms and not radius > 0.0:
            raise source.error("Zernike terms without a normalisation radius", line)
        if max(terms, default=0) > MAX_NOLL:
            raise source.error("too many Zernike terms", line, max(terms), f"Z1 to Z{MAX_NOLL}")
        if terms:
            centre = (p.get(9, 0.0) * scale, p.get(10, 0.0) * scale)
            shape = shape.with_figure(ZernikeFigure(radius, centre, terms))
    return shape


def _edges_of(surface: _Surface, scale: float) -> tuple[Aperture | None, tuple[Edge, ...]]:
    """Return the clear aperture of a surface, and its obscurations; a semi-diameter alone only serves drawings."""
    cx, cy = surface.centre
    centre = (cx * scale, cy * scale)
    sizes = {what: (first * scale, second * scale) for what, (_, first, second) in surface.edges.items()}
    blocked: list[EdgeShape] = []
    hole = sizes.get("hole", (0.0, 0.0))[1]
    if "blocked rectangle" in sizes:
        blocked.append(Rectangle(*sizes["blocked rectangle"], centre))
    if "blocked ellipse" in sizes:
        blocked.append(Ellipse(*sizes["blocked ellipse"], centre))
    edge: Aperture | None = None
    if "rectangle" in sizes or "ellipse" in sizes:
        edge = Rectangle(*sizes["rectangle"], centre) if "rectangle" in sizes else Ellipse(*sizes["ellipse"], centre)
    elif "clear" in sizes:
        inner, outer = sizes["clear"]
        edge = Circle(outer, centre, hole or inner)
    if hole and not isinstance(edge, Circle):
        blocked.append(Circle(hole, centre))
    return edge, tuple(Edge(shape, blocks=True) for shape in blocked)
