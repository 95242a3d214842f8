"""Physical optics of cameras in plain functions: prescriptions, rays, wavefronts, diffraction images and materials.

Everything is in float64 and SI units: metres, radians, cycles per metre, kelvin. Errors are ``ValueError`` and say what
is allowed; an argument of a wrong kind is a ``TypeError``, too. The package knows nothing of YAML files, commands or
rendered scenes.

Camera
    Camera              a camera from the numbers of its surfaces, with focal length, F-number and pupils
    OpticalSurface      mirror, lens face or stop: radius, conic, thickness, material, diameters, figure, tilt
Rays
    launch_rays         rays of a far point, aimed at points of the stop
    trace               rays through all surfaces: TracedRays with positions, directions and optical paths
    spot_radius         rms radius of the geometrical spot
    distortion          distortion of chief rays
Wavefronts and images
    wavefront           Wavefront error, its rms, Zernike coefficients and Strehl ratio
    ray_fans            ray fans and OPD fans along two diameters of the stop
    psf                 point spread function by diffraction, of one wavelength or a band
    mtf                 modulation transfer function
    encircled_energy, ensquared_energy    energy of an image within circles or squares
    seidel              third-order aberrations by surface: Seidel and chromatic sums
    ghosts              ghost images by two reflections at lenses, windows and the detector
    mtf_from_psf        MTF of a sampled image
    airy, annular_mtf   diffraction limits of round pupils, with a central obscuration
Pupils
    zernike, annular_zernike       polynomials in Noll's order, over a disk and over a ring
    fit_zernikes        coefficients of sampled values
    noll_to_nm, zernike_name       orders and name of a Noll index
    pupil_quadrature    points and weights of Gauss' rule over a disk or a ring
Materials
    refractive_index    index of a named glass by wavelength and temperature, in air or vacuum
    glass               a glass with index, vacuum_index and dn_dt
    abbe_number, glass_names       dispersion of a glass; the names that are known
    fresnel             reflectance of an uncoated surface

Frame: z along the optical axis, light enters toward +z, the origin is the first vertex. A field is two angles (x, y):
its light travels along (tan x, tan y, 1). A radius is positive where the centre of curvature lies toward +z, and a
thickness is negative after one mirror. Images are arrays (row along y, column along x). Pupil coordinates are in units
of the stop's radius. A wavefront error is positive where the wavefront is ahead of the reference sphere.

Examples in docstrings run after ``import numpy as np`` and ``from optics import *``.

>>> mirror = OpticalSurface(radius=-4.0, conic=-1.0, thickness=-2.0, material="mirror", diameter=0.25)
>>> camera = Camera([mirror], wavelength=550e-9)
>>> camera.f_number
8.0
>>> error = wavefront(camera, field=(0.0, 2e-3))
>>> f"{error.rms / 550e-9:.3f} waves rms, Strehl {error.strehl:.2f}"
'0.053 waves rms, Strehl 0.90'

Names are imported when they are first used.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from optics.numerics.llvm import LibraryMissing, ensure_llvm

if TYPE_CHECKING:
    from optics.camera.ghosts import Ghost, ghosts
    from optics.camera.image_quality import (
        Fans,
        TracedRays,
        Wavefront,
        distortion,
        launch_rays,
        mtf,
        psf,
        ray_fans,
        spot_radius,
        trace,
        wavefront,
    )
    from optics.camera.prescription import Camera, OpticalSurface, SeidelSums, seidel
    from optics.geometry.zernike import annular_zernike, noll_to_nm, zernike
    from optics.geometry.zernike import fit as fit_zernikes
    from optics.geometry.zernike import name as zernike_name
    from optics.materials.fresnel_scatter import fresnel
    from optics.materials.glass import abbe_number, glass_names, refractive_index
    from optics.materials.glass import find_glass as glass
    from optics.numerics.quadrature import PupilNodes
    from optics.numerics.quadrature import disk as pupil_quadrature
    from optics.waves.diffraction import airy
    from optics.waves.imaging import annular_mtf, encircled_energy, ensquared_energy, mtf_from_psf

# Before anything can import drjit: it looks for LLVM once, and on many systems finds one that kills the process. What
# is missing is said by `load_backend`, where a command can tell its user, and not in the middle of an import.
with suppress(LibraryMissing):
    ensure_llvm()

__all__ = [
    "Camera",
    "Fans",
    "Ghost",
    "OpticalSurface",
    "PupilNodes",
    "SeidelSums",
    "TracedRays",
    "Wavefront",
    "abbe_number",
    "airy",
    "annular_mtf",
    "annular_zernike",
    "distortion",
    "encircled_energy",
    "ensquared_energy",
    "fit_zernikes",
    "fresnel",
    "ghosts",
    "glass",
    "glass_names",
    "launch_rays",
    "mtf",
    "mtf_from_psf",
    "noll_to_nm",
    "psf",
    "pupil_quadrature",
    "ray_fans",
    "refractive_index",
    "seidel",
    "spot_radius",
    "trace",
    "wavefront",
    "zernike",
    "zernike_name",
]

_MODULES = {
    "camera.prescription": ("Camera", "OpticalSurface", "SeidelSums", "seidel"),
    "camera.ghosts": ("Ghost", "ghosts"),
    "camera.image_quality": (
        *("Fans", "TracedRays", "Wavefront", "distortion", "launch_rays", "mtf", "psf", "ray_fans", "spot_radius"),
        *("trace", "wavefront"),
    ),
    "geometry.zernike": ("annular_zernike", "fit_zernikes", "noll_to_nm", "zernike", "zernike_name"),
    "materials.fresnel_scatter": ("fresnel",),
    "materials.glass": ("abbe_number", "glass", "glass_names", "refractive_index"),
    "numerics.quadrature": ("PupilNodes", "pupil_quadrature"),
    "waves.diffraction": ("airy",),
    "waves.imaging": ("annular_mtf", "encircled_energy", "ensquared_energy", "mtf_from_psf"),
}
"""Name of a module below ``optics`` -> the public names that are imported from it."""

_ALIASES = {"fit_zernikes": "fit", "zernike_name": "name", "pupil_quadrature": "disk", "glass": "find_glass"}
"""Public name of the package -> the name of the same function in its own module, where the two differ."""


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            from optics.numerics.arguments import public

            defined = getattr(importlib.import_module(f"{__name__}.{module}"), _ALIASES.get(name, name))
            value = globals()[name] = public(defined, __name__, name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
