"""Ghost images of refracting surfaces: paths with two reflections, their focus, size and strength.

Light on such a path is reflected back by a refracting surface or the detector, and forward again by a refracting
surface before it. It is traced exactly, through all surfaces between the two, mirrors included, a second and a third
time. Mirrors reflect all light.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from optics.camera.image_quality import Field, launch_rays
from optics.camera.prescription import Camera
from optics.materials.fresnel_scatter import reflectance
from optics.numerics.backend import Backend, default_backend
from optics.numerics.quadrature import circle, even_disk
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace

DETECTOR = 0.3
"""Reflectance of a detector without a stated one, that of bare silicon."""

_NEAR = 1e-4
"""Distance from the chief ray, in units of the stop's radius, of the rays that find the paraxial focus.

Spherical aberration changes it by a share of 1e-8, and rounding by less.
"""

_RIM, _NODES = 48, 400
"""Numbers of rays around the rim of the stop and over its area."""

_INSIDE = 1.0 - 1e-9
"""Radius, in units of the stop's, of the rim's rays, so that rounding does not vignet them."""


_TOUCHING = 1e-15
"""Distance of two surfaces, metres, and length of a vector that count as zero."""

_EVEN = even_disk(_NODES)
PUPIL = np.concatenate(
    [np.zeros((1, 2)), _NEAR * circle(4), _INSIDE * circle(_RIM), np.stack([_EVEN.x, _EVEN.y], axis=-1)]
)
"""Points of the stop, in units of its radius, through which ghosts are traced, (N, 2): the chief ray, 4 rays close to
it, the rim, and points of equal weight over the area."""


@dataclass(frozen=True)
class Ghost:
    """Ghost image of a far point by two reflections.

    Attributes
    ----------
    back, forward : str
        Surface that reflects the light back, and the surface before it that reflects it forward again.
    focus : float
        Distance along the light from the image plane to the focus of rays close to the chief ray, metres, positive
        behind the plane; infinite for a parallel beam.
    diameter : float
        Twice the largest distance of a ray from the chief ray on the image plane, metres, of the light that arrives.
    energy : float
        Light of the ghost over that of the image.
    irradiance : float
        Mean irradiance of the ghost over that of the image, whose diameter is that of its traced spot or its Airy
        disk, whichever is larger; a ghost that is smaller has the same diameter.
    """

    back: str
    forward: str
    focus: float
    diameter: float
    energy: float
    irradiance: float


def ghosts(
    camera: Camera, field: Field = (0.0, 0.0), detector: float = DETECTOR, coatings: Mapping[int, float] | None = None
) -> tuple[Ghost, ...]:
    """Trace all ghost images of a far point by two reflections at refracting surfaces or the detector.

    Parameters
    ----------
    camera : Camera
        Camera; one without lenses and windows has no ghosts.
    field : (float, float)
        Angles x and y of the far point, radians.
    detector : float
        Reflectance of the detector in the image plane; 0 excludes it.
    coatings : mapping of int to float, optional
        Index of a surface -> its reflectance; by default that of the bare surface by Fresnel's formulas.

    Returns
    -------
    tuple of Ghost
        Ghosts whose light arrives at the image plane, the largest irradiance first. Surfaces are ``s0``, ``s1``, ...
        and ``image``.

    Raises
    ------
    ValueError
        A reflectance is not from 0 to 1, a coating is not that of a refracting surface, or no ray of the field reaches
        the stop.

    Examples
    --------
    The faces of a window of thickness t and index n in a converging beam make a ghost 2 t / n before the image:

    >>> mirror = OpticalSurface(-4.0, -1.8, -1.0, "mirror", diameter=0.1)
    >>> window = [OpticalSurface(thickness=-0.006, material=1.5), OpticalSurface(thickness=-0.2)]
    >>> (ghost,) = ghosts(Camera([mirror, *window], wavelength=550e-9).refocused(), detector=0.0)
    >>> f"{1e3 * ghost.focus:.4f} mm, {ghost.energy:.2%}"
    '-8.0000 mm, 0.16%'
    """
    coated = {f"s{k}": share for k, share in (coatings or {}).items()}
    names = camera._assembly.sequences["image"]
    position, direction = launch_rays(camera, field, PUPIL)
    indices = np.array([1.0, *camera.indices])
    shares = {**coated, names[-1]: detector}
    return trace_ghosts(
        default_backend(), camera._assembly, names, indices, position, direction[0], camera.wavelength, shares
    )


def trace_ghosts(
    backend: Backend,
    assembly: Assembly,
    names: Sequence[str],
    indices: np.ndarray,
    position: np.ndarray,
    direction: np.ndarray,
    wavelength: float,
    reflectances: Mapping[str, float],
) -> tuple[Ghost, ...]:
    """Trace all ghosts of a parallel beam by two reflections in an assembly.

    Parameters
    ----------
    backend : Backend
        Backend of the trace.
    assembly : Assembly
        Optical elements.
    names : sequence of str
        Names of the K elements in the order in which light meets them, and of the image.
    indices : (K + 1,) ndarray
        Refractive indices before the first and after each element.
    position : (N, 3) ndarray
        Launch points of the rays through ``PUPIL``, metres.
    direction : (3,) ndarray
        Unit vector of the beam.
    wavelength : float
        Wavelength, metres.
    reflectances : mapping of str to float
        Element -> reflectance of its coating, and of the image, which has none by default; other refracting surfaces
        follow Fresnel's formulas.

    Returns
    -------
    tuple of Ghost
        Ghosts whose light arrives at the image plane, the largest irradiance first.

    Raises
    ------
    ValueError
        A reflectance is not from 0 to 1, or that of an element that does not refract.
    """
    bends = [k for k, name in enumerate(names[:-1]) if assembly.elements[name].interaction is Interaction.REFRACT]
    for name, share in reflectances.items():
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"the reflectance of {name} must be from 0 to 1, got {share}")
        if name not in [names[k] for k in (*bends, -1)]:
            raise ValueError(f"a reflectance is given for {name!r}, which is no refracting surface of the camera")
    if not bends:
        return ()
    tracer = _Tracer(backend, assembly, tuple(names), indices, position, direction, reflectances)
    count = len(names)
    ahead = [(k, 0, 1) for k in range(count)]
    image = tracer.beam(ahead)
    airy = 1.22 * wavelength / image.aperture
    spread = max(image.diameter, airy)
    last = [count - 1] if reflectances.get(names[-1]) else []
    out = []
    for forward, back in combinations([*bends, *last], 2):
        inside = [(k, 1, 0) for k in range(back - 1, forward, -1)]
        beam = tracer.beam([*ahead[:back], (back, 0, 0), *inside, (forward, 1, 1), *ahead[forward + 1 :]])
        energy = beam.light / image.light
        if energy > 0.0:
            irradiance = energy * (spread / max(beam.diameter, spread)) ** 2
            out.append(Ghost(names[back], names[forward], beam.focus, beam.diameter, energy, irradiance))
    return tuple(sorted(out, key=lambda ghost: -ghost.irradiance))


@dataclass(frozen=True)
class _Beam:
    """Beam at the image plane: paraxial focus, diameter and numerical aperture of its rays, and share of the light."""

    focus: float
    diameter: float
    aperture: float
    light: float


@dataclass(frozen=True, eq=False)
class _Tracer:
    """Trace of the same rays along several paths; the attributes are the arguments of ``trace_ghosts``.

    The steps of a path are triples: index of an element, and the side, 0 in front of it and 1 behind it in the order of
    the light, on which light arrives and leaves. Equal sides are a ghost's reflection.
    """

    backend: Backend
    assembly: Assembly
    names: tuple[str, ...]
    indices: np.ndarray
    position: np.ndarray
    direction: np.ndarray
    reflectances: Mapping[str, float]

    @property
    def media(self) -> np.ndarray:
        """Refractive indices before the first element, and after each element and the image, (K + 2,)."""
        return np.append(self.indices, self.indices[-1])

    def beam(self, steps: Sequence[tuple[int, int, int]]) -> _Beam:
        """Trace the beam along a path to the image plane."""
        elements = [self.assembly.elements[name] for name in self.names]
        chain = []
        for number, (k, before, after) in enumerate(steps):
            how = Interaction.REFLECT if before == after else elements[k].interaction
            index = float(self.media[k + after])
            chain.append(
                replace(elements[k], name=str(number), interaction=how, aperture=None, solid=None, index_after=index)
            )
        path = Assembly(self.assembly.tree, {element.name: element for element in chain}, {})
        system = assemble(path, [tuple(path.elements)])
        rays = make_rays(self.backend, self.position, self.direction)
        traced = trace(self.backend, system, rays, keep=range(len(chain)))
        _, leaving, _, valid = (array[0] for array in traced.numpy())
        hits = [traced.hit(number)[0] for number in range(len(chain))]
        for (k, _, _), hit in zip(steps, hits, strict=True):
            valid = valid & elements[k].clear(hit[:, 0], hit[:, 1])
        light = valid * self._share(chain, steps, hits)
        xy, slope = hits[-1][:, :2], leaving[:, :2] / np.abs(leaving[:, 2:])
        away, tilt = xy - xy[0], slope - slope[0]
        near, rim, arrived = slice(1, 5), slice(5, 5 + _RIM), away[5:][valid[5:]]
        with np.errstate(divide="ignore", invalid="ignore"):
            focus = -np.sum(away[near] * tilt[near]) / np.sum(tilt[near] ** 2)
        return _Beam(
            float(focus),
            2.0 * float(np.max(np.linalg.norm(arrived, axis=-1), initial=0.0)),
            float(np.max(np.linalg.norm((leaving - leaving[0])[rim, :2], axis=-1))),
            float(np.mean(light[-_NODES:])),
        )

    def _share(
        self, chain: Sequence[Element], steps: Sequence[tuple[int, int, int]], hits: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return the share of each ray's light that takes the path at its refracting surfaces, (N,)."""
        acting = [n for n, element in enumerate(chain) if element.interaction is not Interaction.PASS]
        points = [self.assembly.nominal_pose(chain[n].body).apply(hits[n]) for n in (*acting, len(chain) - 1)]
        gaps = np.diff(points, axis=0)
        along = [self.direction, *(gaps / np.maximum(np.linalg.norm(gaps, axis=-1, keepdims=True), _TOUCHING))]
        media, light = self.media, np.ones(len(points[0]))
        for n, arriving, leaving in zip(acting, along, along[1:], strict=False):
            k, before, after = steps[n]
            reflects = before == after
            if not reflects and chain[n].interaction is Interaction.REFLECT:  # a mirror
                continue
            # the vector form of Snell's law, and of reflection, has the normal
            normal = media[k + after] * leaving - media[k + before] * arriving
            size = np.linalg.norm(normal, axis=-1)
            cosine = np.abs(np.sum(normal * arriving, axis=-1)) / np.maximum(size, _TOUCHING)
            cosine = np.where(np.any(arriving, axis=-1), cosine, 1.0)  # surfaces that touch
            shares = reflectance(cosine, media[k + before], media[k + 1 - before])
            shares = self.reflectances.get(self.names[k], shares)
            light = light * (shares if reflects else 1.0 - shares)
        return light
