"""Camera file of a first telescope design, with comments that say where its numbers come from."""

from __future__ import annotations

import numpy as np

from optics.camera.prescription import MIRROR, Camera
from optics.camera.telescope_types import TELESCOPES
from optics.camera.telescopes import first_design

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
        f"image: {{z: {1e3 * camera.vertices[-1]:.15g} mm}}",
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
    hole = _hole(camera, half, aperture) if len(camera.surfaces) == 2 else 0.0
    for k, surface in enumerate(camera.surfaces):
        behind = f"light: refracts, {'glass' if isinstance(surface.material, str) else 'index'}: {surface.material}"
        last = f"conic: {surface.conic:.12g}" if surface.material == MIRROR else behind
        out.append(
            f"  {_surface(camera, k)}: {{z: {1e3 * z[k]:.15g} mm, radius: {1e3 * surface.radius:.15g} mm, {last}"
            + (f", edges: [{{blocks: circle, radius: {1e3 * hole:.5g} mm}}]}}   # its hole" if hole and not k else "}")
        )
    return out


def _hole(camera: Camera, half: float, aperture: float) -> float:
    """Return the radius of the hole in the first of two mirrors that passes the beams of the field, metres.

    The chief ray of the field's corner meets the second mirror at the distance times the angle from the axis.
    """
    focal, (_, second, image) = camera.focal_length, camera.vertices
    share = -second / (image - second)
    corner = np.hypot(1.0, FIELD_RATIO) * np.tan(half)
    return float(MARGIN * (corner * ((1.0 - share) * -second + share * focal) + 0.5 * aperture * image / focal))
