"""A camera as the list of its surfaces, as lens design programs have it, and its first-order data.

Frame: z along the axis, and light from the scene travels toward +z; the origin is the vertex of the first surface. A
radius is positive where the centre of curvature lies toward +z of the vertex. A thickness leads to the next vertex,
that of the last surface to the image plane, and is negative where light travels toward -z, as after one mirror.

Third-order aberrations of a centred camera by surface: Seidel sums and chromatic sums of paraxial rays.

The formulas are those of W. T. Welford, Aberrations of Optical Systems (1986), chapters 8 to 10, for two paraxial rays:
the marginal ray, which passes the rim of the stop, and the chief ray of the edge of the field. A mirror is a change of
the sign of the refractive index.
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
    A Ritchey-Chretien telescope of 0.45 m aperture at F/8. M1 is F/2.67, and M2 magnifies 3 times; the hole in
    M1 has the size of the shadow of M2:

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
                wrong, axis = ("negative", "+z") if ahead > 0.0 else ("positive", "-z")
                raise ValueError(
                    f"the thickness of surface {k} must not be {wrong}: light travels toward {axis} there, got "
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


ABERRATIONS = ("spherical", "coma", "astigmatism", "field curvature", "distortion")
"""Names of the five third-order aberrations, in the order of the Seidel sums."""


@dataclass(frozen=True, eq=False)
class SeidelSums:
    """Third-order aberrations of K surfaces at the rim of the pupil and the edge of the field.

    Attributes
    ----------
    names : tuple of str
        Names of the K surfaces.
    sums : (K, 5) ndarray
        Seidel sums S_I to S_V of each surface, metres: spherical aberration, coma, astigmatism, Petzval curvature and
        distortion.
    colour : (K, 2) ndarray, optional
        Chromatic sums C_I (axial colour) and C_II (lateral colour) of each surface, metres; None without a second and a
        third wavelength.
    invariant : float
        Lagrange invariant H of the two rays, metres.
    petzval : float
        Curvature of the Petzval surface, 1/m, positive where its centre lies toward +z; 0 is a flat field.
    """

    names: tuple[str, ...]
    sums: np.ndarray
    colour: np.ndarray | None
    invariant: float
    petzval: float

    @property
    def wavefront(self) -> np.ndarray:
        """Wavefront coefficients W040, W131, W222, W220 and W311 of each surface, metres, (K, 5).

        They are the path error at the rim of the pupil and the edge of the field, positive where the wavefront is
        ahead. W222 and W220 are those of a focus at the paraxial image: W220 is sagittal, W220 + W222 tangential.
        """
        s1, s2, s3, s4, s5 = self.sums.T
        return np.stack([s1 / 8.0, s2 / 2.0, s3 / 2.0, (s3 + s4) / 4.0, s5 / 2.0], axis=-1)


def seidel(camera: Camera, field: float, ends: tuple[float, float] | None = None) -> SeidelSums:
    """Compute the third-order aberrations of each surface of a camera.

    Parameters
    ----------
    camera : Camera
        Camera whose surfaces are centred on one axis. Figure errors, vanes and central obscurations have no effect.
    field : float
        Angle of the edge of the field from the axis, radians.
    ends : (float, float), optional
        Shortest and longest wavelength, metres, for the chromatic sums.

    Returns
    -------
    SeidelSums
        Seidel sums by surface, and wavefront coefficients.

    Raises
    ------
    ValueError
        A surface or the stop is decentred or tilted.

    Examples
    --------
    A paraboloid has no spherical aberration; its coma at F/8 and 3 arcmin is W131 = field * diameter / (32 N^2):

    >>> mirror = OpticalSurface(-4.0, -2.0, -1.0, "mirror", diameter=0.25)
    >>> camera = Camera([mirror], wavelength=550e-9)
    >>> field = np.radians(0.05)
    >>> terms = seidel(camera, field).wavefront.sum(axis=0)
    >>> bool(abs(terms[0]) < 1e-20)
    True
    >>> bool(np.isclose(abs(terms[1]), np.tan(field) * 0.25 / (32 * 8**2)))
    True
    """
    names = camera._assembly.sequences["image"][:-1]
    indices = [np.array([1.0, *camera.at(wave).indices]) for wave in (camera.wavelength, *(ends or ()))]
    return seidel_sums(
        camera._assembly, names, camera.stop, 0.5 * camera.surfaces[camera.stop].diameter, field, indices
    )


def seidel_sums(
    assembly: Assembly, names: Sequence[str], stop: int, radius: float, field: float, indices: Sequence[np.ndarray]
) -> SeidelSums:
    """Compute the third-order aberrations of the elements of an assembly, for light from infinity.

    Parameters
    ----------
    assembly : Assembly
        Optical elements in the frame of the axis, which is z.
    names : sequence of str
        Names of the K elements in the order in which light meets them, without the image.
    stop : int
        Index of the aperture stop among them.
    radius : float
        Radius of the stop, metres.
    field : float
        Angle of the edge of the field from the axis, radians.
    indices : one or three (K + 1,) ndarray
        Refractive indices before the first and after each element: at the design wavelength and, for the chromatic
        sums, at the shortest and at the longest.

    Raises
    ------
    ValueError
        An element is decentred, tilted or not a surface of revolution.
    """
    elements = [assembly.elements[name] for name in names]
    poses = [assembly.nominal_pose(name) for name in names]
    for element, pose in zip(elements, poses, strict=True):
        outer = element.outer_edge if element is elements[stop] else None
        centred = not np.any(pose.translation[:2]) and np.allclose(pose.rotation[2], [0.0, 0.0, 1.0], atol=1e-12)
        if element.surface.terms or not centred or (outer is not None and any(outer.centre)):
            raise ValueError(
                f"third-order sums need surfaces of revolution about one axis and a stop centred on it; {element.name} "
                "is decentred, tilted or has another form"
            )
    surfaces = [element.surface for element in elements]
    c = np.array([surface.curvature for surface in surfaces])
    # the r^4 term beyond the sphere's, times 8
    fourth = np.array([8.0 * (s.even[0] if s.even else 0.0) + s.conic * s.curvature**3 for s in surfaces])
    reflected = [element.interaction is Interaction.REFLECT for element in elements]
    signs = np.cumprod([1.0, *np.where(reflected, -1.0, 1.0)])
    n = signs * indices[0]
    gaps = np.diff([pose.translation[2] for pose in poses])

    def ray(height: float, slope: float) -> tuple[np.ndarray, np.ndarray]:
        return paraxial_ray(c, gaps, n, height, slope)

    per_height, per_slope = ray(1.0, 0.0)[0][stop], ray(0.0, 1.0)[0][stop]
    y, u = ray(radius / per_height, 0.0)
    yb, ub = ray(-np.tan(field) * per_slope / per_height, np.tan(field))
    a, ab = n[:-1] * (u[:-1] + y * c), n[:-1] * (ub[:-1] + yb * c)
    h = float(a[0] * yb[0] - ab[0] * y[0])
    step, inverse = np.diff(u / n), np.diff(1.0 / n)
    spherical = [-a * a * y * step, -a * ab * y * step, -ab * ab * y * step]
    fifth = -ab * (ab * ab * y * np.diff(1.0 / n**2) - (ab * y - h) * yb * c * inverse)
    aspheric = fourth * np.diff(n)
    sums = np.stack([*spherical, -h * h * c * inverse, fifth], axis=-1)
    sums += np.stack([aspheric * y**p * yb ** (4 - p) for p in (4, 3, 2)] + [0.0 * y, aspheric * y * yb**3], axis=-1)
    colour = None
    if len(indices) == 3:
        spread = np.diff((indices[1] - indices[2]) / indices[0])
        colour = np.stack([a * y * spread, ab * y * spread], axis=-1)
    return SeidelSums(tuple(names), sums, colour, h, float(n[-1] * np.sum(c * inverse)))


def paraxial_ray(
    curvatures: Sequence[float] | np.ndarray,
    gaps: Sequence[float] | np.ndarray,
    indices: Sequence[float] | np.ndarray,
    height: float,
    slope: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Trace a paraxial ray through K surfaces centred on the z axis.

    Parameters
    ----------
    curvatures : (K,) array
        Curvatures of the surfaces, 1/m.
    gaps : (K - 1,) array
        Distances along z from each vertex to the next, metres.
    indices : (K + 1,) array
        Refractive indices before the first and after each surface, negative where the light runs toward -z.
    height, slope : float
        Height at the first surface, metres, and slope before it, per distance along z.

    Returns
    -------
    heights : (K,) ndarray
        Heights at the surfaces, metres.
    slopes : (K + 1,) ndarray
        Slopes before the first and after each surface.
    """
    heights, slopes = [height], [slope]
    for k, gap in enumerate([*gaps, 0.0]):
        bending = heights[k] * curvatures[k] * (indices[k + 1] - indices[k])
        slopes.append((indices[k] * slopes[k] - bending) / indices[k + 1])
        heights.append(heights[k] + slopes[k + 1] * gap)
    return np.array(heights[:-1]), np.array(slopes)
