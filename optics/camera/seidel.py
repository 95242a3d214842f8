"""Third-order aberrations of a centred camera by surface: Seidel sums and chromatic sums of paraxial rays.

The formulas are those of W. T. Welford, Aberrations of Optical Systems (1986), chapters 8 to 10, for two paraxial rays:
the marginal ray, which passes the rim of the stop, and the chief ray of the edge of the field. A mirror is a change of
the sign of the refractive index.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optics.camera.prescription import Camera
from optics.raytrace.assembly import Assembly, Interaction

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
