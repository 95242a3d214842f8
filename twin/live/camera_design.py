"""Design of a camera on the live page: knobs of its prescription and of the field point, and the optics that follow.

A knob changes a number of the camera's file: a radius of curvature relatively, a conic constant, or the distance from a
surface to the next, which shifts all later surfaces along the parent axis. The changed camera is built as `python -m
twin.camera` builds a file with these numbers, so that its stop, its clear apertures and its frames follow the design.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optics.numerics import quadrature
from optics.numerics.array_math import PhysicalError
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from scenes.models.camera_design import sheets_by_path
from scenes.models.camera_model import IMAGE, CameraModel, derive_camera
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import InputError, Issue
from twin.camera.camera_optics import INSIDE, CameraOptics
from twin.camera.camera_results import Field, Spot
from twin.camera.layout_plot import BEFORE, begun, section_lines, section_rays
from twin.framework.artefact import rounded_down
from twin.live.knobs import Knob
from twin.monitor.image_quality import MOST_BLUR

DESIGN, FIELD = "design", "field"
"""First parts of the names of knobs: of the camera's prescription, and of the field point."""
RANGE_WAVES = 2.0
"""Change of the wavefront at the middle of the field at the end of a slider, waves rms, where the camera allows it."""
MAP_POINTS, FREQUENCIES, PIXELS = 49, 33, 80
"""Points of a wavefront map on each side, frequencies of an MTF, pixels of a point image on each side."""
PSF_HALF, MOST_PHASE, EVEN = 4.0, 250.0, 3000
"""Half width of a sharp point image in wavelengths over the numerical aperture, largest phase in radians between chief
ray and stop's edge in the picture of a wider one, and smallest number of rays of a vignetted stop.
"""
AIRY = 0.61
"""Radius of the Airy disk in wavelengths over the numerical aperture."""
BLURRED = f"image quality is computed up to {MOST_BLUR:g} waves rms"
"""Message where a camera is too far from sharp."""
DEGREE = math.pi / 180.0


class _Quantity(NamedTuple):
    """Number of a surface that has a knob.

    Attributes
    ----------
    unit : str
        Unit of the knob.
    step : float
        Change from which the range of the slider is computed.
    widest, limit : float
        Largest half range of a slider, and largest absolute value that may be typed.
    """

    unit: str
    step: float
    widest: float
    limit: float


QUANTITIES: Mapping[str, _Quantity] = {
    "radius": _Quantity("percent", 1e-4, 5.0, 50.0),
    "conic": _Quantity("", 1e-5, 1.0, 100.0),
    "thickness": _Quantity("mm", 1e-4, 50.0, 10_000.0),
}
"""Number of a surface -> its knob. A wavefront changes by 1e-3 waves or more with these steps, and linearly."""


@dataclass(frozen=True, eq=False)
class CameraDesign:
    """Camera whose prescription has knobs.

    Attributes
    ----------
    name : str
        Name of the camera in its instrument.
    reference : str
        Name of its prescription in the instrument's file.
    spec : CameraSpec
        The prescription as opened.
    knobs : Mapping[str, Knob]
        Name -> knob of the prescription or of the field point.
    """

    name: str
    reference: str
    spec: CameraSpec
    knobs: Mapping[str, Knob]

    @classmethod
    def of(cls, name: str, reference: str, spec: CameraSpec, backend: Backend) -> CameraDesign:
        """Return the design of a camera, with sliders whose ends change its wavefront by some waves.

        Parameters
        ----------
        name, reference : str
            Name of the camera in its instrument, and of its prescription.
        spec : CameraSpec
            The prescription.
        backend : Backend
            Backend that traces the rays.
        """
        knobs = {}
        for axis, half in zip("xy", (spec.field.x, spec.field.y), strict=True):
            end = float(f"{half / DEGREE:.12g}")
            knobs[f"{FIELD} {axis}"] = Knob(f"{FIELD} {axis}", FIELD, FIELD, axis, "deg", 0.0, end, end)
        nominal = _wavefront(spec, backend)
        for surface, mirror in spec.mirrors.items():
            for key, (unit, step, widest, limit) in QUANTITIES.items():
                if key != "thickness" and math.isinf(mirror.radius):
                    continue
                knob = f"{DESIGN}/{surface} {key}"
                change = np.sqrt(np.nanmean((_wavefront(changed_camera(spec, {knob: step}), backend) - nominal) ** 2))
                half_range = min(RANGE_WAVES * step / max(float(change), 1e-12), widest)
                extent = float(f"{rounded_down(half_range):.12g}") if math.isfinite(half_range) else 1.0
                knobs[knob] = Knob(knob, f"{DESIGN}/{surface}", DESIGN, key, unit, 0.0, extent, limit)
        return cls(name, reference, spec, FrozenMap(knobs))

    @property
    def nodes(self) -> tuple[str, ...]:
        """Paths of the page's tree under which the knobs are."""
        return (FIELD, DESIGN, *dict.fromkeys(knob.node for knob in self.knobs.values() if knob.kind == DESIGN))

    def field(self, values: Mapping[str, float]) -> Field:
        """Return the field point of knobs, as fractions of the half angles."""
        x, y = (values.get(f"{FIELD} {axis}", 0.0) / self.knobs[f"{FIELD} {axis}"].limit for axis in "xy")
        return x, y


def _wavefront(spec: CameraSpec, backend: Backend) -> np.ndarray:
    """Return the wavefront map of a camera at the middle of its field, waves; zero-dimensional NaN without light."""
    try:
        return CameraOptics.alone(spec, backend).wavefronts([(0.0, 0.0)], 33, 4, by_rays=True)[0].map
    except (InputError, PhysicalError, ValueError):
        return np.array(np.nan)


def changed_camera(spec: CameraSpec, values: Mapping[str, float]) -> CameraSpec:
    """Return the camera with the prescription that knobs set.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    values : Mapping[str, float]
        Knob of the prescription -> its value; the others are zero.

    Raises
    ------
    InputError
        A surface would pass the next.
    """
    places = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    names = [*spec.mirrors, IMAGE]
    mirrors, moved, heading = {}, 0.0, 1.0
    for k, (name, mirror) in enumerate(spec.mirrors.items()):
        radius, conic, longer = (values.get(f"{DESIGN}/{name} {key}", 0.0) for key in QUANTITIES)
        update = {"z": mirror.z + moved, "radius": mirror.radius * (1.0 + 0.01 * radius), "conic": mirror.conic + conic}
        mirrors[name] = mirror.model_copy(update=update)
        heading = heading if mirror.light else -heading
        gap = places[k + 1] - places[k]
        if longer and abs(gap) + 1e-3 * longer < 0.0:
            problem = f"{names[k + 1]} would be on the other side of {name}"
            raise InputError(Issue(problem, found=f"{longer:g} mm", allowed=f"{-1e3 * abs(gap):.6g} mm or more"))
        moved += math.copysign(1e-3 * longer, longer * (gap or heading))
    image = spec.image.model_copy(update={"z": spec.image.z + moved})
    # without the file that it came from, whose lines have other numbers
    return CameraSpec.model_construct(**{**dict(spec), "mirrors": FrozenMap(mirrors), "image": image})


def with_traced_focal_length(spec: CameraSpec, backend: Backend) -> CameraSpec:
    """Return the camera whose file states the traced focal length of its surfaces, in focus or not.

    Raises
    ------
    InputError
        Light does not reach the image, or has no focus.
    """
    traced = abs(derive_camera(spec, backend, check_stated=False).paraxial.focal_length)
    return CameraSpec.model_construct(**{**dict(spec), "focal_length": float(f"{traced:.6g}")})


def camera_text(spec: CameraSpec, original: CameraSpec, remark: str) -> str:
    """Return the text of a changed camera's file; data sheets beside the original file get their absolute path."""
    plain = spec.plain()
    bands = sheets_by_path(plain.get("bands") or {}, Path(original.source.file).parent)
    return spec.file_text(remark, **({"bands": bands} if bands else {}))


def optics_data(optics: CameraOptics, field: Field) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what the page draws of a camera's optics at a field point, and the images of wavefront and point image.

    Wavefront, spot and MTF are those of `twin.camera`; rays alone sample the light of a vignetted wavefront. Images are
    uint16 (1, n, n): of the wavefront 1 to 65535 from -``scale_waves`` to ``scale_waves`` and 0 without light, of the
    point image 65535 at the peak. A picture that cannot be computed has ``problem`` instead of its numbers.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state.
    field : Field
        Field point, as fractions of the half angles.

    Raises
    ------
    AimError, BeamMissedError, ValueError
        The light is lost.
    """
    wave = optics.wavefronts([field], MAP_POINTS, 4, by_rays=True)[0]
    spot = optics.spot(field)
    scale = float(np.nanmax(np.abs(wave.map)))
    shade = 1.0 + np.rint(32767.0 * (1.0 + wave.map / (scale or 1.0)))
    images = {"wavefront": np.nan_to_num(shade).astype(np.uint16)[None]}
    first = optics.model.first_order
    data: dict[str, Any] = {
        "field_deg": [angle / DEGREE for angle in wave.field_rad],
        "wavefront": {
            "rms_waves": wave.rms,
            "peak_to_valley_waves": wave.peak_to_valley,
            "scale_waves": scale,
            "wavelength_nm": 1e9 * wave.wavelength,
        },
        "spot": {
            "rms_um": 1e6 * spot.rms,
            "airy_um": 1e6 * spot.airy,
            "half_um": 1e6 * spot.half_width,
            "rays_um": _rounded(1e6 * (spot.rays - spot.centroid), 4),
        },
        "layout": {
            **_layout(optics.model, optics.path.backend, field),
            "focal_length_m": optics.model.line_principal_distance,
            "f_number": float(np.mean(np.abs(first.principal_distance))) / optics.model.entrance_pupil,
        },
    }
    if wave.rms > MOST_BLUR:
        return {**data, "mtf": {"problem": BLURRED}, "psf": {"problem": BLURRED}}, images
    try:
        mtf = optics.mtf(field, np.linspace(0.0, 2.0 * optics.nyquist, FREQUENCIES))
        along, across = mtf.at(mtf.nyquist)
        curves = {"values": _rounded(mtf.values, 5), "limit": _rounded(mtf.limit, 5)}
        frequency = _rounded(1e-3 * mtf.frequency, 4)
        data["mtf"] = {**curves, "frequency": frequency, "along": float(along), "across": float(across)}
    except (PhysicalError, ValueError) as error:
        data["mtf"] = {"problem": str(error)}
    try:
        half = image_width(spot)
        image = point_image(optics, field, spot, np.linspace(-half, half, PIXELS))
        data["psf"] = {"half_um": 1e6 * half, "strehl": wave.strehl}
        images["psf"] = np.rint(65535.0 * image / np.max(image)).astype(np.uint16)[None]
    except (PhysicalError, ValueError) as error:
        data["psf"] = {"problem": str(error)}
    return data, images


def _rounded(values: np.ndarray, decimals: int) -> Any:
    """Return an array as rounded lists, whose text is shorter."""
    return np.round(values, decimals).tolist()


def image_width(spot: Spot) -> float:
    """Return half the width of the picture of a point image, in metres: it contains the rays of the spot."""
    return max(PSF_HALF * spot.airy / AIRY, 1.3 * float(np.max(np.abs(spot.rays))))


def point_image(optics: CameraOptics, field: Field, spot: Spot, places: np.ndarray) -> np.ndarray:
    """Return the diffraction image of a point about its chief ray, (P, P), relative to the peak of a perfect image.

    It is the sum of the waves of rays, by Gauss' rule for a clear stop. Edges that vignette the light fall between
    rays, which costs some percent of the peak.

    Parameters
    ----------
    optics : CameraOptics
        Camera in its state.
    field : Field
        Field point.
    spot : Spot
        Spot there.
    places : (P,) ndarray
        Coordinates of the columns along the line and of the rows along the track, in metres.

    Raises
    ------
    ValueError
        The image is too wide for the sum.
    """
    half = float(np.max(np.abs(places)))
    phase = 2.0 * math.pi * AIRY * half / spot.airy
    if phase > MOST_PHASE:
        width = 2e6 * half
        raise ValueError(
            f"the light spreads over {width:.3g} \N{MICRO SIGN}m; the spot shows where, waves only a sharper image"
        )
    nodes = quadrature.disk_for(1.3 * phase)
    if optics.model.edges:
        nodes = quadrature.even_disk(max(EVEN, 2 * nodes.count))
    rays = optics.rays([field], INSIDE * np.concatenate([[[0.0, 0.0]], np.stack([nodes.x, nodes.y], axis=-1)]))
    wave_number = 2.0 * np.pi / optics.wavelength
    share = nodes.weight * rays.valid[0, 1:]
    tilt = rays.direction[0, 1:, 1::-1] - rays.direction[0, 0, 1::-1]
    wave, along, across = (
        np.exp(1j * (wave_number * path).astype(np.float32))
        for path in (optics.path_error(rays)[0, 1:], *(np.outer(places, tilt[:, k]) for k in (0, 1)))
    )
    amplitude = (across * (wave * share)) @ along.T / np.sum(share)
    return np.asarray(np.abs(amplitude) ** 2, float)


def _layout(model: CameraModel, backend: Backend, field: Field) -> dict[str, Any]:
    """Return surfaces and rays in the plane of symmetry, as points (z, y) in metres.

    The fields of the rays are both ends along the track and the field point; each has chief, lower and upper ray.
    """
    points = section_rays(model, backend, 1, [(0.0, -1.0), (0.0, 1.0), field])
    z = points[1:, ..., 2]
    drawn = begun(points, float(z.min() - BEFORE * np.ptp(z)))[..., [2, 1]]
    lines = section_lines(model, 1, 41).items()
    passes = {name for name, mirror in model.spec.mirrors.items() if mirror.light == "passes"}
    return {
        "surfaces": [
            {"name": name, "passes": name in passes, "points": _rounded(line[:, [2, 1]], 6)} for name, line in lines
        ],
        "rays": _rounded(np.moveaxis(drawn, 0, 2), 6),
    }
