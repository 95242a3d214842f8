"""A camera as the list of its surfaces, as lens design programs have it, and its first-order data.

Frame: z along the axis, and light from the scene travels toward +z; the origin is the vertex of the first surface. A
radius is positive where the centre of curvature lies toward +z of the vertex. A thickness leads to the next vertex,
that of the last surface to the image plane, and is negative where light travels toward -z, as after one mirror.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf, isfinite
from typing import Literal

import numpy as np

from optics.geometry.aperture import Circle, Edge, Ray
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.surface import Surface, ZernikeFigure, plane
from optics.geometry.tree import Body, RigidTree
from optics.geometry.zernike import noll_to_nm
from optics.materials.glass import refractive_index
from optics.numerics.arguments import check_fields
from optics.numerics.array_math import UnphysicalError, determinant
from optics.numerics.backend import default_backend
from optics.raytrace.aim import transverse_axes
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.first_order import Paraxial, RayMatrix, paraxial, ray_matrix
from optics.raytrace.system import SystemBatch, assemble

MIRROR = "mirror"
"""Material of a surface that reflects."""

_IMAGE = "image"

_AFOCAL = 1000.0
"""Ratio of focal length to length of the camera above which the camera counts as afocal (without a focus)."""


@dataclass(frozen=True, eq=False)
class OpticalSurface:
    """Row of a camera's prescription: a mirror, a face of a lens or a plane that only stops light.

    Attributes
    ----------
    radius : float
        Radius of curvature at the vertex, metres, positive where the centre lies toward +z; infinite for a plane.
    thickness : float
        Distance along z to the vertex of the next surface, or to the image, metres; negative after one mirror.
    conic : float
        Conic constant: 0 a sphere, -1 a paraboloid.
    material : str or float
        ``"mirror"``, the name of a glass behind the surface, or the refractive index there. 1 is the medium in which
        the camera stands.
    diameter : float
        Diameter of the clear aperture, metres; light is stopped outside.
    inner_diameter : float
        Diameter of a central hole or obscuration, metres; light is stopped inside.
    vanes : sequence of (float, float)
        Width in metres and direction from x in radians of each vane of a spider, from the middle outward.
    offset : (float, float)
        Middle of the clear aperture, x and y from the vertex, metres: the part of a parent surface that is used.
    asphere : sequence of float
        Coefficients A4, A6, ... of r^4, r^6, ..., in m^-3, m^-5, ...
    figure : mapping of int to float
        Noll index -> error of the sag along z, metres rms over the disk of ``diameter``.
    decenter : (float, float)
        Shift of this surface alone along x and y, metres.
    tilt : (float, float, float)
        Rotation vector of this surface alone about its vertex, radians.

    Raises
    ------
    ValueError
        A number is out of its range; the message says what is allowed.

    Examples
    --------
    A paraboloid of 2 m focal length whose hole has a quarter of its diameter:

    >>> m1 = OpticalSurface(-4.0, -2.0, conic=-1.0, material="mirror", diameter=0.4, inner_diameter=0.1)
    >>> m1.thickness, m1.vanes
    (-2.0, ())
    >>> OpticalSurface(radius=0.0)
    Traceback (most recent call last):
    ...
    ValueError: radius must not be 0 or NaN (a plane has math.inf), got 0.0
    """

    radius: float = inf
    thickness: float = 0.0
    conic: float = 0.0
    material: str | float = 1.0
    diameter: float = inf
    inner_diameter: float = 0.0
    vanes: Sequence[tuple[float, float]] = ()
    offset: tuple[float, float] = (0.0, 0.0)
    asphere: Sequence[float] = ()
    figure: Mapping[int, float] = field(default_factory=dict)
    decenter: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that every number is within its allowed range; raise ValueError otherwise."""
        check_fields(self)
        if not abs(self.radius) > 0.0:
            raise ValueError(f"radius must not be 0 or NaN (a plane has math.inf), got {self.radius}")
        numbers = self.thickness, self.conic, *self.asphere, *self.offset, *self.decenter, *self.tilt
        if not all(map(isfinite, numbers)):
            raise ValueError(f"thickness, conic, asphere, offset, decenter and tilt must be finite, got {numbers}")
        if not 0.0 <= self.inner_diameter < self.diameter:
            raise ValueError(f"0 <= inner_diameter < diameter is needed, got {self.inner_diameter} and {self.diameter}")
        if not isinstance(self.material, str) and not 1.0 <= self.material < inf:
            raise ValueError(f"a refractive index must be at least 1, got {self.material}")
        for term, amount in self.figure.items():
            noll_to_nm(term)
            if not isfinite(amount):
                raise ValueError(f"figure: the amount of term {term} must be finite, in metres, got {amount}")
        if not all(0.0 < width < inf and isfinite(angle) for width, angle in self.vanes):
            raise ValueError(
                f"vanes must be pairs of a positive width, in metres, and an angle, in radians, got {self.vanes}"
            )
        if self.figure and not isfinite(self.diameter):
            raise ValueError("a figure needs a finite diameter: its Zernike terms are over that disk")

    @property
    def shape(self) -> Surface:
        """Ideal shape and figure error of the surface, in its own frame (origin at the vertex)."""
        figure = ZernikeFigure(0.5 * self.diameter, self.offset, self.figure) if self.figure else None
        return Surface(1.0 / self.radius, self.conic, tuple(self.asphere), figure)

    def edges(self, rim: bool = True, hole: bool = True) -> tuple[Edge, ...]:
        """Return the edges that stop light at the surface: rim, central hole and spider vanes.

        Parameters
        ----------
        rim : bool
            Include the rim of the clear aperture.
        hole : bool
            Include the central hole or obscuration.
        """
        out = [Edge(Circle(0.5 * self.diameter, self.offset))] if rim and isfinite(self.diameter) else []
        if hole and self.inner_diameter:
            out.append(Edge(Circle(0.5 * self.inner_diameter, self.offset), blocks=True))
        return (*out, *(Edge(Ray(w, self.offset), blocks=True, rotation=angle) for w, angle in self.vanes))


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera from the numbers of its surfaces, for light of one wavelength from a scene at infinity.

    Attributes
    ----------
    surfaces : sequence of OpticalSurface
        Surfaces in the order in which light meets them.
    wavelength : float
        Wavelength of the light, metres.
    stop : int
        Index of the surface that is the aperture stop; its ``diameter`` sets the beam.
    image_tilt : (float, float, float)
        Rotation vector of the image plane about the point where the axis meets it, radians.
    medium : {"vacuum", "air"}
        Medium around the camera: glass catalogues give refractive indices relative to air, which differ from those in
        vacuum.

    Raises
    ------
    ValueError
        There is no surface, ``stop`` is not the index of one or that surface has no diameter, the sign of a thickness
        is opposite to the direction of the light, a glass is not known, or the wavelength is outside its formula's
        range.

    Examples
    --------
    A Ritchey-Chretien telescope of 0.45 m aperture at F/8. M1 is F/2.67, and M2 magnifies 3 times; the shadow of M2
    stands for a hole in M1:

    >>> m1 = OpticalSurface(-2.4, -0.88, -1.080808, "mirror", diameter=0.45, inner_diameter=0.12)
    >>> m2 = OpticalSurface(-0.96, 0.96, -5.022727, "mirror")
    >>> camera = Camera([m1, m2], wavelength=550e-9)
    >>> round(camera.focal_length, 3), round(camera.f_number, 3)
    (3.6, 8.0)
    >>> Camera([m1, m2], wavelength=550e-9, stop=1)
    Traceback (most recent call last):
    ...
    ValueError: the stop, surface 1, needs a finite diameter
    >>> Camera([m2, m1], wavelength=550e-9, stop=1)
    Traceback (most recent call last):
    ...
    ValueError: the thickness of surface 0 must not be positive: light travels toward -z there, got 0.96
    """

    surfaces: Sequence[OpticalSurface]
    wavelength: float
    stop: int = 0
    image_tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    medium: Literal["vacuum", "air"] = "vacuum"

    def __post_init__(self) -> None:
        """Check that stop, signs of thicknesses and glasses are possible; raise ValueError otherwise."""
        check_fields(self)
        if not len(self.surfaces):
            raise ValueError("surfaces must be a sequence of at least one OpticalSurface")
        object.__setattr__(self, "surfaces", tuple(self.surfaces))
        if not 0 <= self.stop < len(self.surfaces):
            raise ValueError(f"stop must be the index of one of the {len(self.surfaces)} surfaces, got {self.stop}")
        if not isfinite(self.surfaces[self.stop].diameter):
            raise ValueError(f"the stop, surface {self.stop}, needs a finite diameter")
        if not 1e-9 <= self.wavelength <= 1e-2:
            raise ValueError(f"wavelength must be 1e-9 to 1e-2, in metres, got {self.wavelength}")
        ahead = 1.0
        for k, surface in enumerate(self.surfaces):
            ahead = -ahead if surface.material == MIRROR else ahead
            if surface.thickness * ahead < 0.0:
                wrong, way = ("negative", "+z") if ahead > 0.0 else ("positive", "-z")
                raise ValueError(
                    f"the thickness of surface {k} must not be {wrong}: light travels toward {way} there, got "
                    f"{surface.thickness}"
                )
        self.indices  # noqa: B018

    @cached_property
    def indices(self) -> tuple[float, ...]:
        """Refractive index of the medium after each surface; after a mirror it is that before it."""
        out = [1.0]
        for surface in self.surfaces:
            named = surface.material
            if isinstance(named, str):
                named = out[-1] if named == MIRROR else float(refractive_index(named, self.wavelength, self.medium))
            out.append(named)
        return tuple(out[1:])

    @cached_property
    def vertices(self) -> np.ndarray:
        """Positions along z of the vertices of the K surfaces and, last, of the image plane, (K + 1,), metres."""
        return np.cumsum([0.0, *(surface.thickness for surface in self.surfaces)])

    @property
    def _image_pose(self) -> Pose:
        """Position and orientation of the image plane in the camera's frame."""
        return Pose(rotation_matrix(self.image_tilt), np.array([0.0, 0.0, self.vertices[-1]]))

    @cached_property
    def _assembly(self) -> Assembly:
        """Camera as an assembly of bodies and optical elements, the form in which rays are traced."""
        bodies, elements, before = [Body(_IMAGE, self._image_pose)], {}, 1.0
        for k, (surface, z, index) in enumerate(zip(self.surfaces, self.vertices[:-1], self.indices, strict=True)):
            name, bends = f"s{k}", Interaction.PASS if index == before else Interaction.REFRACT
            light = Interaction.REFLECT if surface.material == MIRROR else bends
            bodies.append(Body(name, Pose(rotation_matrix(surface.tilt), np.array([*surface.decenter, z]))))
            elements[name] = Element(name, name, surface.shape, light, None, index, edges=surface.edges())
            before = index
        elements[_IMAGE] = Element(_IMAGE, _IMAGE, plane(), Interaction.PASS, None, before)
        return Assembly(RigidTree(tuple(bodies)), elements, {_IMAGE: tuple(elements)})

    @cached_property
    def _systems(self) -> tuple[SystemBatch, SystemBatch]:
        """Two systems to trace: one of all surfaces and the image plane, and one that ends at the aperture stop."""
        names = self._assembly.sequences[_IMAGE]
        return assemble(self._assembly, [names]), assemble(self._assembly, [names[: self.stop + 1]])

    @property
    def _aperture(self) -> Circle:
        """Rim of the aperture stop, in the frame of its surface."""
        stop = self.surfaces[self.stop]
        return Circle(0.5 * stop.diameter, stop.offset)

    @property
    def _launch(self) -> np.ndarray:
        """Point on the axis before the first surface through which plane wavefronts start, metres, (3,)."""
        return np.array([0.0, 0.0, -self.surfaces[self.stop].diameter])

    def _matrix(self, position: np.ndarray, direction: np.ndarray) -> RayMatrix:
        """Return the derivatives of a ray on the image plane with respect to its launch point and launch direction.

        Parameters
        ----------
        position : (3,) ndarray
            Launch point, metres.
        direction : (3,) ndarray
            Launch direction, a unit vector.
        """
        axes = transverse_axes(direction[None], np.eye(3)[:1])
        return ray_matrix(default_backend(), self._systems[0], self.stop, position[None], direction[None], axes)

    @cached_property
    def _axial(self) -> RayMatrix:
        return self._matrix(self._launch, np.array([0.0, 0.0, 1.0]))

    @cached_property
    def paraxial(self) -> Paraxial:
        """Focal lengths, and positions and magnification of the pupils, for rays close to the axis; in metres."""
        return paraxial(self._axial, -float(self._launch[2]), abs(self.surfaces[-1].thickness))

    @property
    def is_afocal(self) -> bool:
        """True if parallel light leaves the camera parallel, so that it forms no image."""
        return not self.focal_length < _AFOCAL * (float(np.sum(np.abs(np.diff(self.vertices)))) or 1.0)

    @property
    def focal_length(self) -> float:
        """Effective focal length, metres."""
        return self.paraxial.focal_length

    @property
    def entrance_pupil_diameter(self) -> float:
        """Diameter of the entrance pupil, metres."""
        magnification = np.sqrt(np.abs(determinant(self._axial.stop_by_position[0])))
        return float(self.surfaces[self.stop].diameter / magnification)

    @property
    def f_number(self) -> float:
        """Focal length over the diameter of the entrance pupil."""
        return self.focal_length / self.entrance_pupil_diameter

    def at(self, wavelength: float) -> Camera:
        """Return the camera in light of another wavelength, metres.

        Examples
        --------
        >>> lens = [OpticalSurface(0.05, 0.004, material="N-BK7", diameter=0.02), OpticalSurface(-0.05, 0.048)]
        >>> camera = Camera(lens, wavelength=587.6e-9)
        >>> blue = camera.at(486.1e-9)
        >>> round(1e3 * camera.focal_length, 2), round(1e3 * blue.focal_length, 2)
        (49.0, 48.49)
        """
        return replace(self, wavelength=wavelength)

    def refocused(self) -> Camera:
        """Return the camera with the image plane at the paraxial focus.

        Raises
        ------
        ValueError
            The camera has no focus: parallel light leaves it parallel.

        Examples
        --------
        >>> mirror = OpticalSurface(-4.0, -1.9, -1.0, "mirror", diameter=0.4)
        >>> Camera([mirror], wavelength=550e-9).refocused().surfaces[0].thickness
        -2.0
        """
        if self.is_afocal:
            raise UnphysicalError("the camera is afocal: parallel light leaves it parallel, so that it has no focus")
        *before, last = self.surfaces
        toward = -1.0 if self._axial.direction[0, 2] < 0.0 else 1.0
        return replace(
            self, surfaces=(*before, replace(last, thickness=round(toward * self.paraxial.back_focal_length, 15)))
        )
