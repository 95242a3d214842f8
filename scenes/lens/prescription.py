"""Sequential prescription of another optical program, and conversion of its surfaces to those of the ray tracer.

Camera file of a first telescope design, with comments that say where its numbers come from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import comb, pi, remainder
from typing import Any

import numpy as np

from optics.camera.prescription import MIRROR, Camera
from optics.camera.telescope_types import TELESCOPES
from optics.camera.telescopes import first_design
from optics.geometry import aperture
from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Polygon, Ray, Rectangle
from optics.geometry.pose import Pose
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import Surface, ZernikeFigure
from optics.geometry.tree import Body, RigidTree
from optics.geometry.zernike import cartesian_terms, monomials, noll_to_nm, triangle_index, triangle_size
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly, Element, Interaction
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.units import ANGLE, LENGTH, Kind, format_quantity

LARGEST_ORDER = 10
"""Largest order of polynomials and Zernike terms; monomials of higher orders lose digits."""
_POLYNOMIAL = {(a, n - a): (f"x{a}" if a > 1 else "x" * a) + (f"y{n - a}" if n - a > 1 else "y" * (n - a))
               for n in (2, 3, 4) for a in range(n + 1)}  # fmt: skip


def even_asphere(curvature: float, conic: float, powers: Mapping[int, float]) -> Surface:
    """Return a conic surface with even powers of the radius r, r^2 included, added to its sag.

    Parameters
    ----------
    curvature : float
        Curvature at the vertex, 1/m.
    conic : float
        Conic (Schwarzschild) constant.
    powers : Mapping[int, float]
        Power n -> coefficient of r^n, m^(1-n); n even, 2 to 20.
    """
    last = max((n for n, a in powers.items() if a != 0.0 and n > 2), default=2)
    even = tuple(float(powers.get(n, 0.0)) for n in range(4, last + 1, 2))
    second = powers.get(2, 0.0)
    # The tracer has no r^2 term beside the conic; x^2 + y^2 is the same.
    terms = (XYPolynomial(x2=second, y2=second),) if second else ()
    return Surface(curvature, conic, even, terms=terms)


def polynomial(surface: Surface, coefficients: Mapping[tuple[int, int], float], radius: float) -> Surface:
    """Return the surface with a polynomial in x and y added to its sag.

    Parameters
    ----------
    surface : Surface
        Surface without a figure or polynomial.
    coefficients : Mapping[tuple[int, int], float]
        Powers (a, b) -> coefficient of (x/radius)^a (y/radius)^b, in metres.
    radius : float
        Normalisation radius of the coefficients, in metres.

    Raises
    ------
    ValueError
        The order is above LARGEST_ORDER.
    """
    nonzero = {k: c for k, c in coefficients.items() if c != 0.0}
    order = max((a + b for a, b in nonzero), default=0)
    if order > LARGEST_ORDER:
        raise ValueError(f"a polynomial of order {order}; at most {LARGEST_ORDER} is supported")
    if not nonzero:
        return surface
    if set(nonzero) <= set(_POLYNOMIAL) and not surface.terms:
        term = XYPolynomial(**{_POLYNOMIAL[k]: c / radius ** sum(k) for k, c in nonzero.items()})
        return replace(surface, terms=(term,))
    return surface.with_figure(ZernikeFigure(radius, (0.0, 0.0), zernike_of(nonzero)))


def zernike_of(coefficients: Mapping[tuple[int, int], float]) -> dict[int, float]:
    """Return the Zernike terms of a polynomial on the unit disk.

    The polynomial is (a, b) -> coefficient of x^a y^b, the result Noll index -> amplitude.
    """
    order = max((a + b for a, b in coefficients), default=0)
    size = triangle_size(order)
    matrix, wanted = np.zeros((size, size)), np.zeros(size)
    for j in range(1, size + 1):
        for a, b, c in cartesian_terms(j):
            matrix[triangle_index(a, b), j - 1] += c
    for (a, b), c in coefficients.items():
        wanted[triangle_index(a, b)] = c
    return {j: float(t) for j, t in enumerate(np.linalg.solve(matrix, wanted), start=1) if t}


def moved_polynomial(
    coefficients: Mapping[tuple[int, int], float], centre: tuple[float, float]
) -> dict[tuple[int, int], float]:
    """Return a polynomial about another centre.

    Parameters
    ----------
    coefficients : Mapping[tuple[int, int], float]
        Powers (a, b) -> coefficient of (x - cx)^a (y - cy)^b.
    centre : tuple[float, float]
        Coordinates cx and cy.

    Returns
    -------
    dict[tuple[int, int], float]
        Powers (a, b) -> coefficient of x^a y^b of the same polynomial.
    """
    out: dict[tuple[int, int], float] = {}
    cx, cy = centre
    for (a, b), c in coefficients.items():
        for i in range(a + 1):
            for j in range(b + 1):
                part = c * comb(a, i) * (-cx) ** (a - i) * comb(b, j) * (-cy) ** (b - j)
                out[i, j] = out.get((i, j), 0.0) + part
    return out


def joined(surface: Surface) -> Surface:
    """Return the surface with the Zernike terms of its sag merged into its figure, as other programs have them.

    Raises
    ------
    ValueError
        The figure is on a grid, or has a term beyond the known Noll indices.
    """
    sag = next((term for term in surface.terms if isinstance(term, ZernikeSag)), None)
    if sag is None:
        return surface
    rest = tuple(term for term in surface.terms if term is not sag)
    amplitudes = {j: float(a) for j, a in sag.amplitudes.items() if a}
    centre = (float(sag.x0), float(sag.y0))
    figure = surface.figure
    shape = replace(
        surface, terms=rest, figure=ZernikeFigure(float(sag.radius), centre, amplitudes) if amplitudes else None
    )
    if figure is None or not amplitudes:
        return replace(shape, figure=figure) if figure is not None else shape
    if not isinstance(figure, ZernikeFigure):
        raise ValueError("Zernike sag terms with a figure on a grid cannot be merged")
    total: dict[tuple[int, int], float] = {}
    assert isinstance(shape.figure, ZernikeFigure)
    for part in (shape.figure, figure):
        for pair, value in about_vertex(part).items():
            total[pair] = total.get(pair, 0.0) + value
    radius = max(part.radius + float(np.hypot(*part.centre)) for part in (shape.figure, figure))
    terms = zernike_of({(a, b): c * radius ** (a + b) for (a, b), c in total.items()})
    return replace(shape, figure=ZernikeFigure(radius, (0.0, 0.0), terms))


def about_vertex(figure: ZernikeFigure) -> dict[tuple[int, int], float]:
    """Return a Zernike figure as a polynomial about the vertex.

    Returns
    -------
    dict[tuple[int, int], float]
        Powers (a, b) -> coefficient of x^a y^b, in m^(1-a-b).
    """
    order = max(figure.order, 0)
    table = monomials(figure.terms, order, figure.radius)
    polynomial = {(n - b, b): float(table[triangle_index(n - b, b)]) for n in range(order + 1) for b in range(n + 1)}
    return moved_polynomial(polynomial, figure.centre)


def facing(surface: LensSurface) -> LensSurface:
    """Return a surface in a frame whose z points along the prescription's, rotated by 180 deg about x if necessary.

    Only the frame changes; the surface in space is the same.
    """
    if surface.pose.rotation[2, 2] >= 0.0:
        return surface
    return turned_over(surface)


OVER = Pose(np.diag([1.0, -1.0, -1.0]))
"""Pose of a rotation by 180 deg about x, which reverses the z axis of a surface's frame."""


def turned_over(surface: LensSurface) -> LensSurface:
    """Return the same surface in a frame rotated by 180 deg about its x."""
    shape = surface.surface
    terms = []
    for term in shape.terms:
        if not isinstance(term, XYPolynomial):
            raise TypeError(f"{type(term).__name__} is not a polynomial")
        terms.append(XYPolynomial(**{n: -getattr(term, n) * (-1) ** b for (_, b), n in _POLYNOMIAL.items()}))
    figure = shape.figure
    if isinstance(figure, ZernikeFigure):
        (cx, cy), zernikes = figure.centre, figure.terms
        # sag(x, y) -> -sag(x, -y): terms that are odd in y keep their sign.
        signs = {j: 1.0 if noll_to_nm(j)[1] < 0 else -1.0 for j in zernikes}
        figure = ZernikeFigure(figure.radius, (cx, -cy), {j: signs[j] * a for j, a in zernikes.items()})
    elif figure is not None:
        raise TypeError("a figure on a grid")
    even = tuple(-a for a in shape.even)
    edge = surface.aperture
    if edge is not None:
        edge = replace(edge, centre=(edge.centre[0], -edge.centre[1]))
    return replace(
        surface,
        pose=surface.pose @ OVER,
        surface=Surface(-shape.curvature, shape.conic, even, figure, tuple(terms)),
        aperture=edge,
        edges=tuple(map(aperture.flipped_y, surface.edges)),
    )


def polynomial_of(shape: Surface) -> dict[tuple[int, int], float]:
    """Return the polynomial of a surface's sag beyond its conic, without its figure.

    All terms of the surface must be polynomials.

    Returns
    -------
    dict[tuple[int, int], float]
        Powers (a, b) -> coefficient of x^a y^b, in m^(1-a-b).
    """
    out: dict[tuple[int, int], float] = {}
    for term in shape.terms:
        for pair, name in _POLYNOMIAL.items():
            out[pair] = out.get(pair, 0.0) + float(getattr(term, name))
    for n, value in enumerate(shape.even, start=2):
        for k in range(n + 1):
            pair = (2 * (n - k), 2 * k)
            out[pair] = out.get(pair, 0.0) + value * comb(n, k)
    return {pair: c for pair, c in out.items() if c != 0.0}


def without_rim(surface: LensSurface) -> LensSurface:
    """Return a stop surface without the outer edge of its aperture; a central hole in it is kept."""
    rim = surface.aperture
    hole = Edge(Circle(rim.inner, rim.centre), blocks=True) if isinstance(rim, Circle) and rim.inner else None
    return replace(surface, aperture=None, edges=(*(() if hole is None else (hole,)), *surface.edges))


def written(value: float, kind: Kind) -> str:
    """Return a number as text of a camera's file, without digits that unit conversions leave.

    It gives 540 arcsec and not 539.9999999999999 arcsec.

    Parameters
    ----------
    value : float
        Value, SI.
    kind : Kind
        Kind of quantity.
    """
    return format_quantity(value, kind, _ROUNDING.get(kind.si, 0.0) + 2e-15 * abs(value))


_ROUNDING = {ANGLE.si: 1e-14, LENGTH.si: 1e-15}
"""SI unit -> rounding error of sums and differences of numbers in this unit; a wavelength of light is 1e8 times larger.
"""

_LARGEST_EDGE = 100.0
"""Size of an aperture or obscuration, in metres, above which it is ignored because no light reaches it."""


def edge_entries(edges: Iterable[Edge]) -> list[dict[str, Any]]:
    """Return edges as the list ``edges`` of a camera's file, without those that are too large to vignette light."""
    return [_entry(edge) for edge in edges if _size(edge) < _LARGEST_EDGE]


def _size(edge: Edge) -> float:
    """Return the largest dimension of an edge, in metres."""
    shape = edge.shape
    numbers = [*shape.centre]
    match shape:
        case Circle():
            numbers.append(shape.radius)
        case Ray():
            numbers.append(shape.width)
        case Polygon():
            numbers += [value for corner in shape.corners for value in corner]
        case _:
            numbers += [shape.half_x, shape.half_y]
    return max(map(abs, numbers))


def _entry(edge: Edge) -> dict[str, Any]:
    """Return the keys and values of one edge in a camera's file."""
    shape = edge.shape
    kind = {Circle: "circle", Rectangle: "rectangle", Ellipse: "ellipse", Ray: "ray", Polygon: "polygon"}[type(shape)]

    def metres(*values: float) -> Any:
        texts = [written(float(value), LENGTH) for value in values]
        return texts if len(texts) > 1 else texts[0]

    out: dict[str, Any] = {"blocks" if edge.blocks else "clear": kind}
    if any(shape.centre):
        out["centre"] = metres(*shape.centre)
    match shape:
        case Circle(radius, _, inner):
            out["radius"] = metres(radius)
            if inner:
                out["inner"] = metres(inner)
        case Ray(width, _):
            out["width"] = metres(width)
        case Polygon(corners, _):
            out["corners"] = [metres(*corner) for corner in corners]
        case _:
            out["half"] = metres(shape.half_x, shape.half_y)
    if edge.rotation and not isinstance(shape, Circle | Polygon):
        out["rotation"] = written(remainder(edge.rotation, 2.0 * pi), ANGLE)
    return out


SEQUENCE = "imaging"
"""Name of the sequence of the light in a prescription's assembly."""


@dataclass(frozen=True)
class Note:
    """Note on an omission or an assumption of the conversion of a foreign file.

    Attributes
    ----------
    line : int
        Line of the file, counted from 1; 0 for the file as a whole.
    statement : str
        Statement as it is in the file.
    text : str
        Treatment of the statement.
    """

    line: int
    statement: str
    text: str

    def __str__(self) -> str:
        place = f"line {self.line}: " if self.line else ""
        return f"{place}{self.statement}: {self.text}" if self.statement else f"{place}{self.text}"


@dataclass(frozen=True, eq=False)
class LensSurface:
    """Surface of a prescription.

    Attributes
    ----------
    name : str
        Unique name.
    pose : Pose
        Pose of its frame in the prescription's, z along the axis along which light enters; metres.
    surface : Surface
        Shape.
    interaction : Interaction
        Reflection, refraction or passage of light.
    index : float
        Refractive index behind it in the order of the light, at the prescription's wavelength.
    aperture : Aperture or None
        Clear aperture, None for an unlimited one.
    line : int
        Line of the file at which it begins.
    glass : str
        Name of the glass behind it, empty for the medium of the object.
    edges : tuple[Edge, ...]
        Further edges that vignette light: obscurations, vanes.
    """

    name: str
    pose: Pose
    surface: Surface
    interaction: Interaction
    index: float = 1.0
    aperture: Aperture | None = None
    line: int = 0
    glass: str = ""
    edges: tuple[Edge, ...] = ()

    @property
    def every_edge(self) -> tuple[Edge, ...]:
        """All edges that vignette light at the surface, the clear aperture first."""
        return (*(() if self.aperture is None else (Edge(self.aperture),)), *self.edges)


@dataclass(frozen=True)
class Pupil:
    """Definition of the beam's width in a file.

    It is the diameter of the entrance pupil (metres), the F-number in image space, the numerical aperture in object
    space, or the radius of the stop (metres).

    Attributes
    ----------
    kind : str
        ``diameter``, ``f_number``, ``object_na`` or ``stop``.
    value : float
        Value of that quantity.
    line : int
        Line of the file.
    """

    kind: str
    value: float
    line: int = 0


@dataclass(frozen=True, eq=False)
class Prescription:
    """Sequential optical system, in metres and radians.

    Frame: that of the first surface after the object, before its own decentre; light enters toward +z.

    Attributes
    ----------
    name : str
        Title in the file, or name of the file.
    file : str
        Path of the file as the user gave it.
    surfaces : tuple[LensSurface, ...]
        Surfaces in the order of the light, the image last; dummy planes are omitted.
    stop : int
        Index of the surface that is the aperture stop.
    wavelength : float
        Wavelength of the indices, in metres.
    wavelengths : tuple[float, ...]
        All wavelengths that the file names, in metres.
    fields : tuple[tuple[float, float], ...]
        Field angles (x, y), in radians: light travels along (tan x, tan y, 1); empty where the file defines its fields
        otherwise.
    field_kind : str
        Kind of the file's fields, for messages.
    pupil : Pupil or None
        Width of the beam; None where the file does not define it.
    object_distance : float
        Distance from the object to the frame's origin, in metres; infinite for a scene.
    notes : tuple[Note, ...]
        Omissions and assumptions of the conversion.
    round_field : bool
        Whether the fields give the radius of a round field about the axis, of which a camera has the inscribed square.
    glasses : Mapping[str, callable]
        Glasses of its surfaces with known dispersion, by name: functions from wavelength (metres) to index.
    heights : tuple[tuple[float, float], ...]
        Fields given as heights (x, y) on object or image, in metres; empty for others.
    """

    name: str
    file: str
    surfaces: tuple[LensSurface, ...]
    stop: int
    wavelength: float
    wavelengths: tuple[float, ...] = ()
    fields: tuple[tuple[float, float], ...] = ()
    field_kind: str = "angles"
    pupil: Pupil | None = None
    object_distance: float = float("inf")
    notes: tuple[Note, ...] = ()
    round_field: bool = False
    glasses: Mapping[str, Callable[[float], float]] = field(default_factory=FrozenMap)
    heights: tuple[tuple[float, float], ...] = ()

    @property
    def image(self) -> LensSurface:
        """Surface of the image, the last of the prescription."""
        return self.surfaces[-1]

    def error(
        self, problem: str, line: int | None = None, value: str | None = None, allowed: str | None = None
    ) -> InputError:
        """Return an input error that names the prescription's file and a line of it, for the caller to raise."""
        return InputError(Issue(problem, self.file, line or None, (), value, allowed))

    def with_notes(self, *notes: Note) -> Prescription:
        """Return the prescription with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def assembly(self, apertures: bool = True) -> Assembly:
        """Return the assembly for the tracer: a body and an element per surface, and the sequence ``SEQUENCE``.

        Parameters
        ----------
        apertures : bool
            Whether clear apertures vignette rays.
        """
        bodies = tuple(Body(s.name, s.pose) for s in self.surfaces)
        elements = {
            s.name: Element(
                s.name, s.name, s.surface, s.interaction, s.aperture if apertures else None, index_after=s.index
            )
            for s in self.surfaces
        }
        return Assembly(RigidTree(bodies), elements, {SEQUENCE: tuple(s.name for s in self.surfaces)})


HALF_FIELDS = {"dall-kirkham": 0.02, "korsch": 0.5, "off-axis": 1.0, "triplet": 0.5}
"""Half fields along the line, degrees, over which a kind is sharp at F/10; 0.05 for the others."""

MARGIN = 1.1
"""Radius of the shadow of a mirror before the primary over that of its clear aperture: its mount. That of the hole in
the primary over that of the beams through it."""

FIELD_RATIO = 0.1
"""Half field across the line over that along it."""


def first_camera(
    kind: str,
    name: str,
    aperture: float,
    f_number: float,
    wavelength: float,
    half_field: float | None = None,
    pitch: float = 7e-6,
    primary_f_number: float | None = None,
    behind: float | None = None,
) -> str:
    """Return the text of a camera file of a telescope.

    Parameters
    ----------
    kind : str
        Name in ``TELESCOPES``.
    name : str
        Name of the camera.
    aperture : float
        Diameter of the entrance pupil, metres.
    f_number : float
        Focal length over the aperture.
    wavelength : float
        Design wavelength, metres.
    half_field : float, optional
        Half of the field along the line, radians; by default that of ``HALF_FIELDS``.
    pitch : float
        Pixel pitch of the line CCD, metres.
    primary_f_number, behind : float, optional
        As for `optics.camera.telescopes.first_design`.

    Raises
    ------
    ValueError
        There is no such telescope.
    """
    half = np.radians(HALF_FIELDS.get(kind, 0.05)) if half_field is None else half_field
    camera = first_design(kind, aperture, f_number, wavelength, primary_f_number, behind, half)
    what = TELESCOPES[kind]
    bias = what.bias / f_number
    focal = f_number * aperture
    pixels = 2 * int(focal * np.tan(half) / pitch)
    description = f"{what.title}, {aperture:g} m, f {focal:g} m, F/{f_number:g}."
    lines = [
        "# Prescription frame: z along the axis, light enters toward +z, y in the plane of symmetry, x along the line.",
        "# First design: " + _source(kind),
        "# Analyse it with: python -m twin.camera FILE     best focal plane over the field: --refocus",
        "# Optimise it with python -m twin.design camera (docs/studies.md); every key is explained in docs/camera.md.",
        f"name: {name}",
        f"description: {description}",
        f"focal_length: {focal:.12g} m",
        f"entrance_pupil: {1e3 * aperture:.12g} mm",
        f"field_bias: {np.degrees(bias):.10g} deg          # angle of the middle of the field from the axis",
        f"field: {{x: {np.degrees(half):.6g} deg, y: {np.degrees(FIELD_RATIO * half):.6g} deg}}    # half angles",
        f"wavelength: {1e9 * wavelength:.10g} nm",
        f"stop: {_surface(camera, what.stop)}",
        f"mirrors:                           # {'faces of lenses, ' * what.lenses}in the order of the light",
        *_mirrors(camera, half, bias, aperture),
        f"image: {{z: {1e3 * camera.vertices[-1]:.13g} mm}}",
        f"line: {{pixels: {max(pixels, 2)}, pitch: {1e6 * pitch:.6g} um}}",
    ]
    return "\n".join(lines) + "\n"


def _source(kind: str) -> str:
    """Say how a design was found."""
    if kind == "off-axis":
        return (
            "ratios of a known layout; conics and focus minimise the traced wavefront error about the field's middle."
        )
    if kind == "triplet":
        return "curvatures, air spaces and focus minimise ray errors over the field, also at 0.89 and 1.12 wavelengths."
    if kind == "korsch":
        return "ratios of a known layout with a flat field; conics cancel spherical aberration, coma and astigmatism."
    return "first-order layout; conics cancel third-order aberrations (Seidel sums, see the report)."


def _surface(camera: Camera, k: int) -> str:
    """Return the name of a surface: M1, M2, ... of mirrors, L1_front, L1_back, ... of lenses."""
    return f"M{k + 1}" if camera.surfaces[k].material == MIRROR else f"L{k // 2 + 1}_{('front', 'back')[k % 2]}"


def _mirrors(camera: Camera, half: float, bias: float, aperture: float) -> list[str]:
    """Return the lines of the surfaces, and of the shadow of a mirror that stands in the entering beam."""
    out = []
    z = camera.vertices
    centred = camera.stop == 0 and len(camera.surfaces) > 1
    if centred:  # the secondary shadows the beam
        first = camera.surfaces[0]
        radius = 0.5 * aperture * (1.0 - z[1] / (0.5 * first.radius)) + abs(z[1]) * np.tan(half + bias)
        out.append(
            f"  shadow: {{z: {1e3 * (z[1] - 0.02 * aperture):.10g} mm, radius: flat, light: passes, "
            f"edges: [{{blocks: circle, radius: {1e3 * MARGIN * radius:.5g} mm}}]}}   # of M2 and its mount"
        )
    hole = _hole(camera, half, bias, aperture) if centred else 0.0
    for k, surface in enumerate(camera.surfaces):
        behind = f"light: refracts, {'glass' if isinstance(surface.material, str) else 'index'}: {surface.material}"
        last = f"conic: {surface.conic:.12g}" if surface.material == MIRROR else behind
        out.append(
            f"  {_surface(camera, k)}: {{z: {1e3 * z[k]:.13g} mm, radius: {1e3 * surface.radius:.13g} mm, {last}"
            + (f", edges: [{{blocks: circle, radius: {1e3 * hole:.5g} mm}}]}}   # its hole" if hole and not k else "}")
        )
    return out


def _hole(camera: Camera, half: float, bias: float, aperture: float) -> float:
    """Return the radius of the hole in the first mirror that passes the beams of the field from the second, metres.

    The chief ray of the field's corner meets the second mirror at the distance times the angle from the axis.
    """
    first, second, gap = camera.surfaces[0], camera.surfaces[1], -camera.vertices[1]
    before = -0.5 * first.radius - gap  # distance of the first mirror's focus behind the second
    after = 1.0 / (1.0 / before + 2.0 / second.radius)
    focal, share = -0.5 * first.radius * after / before, gap / after
    corner = np.hypot(np.tan(half), np.tan(bias + FIELD_RATIO * half))
    marginal = 0.5 * aperture * (after - gap) / focal
    return float(MARGIN * (corner * ((1.0 - share) * gap + share * focal) + marginal))
