"""Reader of batoid's YAML files.

In batoid light comes down from +z; here it enters toward +z. Everything is rotated about x by 180 deg.
"""

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from optics.geometry.aperture import Aperture, Circle, Edge, EdgeShape, Polygon, Ray, Rectangle
from optics.geometry.pose import Pose, about_axis
from optics.geometry.surface import Surface, ZernikeFigure
from optics.geometry.zernike import MAX_NOLL
from optics.materials.glass import CatalogueGlass
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Interaction
from scenes.lens.prescription import OVER, LensSurface, Note, Prescription, even_asphere, turned_over
from scenes.lens.statements import Source, read_lines
from scenes.yaml.errors import InputError, Issue, KeyPath, shown

_ROTATIONS = {"rotX": 0, "rotY": 1, "rotZ": 2}
_SHIFTS = {"x": 0, "y": 1, "z": 2}
DEEPEST = 20
LARGEST_FILE = 100_000
"""Largest file, in bytes: four times the largest of batoid's own; reading it takes a second or two."""
MOST_SURFACES = 2000


_XY = ("xs", "ys")
_OBSCURATIONS = {
    "Circle": ("radius", "x", "y"),
    "Annulus": ("outer", "inner", "x", "y"),
    "Rectangle": ("width", "height", "x", "y", "theta"),
    "Ray": ("width", "theta", "x", "y"),
    "Polygon": _XY,
}
_OF_OPTICS = frozenset(
    "type name surface coordSys inMedium outMedium medium items obscuration backDist sphereRadius pupilSize "
    "pupilObscuration R_outer R_inner parent stopSurface".split()
)
"""Keys of an optic that describe its position, media and function, or where batoid starts a wavefront calculation."""


class _Reader:
    """Reader of one batoid file: the surfaces, media and notes collected so far."""

    def __init__(self, file: str, data: object, wavelength: float) -> None:
        self.file, self.data, self.wavelength = file, data, wavelength
        self.surfaces: list[LensSurface] = []
        self.notes: list[Note] = []
        self.ambient = 1.0
        self.named: dict[float, CatalogueGlass] = {}

    def error(self, key: KeyPath, problem: str, value: object = None, allowed: str | None = None) -> InputError:
        """Return an input error that names the file and the line of a key, for the caller to raise."""
        text = None if value is None else shown(value)
        return InputError(Issue(problem, self.file, self.line(key), key, text, allowed))

    def line(self, key: KeyPath) -> int:
        """Return the line of a key, or of the innermost enclosing item that has one, counted from 1."""
        here, line = self.data, 1
        for part in key:
            marks = getattr(here, "lc", None)
            try:
                place = marks.key(part) if isinstance(part, str) else marks.item(part)  # type: ignore[union-attr]
                here, line = here[part], int(place[0]) + 1  # type: ignore[index]
            except (KeyError, IndexError, TypeError, AttributeError):
                break
        return line

    def number(self, entry: Mapping[str, Any], name: str, key: KeyPath, default: float | None = None) -> float:
        """Return the finite number at a key of a mapping; raise InputError if it is none."""
        if name not in entry and default is not None:
            return default
        value = entry.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e20:
            raise self.error((*key, name), f"{name} is not a number", value, "a number")
        return float(value)

    def mapping(self, value: object, key: KeyPath) -> Mapping[str, Any]:
        """Return the value unchanged if it is a mapping, else raise InputError."""
        if not isinstance(value, Mapping):
            raise self.error(key, "not a mapping", value, "a mapping with a type")
        return value

    def listed(self, value: object, key: KeyPath) -> list[Any]:
        """Return the value unchanged if it is a list, else raise InputError."""
        if not isinstance(value, list):
            raise self.error(key, "not a list", value, "a list")
        return value

    def _only(self, entry: Mapping[str, Any], key: KeyPath, known: Mapping[str, tuple[str, ...]]) -> None:
        """Raise InputError for keys that this type of item does not have, since their numbers would be ignored."""
        for name in entry:
            names = known.get(str(entry.get("type")), ("R", "items"))
            if name != "type" and name not in names:
                raise self.error((*key, name), "this key is not supported", entry[name], ", ".join(names))

    # ----------------------------------------------------------------------------------------------------- parts

    def optic(self, entry: Mapping[str, Any], key: KeyPath, pose: Pose, before: float, after: float) -> None:
        """Read an optic and all optics inside it, in its parent's frame and media."""
        if len(key) > 2 * DEEPEST:
            raise self.error(key, "optics are nested too deeply", allowed=f"at most {DEEPEST} levels")
        kind = entry.get("type")
        for name in entry:
            if name not in _OF_OPTICS:
                self.notes.append(Note(self.line((*key, name)), str(name), "not understood"))
        pose = self._placed(entry, key, pose)
        before = self.medium(entry["inMedium"], (*key, "inMedium")) if "inMedium" in entry else before
        after = self.medium(entry["outMedium"], (*key, "outMedium")) if "outMedium" in entry else after
        match kind:
            case "CompoundOptic":
                for k, item in enumerate(self.listed(entry.get("items"), (*key, "items"))):
                    below = (*key, "items", k)
                    self.optic(self.mapping(item, below), below, pose, before, after)
            case "Lens":
                glass = self.medium(entry.get("medium"), (*key, "medium"))
                items = self.listed(entry.get("items"), (*key, "items"))
                if len(items) != 2:
                    raise self.error((*key, "items"), "a lens has two faces", f"{len(items)}")
                for k, (inside, outside) in enumerate(((before, glass), (glass, after))):
                    below = (*key, "items", k)
                    self.optic(self.mapping(items[k], below), below, pose, inside, outside)
            case "Mirror":
                self._add(entry, key, pose, Interaction.REFLECT, before)
            case "RefractiveInterface":
                how = Interaction.PASS if before == after else Interaction.REFRACT
                self._add(entry, key, pose, how, after)
            case "Detector":
                self._add(entry, key, pose, Interaction.PASS, before)
            case "Baffle" if "obscuration" in entry:
                self._add(entry, key, pose, Interaction.PASS, before)
            case "Baffle" | "Interface":
                text = f"{entry.get('name', kind)}: no effect on rays: omitted"
                self.notes.append(Note(self.line(key), kind, text))
            case _:
                known = "CompoundOptic, Lens, Mirror, RefractiveInterface, Detector, Baffle, Interface"
                raise self.error((*key, "type"), "this type of optic is not supported", kind, known)

    def _add(self, entry: Mapping[str, Any], key: KeyPath, pose: Pose, how: Interaction, index: float) -> None:
        """Append an optic's surface, with its pose, its interaction with light and the index behind it."""
        if len(self.surfaces) >= MOST_SURFACES:
            raise self.error(key, "too many surfaces", allowed=f"at most {MOST_SURFACES}")
        name = str(entry.get("name", "")) or f"S{len(self.surfaces) + 1}"
        taken = {s.name for s in self.surfaces}
        name = next(n for n in (name, *(f"{name}_{k}" for k in range(2, MOST_SURFACES + 2))) if n not in taken)
        below = (*key, "surface")
        shape = self.shape(self.mapping(entry.get("surface"), below), below)
        edges: tuple[Edge, ...] = ()
        if "obscuration" in entry:
            below = (*key, "obscuration")
            edges = self.edges(self.mapping(entry["obscuration"], below), below, name)
        clear, rest = None, edges
        if edges and not edges[0].blocks and not edges[0].rotation and isinstance(edges[0].shape, Aperture):
            clear, rest = edges[0].shape, edges[1:]
        if entry.get("type") == "Baffle" and not (shape.is_plane and edges):
            self.notes.append(Note(self.line(key), name, "a baffle that is not plane, or without an edge: omitted"))
            return
        glass, ratio = self.named[index].name if index in self.named else "", index / self.ambient
        # Rotate the world, and the frame of each surface with it.
        surface = LensSurface(name, OVER @ pose, shape, how, ratio, clear, self.line(key), glass, rest)
        self.surfaces.append(turned_over(surface))

    def _placed(self, entry: Mapping[str, Any], key: KeyPath, pose: Pose) -> Pose:
        """Return a pose after the shifts and rotations of a ``coordSys``, each about the axes reached so far."""
        if "coordSys" not in entry:
            return pose
        key = (*key, "coordSys")
        for name, value in self.mapping(entry["coordSys"], key).items():
            step = np.zeros(3)
            if name in _ROTATIONS:
                angle = self.number({name: value}, name, key)
                pose = pose @ Pose(about_axis(_ROTATIONS[name], angle), step)
                continue
            if name in _SHIFTS:
                step[_SHIFTS[name]] = self.number({name: value}, name, key)
            elif name == "shift" and isinstance(value, list) and len(value) == 3:
                step = np.array([self.number({"shift": v}, "shift", key) for v in value])
            else:
                known = "x, y, z, shift, rotX, rotY, rotZ"
                raise self.error((*key, name), "this coordinate is not supported", value, known)
            pose = pose @ Pose(np.eye(3), step)
        return pose

    def shape(self, entry: Mapping[str, Any], key: KeyPath, depth: int = 0) -> Surface:
        """Return the shape of an optical surface from its mapping in the file."""
        kind = entry.get("type")
        self._only(entry, key, {"Quadric": ("R", "conic"), "Asphere": ("R", "conic", "coefs", "imin"), "Plane": ()})
        match kind:
            case "Plane":
                return Surface()
            case "Sphere" | "Paraboloid" | "Quadric" | "Asphere":
                radius = self.number(entry, "R", key)
                if radius == 0.0:
                    raise self.error((*key, "R"), "a radius of curvature cannot be zero", 0.0)
                conic = {"Sphere": 0.0, "Paraboloid": -1.0}.get(str(kind))
                conic = self.number(entry, "conic", key) if conic is None else conic
                powers = {}
                if kind == "Asphere":
                    below = (*key, "coefs")
                    listed = self.listed(entry.get("coefs"), below)
                    first = self.number(entry, "imin", key, 2.0)
                    if first != int(first) or not 1 <= first <= 10 or len(listed) > 12:
                        raise self.error(below, "these even powers are not supported", shown(first), "r^2 to r^40")
                    powers = {
                        2 * (int(first) + n): self.number({"coefs": a}, "coefs", key) for n, a in enumerate(listed)
                    }
                return even_asphere(1.0 / radius, conic, powers)
            case "Sum" if depth == 0:
                return self._sum(entry, key)
            case _:
                known = "Plane, Sphere, Paraboloid, Quadric, Asphere, Sum of one of them and a Zernike"
                raise self.error((*key, "type"), "this type of surface is not supported", kind, known)

    def _sum(self, entry: Mapping[str, Any], key: KeyPath) -> Surface:
        """Return the shape of a sum of a conic and a Zernike surface."""
        items = self.listed(entry.get("items"), (*key, "items"))
        shape, radius, centre = None, 0.0, (0.0, 0.0)
        terms: dict[int, float] = {}
        for k, item in enumerate(items):
            below = (*key, "items", k)
            part = self.mapping(item, below)
            if part.get("type") != "Zernike" and shape is None:
                shape = self.shape(part, below, 1)
                continue
            if part.get("type") != "Zernike" or terms or self.number(part, "R_inner", below, 0.0) != 0.0:
                problem = "this part of a sum is not supported"
                raise self.error(below, problem, part.get("type"), "one Zernike, R_inner 0")
            self._only(part, below, {"Zernike": ("coef", "R_outer", "R_inner", "x_origin", "y_origin")})
            radius = self.number(part, "R_outer", below, 1.0)
            centre = self.number(part, "x_origin", below, 0.0), self.number(part, "y_origin", below, 0.0)
            coefficients = self.listed(part.get("coef"), (*below, "coef"))
            numbers = [self.number({"coef": v}, "coef", below) for v in coefficients]
            terms = {j: a for j, a in enumerate(numbers) if j and a}
            if max(terms, default=0) > MAX_NOLL or not radius > 0.0:
                problem = "these Zernike terms are not supported"
                raise self.error(below, problem, max(terms, default=0), f"Z1 to Z{MAX_NOLL}")
        if shape is None:
            raise self.error(key, "a sum without a conic", allowed="a conic and a Zernike")
        return shape.with_figure(ZernikeFigure(radius, centre, terms)) if terms else shape

    def medium(self, entry: object, key: KeyPath) -> float:
        """Return the refractive index of a medium at the wavelength."""
        if isinstance(entry, int | float) and not isinstance(entry, bool) and 0.1 < entry < 10.0:
            return float(entry)
        medium = self.mapping(entry, key)
        kind, w = medium.get("type"), self.wavelength
        try:
            index = self._index(medium, key, kind, w)
        except (ValueError, ZeroDivisionError, OverflowError):
            index = math.nan
        if not 0.1 < index < 10.0:
            raise self.error(
                key, "the index is not known at this wavelength", kind, f"a medium known at {w * 1e9:.6g} nm"
            )
        return index

    def _index(self, medium: Mapping[str, Any], key: KeyPath, kind: object, w: float) -> float:
        """Return the refractive index of a medium of one type at the wavelength ``w``; NaN outside its range."""
        um = 1e6 * w
        numbers = {
            "ConstMedium": ("n",),
            "TableMedium": ("wavelengths", "ns"),
            "SellmeierMedium": ("B1", "B2", "B3", "C1", "C2", "C3"),
            "SumitaMedium": tuple(f"A{k}" for k in range(6)),
            "Air": ("pressure", "temperature", "h2o_pressure"),
        }
        self._only(medium, key, numbers)
        match kind:
            case "ConstMedium":
                return self.number(medium, "n", key)
            case "TableMedium":
                x, y = (
                    np.array([self.number({name: v}, name, key) for v in self.listed(medium.get(name), (*key, name))])
                    for name in ("wavelengths", "ns")
                )
                if len(x) != len(y) or len(x) < 2 or np.any(np.diff(x) <= 0.0) or not x[0] <= w <= x[-1]:
                    return math.nan
                return float(np.interp(w, x, y))
            case "SellmeierMedium":
                b, c = ([self.number(medium, f"{n}{k}", key) for k in (1, 2, 3)] for n in "BC")
                n = math.sqrt(1.0 + sum(p * um * um / (um * um - q) for p, q in zip(b, c, strict=True)))
                self._keep_sellmeier(n, [*b, *c])
                return n
            case "SumitaMedium":
                a = [self.number(medium, f"A{k}", key) for k in range(6)]
                return math.sqrt(a[0] + a[1] * um**2 + sum(a[k] * um ** (-2 * (k - 1)) for k in range(2, 6)))
            case "Air":
                return _air(
                    um,
                    self.number(medium, "pressure", key, 69.328),
                    self.number(medium, "temperature", key, 293.15),
                    self.number(medium, "h2o_pressure", key, 1.067),
                )
            case _:
                known = "ConstMedium, TableMedium, SellmeierMedium, SumitaMedium, Air"
                raise self.error((*key, "type"), "this type of medium is not supported", kind, known)

    def _keep_sellmeier(self, index: float, b_and_c: list[float]) -> None:
        """Store the dispersion formula of a Sellmeier glass under its refractive index, by which it is found later.

        The file states no wavelength range, so one between the poles of the formula is assumed.
        """
        b, c = b_and_c[:3], b_and_c[3:]
        poles = [math.sqrt(pole) for pole in c if pole > 0.0]
        below = [pole for pole in poles if pole < self.wavelength * 1e6]
        above = [pole for pole in poles if pole > self.wavelength * 1e6]
        first, last = max([0.2, *(1.5 * pole for pole in below)]), min([5.0, *(0.4 * pole for pole in above)])
        if index in self.named or not first < self.wavelength * 1e6 < last:
            return
        pairs = tuple(value for pair in zip(b, c, strict=True) for value in pair)
        name = f"Sellmeier_{len(self.named) + 1}"
        self.named[index] = CatalogueGlass(name, 2, (*pairs, *[0.0] * 6), first * 1e-6, last * 1e-6)

    def edges(self, entry: Mapping[str, Any], key: KeyPath, name: str, depth: int = 0) -> tuple[Edge, ...]:
        """Return the edges of an obscuration, clear apertures first; kinds that are not supported are noted."""
        kind = str(entry.get("type"))
        if kind == "ObscUnion" and depth == 0:
            edges: list[Edge] = []
            for k, item in enumerate(self.listed(entry.get("items"), (*key, "items"))):
                below = (*key, "items", k)
                edges += self.edges(self.mapping(item, below), below, name, 1)
            return tuple(sorted(edges, key=lambda edge: edge.blocks))
        known = {f"{effect}{shape}": keys for shape, keys in _OBSCURATIONS.items() for effect in ("Clear", "Obsc")}
        if kind not in known:
            self.notes.append(Note(self.line(key), kind, f"the obscuration of {name} is omitted"))
            return ()
        self._only(entry, key, known)
        x, y = self.number(entry, "x", key, 0.0), self.number(entry, "y", key, 0.0)
        shape: EdgeShape
        try:
            match kind[5:] if kind.startswith("Clear") else kind[4:]:
                case "Circle":
                    shape = Circle(self.number(entry, "radius", key), (x, y))
                case "Annulus":
                    shape = Circle(self.number(entry, "outer", key), (x, y), self.number(entry, "inner", key))
                case "Rectangle":
                    half = 0.5 * self.number(entry, "width", key), 0.5 * self.number(entry, "height", key)
                    shape = Rectangle(*half, (x, y))
                case "Ray":
                    shape = Ray(self.number(entry, "width", key), (x, y))
                case _:
                    xs, ys = ([self.number({n: v}, n, key) for v in self.listed(entry.get(n), (*key, n))] for n in _XY)
                    if len(xs) != len(ys):
                        raise self.error(key, "a polygon needs as many xs as ys", f"{len(xs)} and {len(ys)}")
                    shape = Polygon(tuple(zip(xs, ys, strict=True)))
        except ValueError as error:
            raise self.error(key, str(error)) from None
        return (Edge(shape, kind.startswith("Obsc"), self.number(entry, "theta", key, 0.0)),)


def _air(um: float, pressure: float, temperature: float, water: float) -> float:
    """Return the index of air at a wavelength (um), pressure (kPa), temperature (K) and vapour pressure (kPa).

    Filippenko, PASP 94, 715 (1982).
    """
    mm, celsius, vapour = pressure * 7.50061683, temperature - 273.15, water * 7.50061683
    s2 = 1.0 / um**2
    n = (64.328 + 29498.1 / (146.0 - s2) + 255.4 / (41.0 - s2)) * 1e-6
    n *= mm * (1.0 + (1.049 - 0.0157 * celsius) * 1e-6 * mm) / (720.883 * (1.0 + 0.003661 * celsius))
    n -= (0.0624 - 0.000680 * s2) / (1.0 + 0.003661 * celsius) * vapour * 1e-6
    return 1.0 + n


def read_batoid(path: str | Path, wavelength: float) -> Prescription:
    """Read a telescope of batoid.

    Parameters
    ----------
    path : str or Path
        Path of its YAML file.
    wavelength : float
        Wavelength at which the glasses' indices are taken, in metres; batoid's files name none.

    Raises
    ------
    InputError
        The file is damaged or has unsupported content; the message names the line.
    """
    reader = _Reader(str(path), _loaded(path), wavelength)
    system = reader.mapping(reader.mapping(reader.data, ()).get("opticalSystem"), ("opticalSystem",))
    if "inMedium" in system:
        reader.ambient = reader.medium(system["inMedium"], ("opticalSystem", "inMedium"))
    reader.optic(system, ("opticalSystem",), Pose(), reader.ambient, reader.ambient)
    if len(reader.surfaces) < 2:
        raise reader.error(("opticalSystem",), "too few surfaces", len(reader.surfaces), "optics and a detector")
    # Batoid aims at a surface before the telescope; here the stop is the first surface with an effect on light.
    active = [k for k, surface in enumerate(reader.surfaces) if surface.interaction is not Interaction.PASS]
    stop = active[0] if active else 0
    notes = [*reader.notes, Note(0, "", "no stop among the surfaces: the first surface is used")]
    if reader.ambient != 1.0:
        notes.append(Note(0, "inMedium", f"indices are relative to it, {reader.ambient:.9f}, and so are paths"))
    name, surfaces = str(system.get("name", "")) or Path(path).stem, tuple(reader.surfaces)
    # The dispersion relative to another medium than the first one of the file differs.
    glasses = {glass.name: glass for glass in reader.named.values()} if reader.ambient == 1.0 else {}
    further: dict[str, Any] = {"field_kind": "none", "notes": tuple(notes), "glasses": FrozenMap(glasses)}
    return Prescription(name, str(path), surfaces, stop, wavelength, (wavelength,), **further)


def _loaded(path: str | Path) -> object:
    """Return the contents of a YAML file, which may use anchors, with the lines of its keys."""
    source = Source(str(path))
    text = "\n".join(read_lines(source, "a telescope in YAML", LARGEST_FILE))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about anchors that are defined twice
            return YAML(typ="rt", pure=True).load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        problem = f"not YAML: {error.problem}"
        raise source.error(problem, None if mark is None else mark.line + 1) from None
    except (YAMLError, ValueError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise source.error(f"unreadable YAML: {type(error).__name__}", 1) from None
