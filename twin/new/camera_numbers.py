"""Numbers that a new file takes from its camera: bodies, diffraction limit, depth of focus, room for a monitor.

The text of a new file is its template, filled with these numbers and checked by the model of its kind.
"""

import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from itertools import takewhile
from math import atan, copysign, degrees, isfinite, sqrt, tan
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from optics.camera.prescription import paraxial_ray
from optics.numerics.backend import load_backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.camera_model import derive_camera
from scenes.models.camera_sharpness import sharpness
from scenes.specs.camera import CameraSpec, MirrorSpec
from scenes.specs.file_kinds import file_kinds
from scenes.specs.load import is_path
from scenes.specs.resolved import resolve_with
from scenes.yaml.errors import InputError, Issue, Problem
from scenes.yaml.spec import validate
from scenes.yaml.units import LENGTH, format_quantity, parse_quantity, split_quantity
from scenes.yaml.yaml_file import parse_yaml

_NONE: Mapping[str, float] = FrozenMap()
DIFFRACTION_LIMIT = 0.0714
"""Wavefront error of a Strehl ratio of 0.8, waves rms (Marechal)."""
INDEX = 2e-4
"""Tolerance of the refractive index of a melt."""
RADIUS = 1e-4
"""Relative tolerance of a radius, as good test plates and bars measure it."""
_CCD_BEYOND_LINE = 1e-3
"""Distance of a monitor's area CCD, 1.2 mm wide, from the end of the line CCD, metres."""


@dataclass(frozen=True)
class OpticalElement:
    """Mirror, lens or lens face as bodies of an instrument.

    Attributes
    ----------
    name, label : str
        Path of its body, or its last parts, in files; name of its tolerances.
    others : tuple of str
        Bodies that move with it: the other face of a lens.
    lens : bool
        Whether it is a lens.
    curved : bool
        Whether its (first) surface has a finite radius.
    """

    name: str
    label: str
    others: tuple[str, ...] = ()
    lens: bool = False
    curved: bool = True

    @property
    def bodies(self) -> tuple[str, ...]:
        """All bodies of the element."""
        return (self.name, *self.others)

    @property
    def carry(self) -> str:
        """Key `carrying` of a motion, with the comma after it; empty for a mirror."""
        return f"carrying: [{', '.join(self.others)}], " if self.others else ""


@dataclass(frozen=True)
class CameraNumbers:
    """Camera of a new file with the numbers that follow from it; texts are as files have them.

    Attributes
    ----------
    camera : CameraSpec
        The camera; of a pair the first one.
    reference : str
        Reference to its instrument or to itself, as the new file has it.
    name : str
        Name of the instrument or camera.
    mounted : str
        Name of the camera in its instrument.
    prefix : str
        Beginning of the names of its bodies: empty for a camera alone.
    monitored : bool
        Whether the instrument has a monitor.
    worst : float
        Largest wavefront error over the field as designed, waves rms.
    upright : bool
        Whether the image is upright.
    """

    camera: CameraSpec
    reference: str
    name: str
    mounted: str
    prefix: str
    monitored: bool
    worst: float
    upright: bool

    @cached_property
    def _powered(self) -> dict[str, MirrorSpec]:
        """Mirrors and lens faces; planes that light passes are left out."""
        return {name: face for name, face in self.camera.mirrors.items() if face.light != "passes"}

    @cached_property
    def faces(self) -> tuple[OpticalElement, ...]:
        """Mirrors and faces of lenses, each by itself."""
        powered = self._powered.items()
        return tuple(OpticalElement(self.prefix + name, name, curved=isfinite(face.radius)) for name, face in powered)

    @cached_property
    def elements(self) -> tuple[OpticalElement, ...]:
        """Mirrors and lenses; a lens is two faces that move as one body."""
        out: list[OpticalElement] = []
        for face, spec in zip(self.faces, self._powered.values(), strict=True):
            if spec.light == "refracts" and not spec.enters_glass:
                alike = takewhile(lambda pair: pair[0] == pair[1], zip(out[-1].label, face.label, strict=False))
                label = "".join(letter for letter, _ in alike).rstrip("_-")
                out[-1] = replace(out[-1], others=(face.name,), label=label or out[-1].label)
            else:
                out.append(replace(face, lens=spec.enters_glass))
        return tuple(out)

    @property
    def moved(self) -> tuple[OpticalElement, ...]:
        """Elements whose rigid motions count: all but the first, which is the datum, unless it is the only one."""
        return self.elements[0 if len(self.elements) == 1 else 1 :]

    @staticmethod
    def shift_key(element: OpticalElement, axis: int) -> str:
        """Return the key of a study's factor that shifts an element; the faces of a lens get the same shift."""
        if not element.others:
            return f"motion: {element.name} shift {'xyz'[axis]}"
        keys = (f"[job, perturb, {name}, shift, {axis}]" for name in element.bodies)
        return f"keys: [{', '.join(keys)}]"

    def bodies(self, elements: Iterable[OpticalElement]) -> str:
        """Return the whole paths of the bodies of elements as a list in a file."""
        names = (name.removeprefix(self.prefix) for element in elements for name in element.bodies)
        return f"[{', '.join(f'base/{self.mounted}/{name}' for name in names)}]"

    @property
    def requirement(self) -> str:
        """Wavefront error to require: the diffraction limit, or its root sum square with a design without margin.

        A design has no margin if its mean square error exceeds half of the limit's.
        """
        margin = 2.0 * self.worst**2 <= DIFFRACTION_LIMIT**2
        return f"{DIFFRACTION_LIMIT if margin else sqrt(DIFFRACTION_LIMIT**2 + self.worst**2):.3g}"

    @property
    def figure(self) -> str:
        """Figure tolerance of a hundredth of a wave rms, about a twentieth peak to valley."""
        return _rounded(0.01 * self.camera.wavelength)

    @property
    def _depth(self) -> float:
        """Depth of focus 2 lambda F^2, metres."""
        return 2.0 * self.camera.wavelength * (self.camera.focal_length / self.camera.entrance_pupil) ** 2

    @property
    def focus_sigma(self) -> str:
        """A quarter of the depth of focus."""
        return _rounded(0.25 * self._depth)

    def _image(
        self, shifts: Mapping[str, float], radii: Mapping[str, float] = _NONE, indices: Mapping[str, float] = _NONE
    ) -> float:
        """Return the paraxial focus on the axis, metres, with changes of faces by name.

        Faces are shifted (metres), radii change by a share, refractive indices of glasses by a number.
        """
        vertices, curvatures, media = [], [], [1.0]
        for name, face in self._powered.items():
            vertices.append(face.z + shifts.get(name, 0.0))
            curvatures.append(1.0 / (face.radius * (1.0 + radii.get(name, 0.0))))
            if face.light == "refracts":
                media.append(copysign(self.camera.index_behind(name) + indices.get(name, 0.0), media[-1]))
            else:
                media.append(-media[-1])
        heights, slopes = paraxial_ray(curvatures, np.diff(vertices), media, 1.0, 0.0)
        return float(vertices[-1] - heights[-1] / slopes[-1])

    def _defocus(self, element: OpticalElement, shift: float) -> float:
        """Return by how much the focus moves, metres, where an element moves along the axis."""
        names = {name.removeprefix(self.prefix): shift for name in element.bodies}
        return abs(self._image(names) - self._image({}))

    def _all_defocus(self, decentre: str) -> float:
        """Return the sum of the focus shifts of all despaces, radii and indices at their limits, metres."""
        shift, focus = parse_quantity(decentre, LENGTH), self._image({})
        radii = (self._image({}, {name: RADIUS}) for name in self._powered)
        glasses = (name for name, face in self._powered.items() if face.enters_glass)
        indices = (self._image({}, {}, {name: INDEX}) for name in glasses)
        changed = sum(abs(image - focus) for image in (*radii, *indices))
        return changed + sum(self._defocus(element, shift) for element in self.moved)

    def seat(self, decentre: str) -> str:
        """Return the focus shift of all limits together, by which a focal plane may be off before it is adjusted."""
        return _rounded(self._all_defocus(decentre))

    def _lever(self, compensator: str) -> float:
        """Return the focus shift over the motion of the compensator that makes it."""
        if compensator == "focal_plane":
            return 1.0
        small = 1e-6
        return self._defocus(self._named(compensator), small) / small

    def _named(self, compensator: str) -> OpticalElement:
        """Return the element of a label or body; raise `InputError` if there is no such element."""
        for element in self.elements:
            if compensator in (element.label, element.name):
                return element
        allowed = ", ".join(["focal_plane", *(element.label for element in self.elements)])
        raise InputError(Issue("there is no such body", "", None, (), compensator, allowed))

    def compensator(self, name: str) -> str:
        """Return the motion of a compensator along the axis, with what it carries."""
        if name == "focal_plane":
            return f"{self.prefix}focal_plane shift z"
        element = self._named(name)
        return f"{element.name} shift z, {element.carry}".removesuffix(", ")

    def focus_range(self, compensator: str, decentre: str) -> str:
        """Return the range of a compensator: twice the focus shift of all limits together."""
        return _rounded(2.0 * self._all_defocus(decentre) / self._lever(compensator))

    def focus_step(self, compensator: str) -> str:
        """Return the step of a compensator: an eighth of the depth of focus."""
        return _rounded(0.125 * self._depth / self._lever(compensator))

    @property
    def scale_limit(self) -> str:
        """Change of the principal distance that moves the end of the line by a pixel."""
        line = self.camera.line
        return _rounded(2.0 * self.camera.focal_length / line.pixels)

    @property
    def pupil(self) -> str:
        """Diameter of the entrance pupil."""
        return format_quantity(self.camera.entrance_pupil, LENGTH)

    @property
    def wavelength(self) -> str:
        """Design wavelength."""
        return format_quantity(self.camera.wavelength, LENGTH)

    @property
    def monitored_name(self) -> str:
        """Name of the camera in the instrument with a monitor."""
        return self.mounted if self.monitored else "camera"

    @property
    def hand(self) -> float:
        """Sign of the position in the pupil, along the line, of the beam from the line's end at +Y."""
        return -1.0 if self.upright else 1.0

    @property
    def monitor_field(self) -> str:
        """Field angle of a monitor's area CCDs, degrees: beside the end of the line."""
        half = max(
            0.5 * self.camera.line.pixels * self.camera.line.pitch, self.camera.focal_length * tan(self.camera.field.x)
        )
        return f"{degrees(atan((half + _CCD_BEYOND_LINE) / self.camera.focal_length)):.5g}"

    @property
    def front(self) -> float:
        """Distance from M1 to the foremost vertex or the image, metres."""
        return -min(0.0, self.camera.image.z, *(surface.z for surface in self.camera.mirrors.values()))

    def mm(self, pupils: float, plus: float = 0.0) -> str:
        """Return a length in units of the entrance pupil, plus a number of metres."""
        return f"{1e3 * (pupils * self.camera.entrance_pupil + plus):.5g} mm"

    @property
    def fits_monitor(self) -> bool:
        """True if a monitor can have the camera as it is: mirrors M1, M2, ... without planes and edges.

        Raises
        ------
        InputError
            It is an instrument, or a camera with lenses or a separate stop, with which no monitor is modelled.
        """
        if self.name != self.mounted or self.monitored:
            problem = "a new monitor is for a camera, and this is an instrument"
            raise InputError(Issue(problem, self.reference, allowed=f"its camera {self.camera.name}"))
        lens = next((name for name, surface in self.camera.mirrors.items() if surface.light == "refracts"), None)
        stop = self.camera.mirrors[self.camera.stop].light == "passes"
        if lens or stop:
            problem = "a monitor needs a camera of mirrors, one of which is its stop"
            raise InputError(Issue(problem, self.reference, value=lens or f"stop: {self.camera.stop}"))
        plain = all(surface.light is None and surface.edges is None for surface in self.camera.mirrors.values())
        return plain and list(self.camera.mirrors) == [f"M{k + 1}" for k in range(len(self.camera.mirrors))]

    @property
    def bare_camera(self) -> str:
        """Camera that a monitor can have, as YAML: its mirrors alone, without edges, named M1, M2, ..."""
        new = {name: f"M{k + 1}" for k, name in enumerate(self._powered)}
        mirrors = {new[name]: face.model_copy(update={"edges": None}) for name, face in self._powered.items()}
        update = {"mirrors": FrozenMap(mirrors), "stop": new[self.camera.stop]}
        return self.camera.model_copy(update=update).file_text("").rstrip()


def _rounded(length: float) -> str:
    """Return a length with two digits, which suffice for a number of a first file."""
    return format_quantity(float(f"{length:.2g}"), LENGTH)


def numbers_of(reference: str, folder: Path) -> CameraNumbers:
    """Return the numbers that a new file in a folder takes from a camera, or from the first one of an instrument.

    Raises
    ------
    InputError
        There is no such camera or instrument, or its prescription brings no light to the image.
    """
    resolved = resolve_with(reference)
    instrument, backend = resolved.instrument, load_backend("llvm")
    mounted, site = next(iter(instrument.cameras.items()))
    camera = resolved.cameras[site.camera]
    alone = len(instrument.cameras) == 1
    names = (reference_from(reference, folder), instrument.name, mounted, "" if alone else f"{mounted}/")
    upright = bool(derive_camera(camera, backend).first_order.scale[0, 0, 0] < 0.0)
    return CameraNumbers(camera, *names, instrument.monitor is not None, sharpness(camera, backend).worst, upright)


def reference_from(reference: str, folder: Path) -> str:
    """Return a reference to an instrument as a file in a folder has it: a name, or a path relative to the folder."""
    return _quoted(os.path.relpath(reference, folder)) if is_path(reference) else reference


def checked_text(kind: str, numbers: CameraNumbers, values: Mapping[str, str]) -> str:
    """Return the text of a new file.

    Parameters
    ----------
    kind : str
        Name of its template and kind of file.
    numbers : CameraNumbers
        Numbers of its camera.
    values : mapping of str to str
        Answers to the questions of its kind, ``file``, its path, and ``base``, the job of a study.

    Raises
    ------
    InputError
        A value is not allowed.
    """
    environment = Environment(
        loader=FileSystemLoader(str(files(__package__))),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["times"] = _times
    template = environment.get_template(f"{kind}.yaml.j2")
    try:
        text = template.render(n=numbers, index=INDEX, radius=RADIUS, nested=kind == "operation", **values)
    except Problem as problem:  # an option that is no quantity
        raise InputError(Issue(problem.problem, value=problem.value, allowed=problem.allowed)) from None
    model = next(file_kind for file_kind in file_kinds() if file_kind.name == kind).model
    validate(model, parse_yaml(text))
    return text


def _quoted(path: str) -> str:
    """Return a path as YAML reads it back, in quotes where it needs them."""
    return path if re.fullmatch(r"[\w./][\w./ +-]*", path) else json.dumps(path, ensure_ascii=False)


def _times(quantity: str, factor: float) -> str:
    """Return a quantity times a number, in its own unit."""
    parts = split_quantity(quantity)
    if parts is None:
        raise Problem("not a quantity with its unit", quantity, "10 um, 5 arcsec")
    number, unit = parts
    return f"{factor * number:.6g} {unit}"
