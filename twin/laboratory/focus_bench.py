"""The bench of the focal-plane alignment: a collimator with a slanted edge, the camera, its line CCDs.

Frame of all numbers: the focal-plane frame of the camera as its prescription has it (X' flight direction, Y' along the
line, Z' along the light). The focal-plane assembly stands in it at a ``Pose``, and each band's chip at a height above
the assembly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar

from optics.geometry.pose import Pose
from optics.numerics.backend import Backend
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, CameraUnderTest, build_camera_under_test
from twin.framework.procedure import Advance, silent
from twin.sensors.line_ccd import LineCcd
from twin.targets.target_images import ALONG, DIRECTIONS, EdgeImager, EdgeOptics, knife_edge
from twin.targets.target_path import LocalMap, TargetPath

if TYPE_CHECKING:
    from scenes.specs.resolved import FocusSetup

_SEARCH = 0.3e-3
"""Defocus up to which best focus is looked for, metres."""


@dataclass(frozen=True, eq=False)
class Site:
    """One place of the focal plane where the edge is imaged.

    Attributes:
        band: whose line CCD.
        field: share of half the line.
        place: (X', Y') on the nominal focal plane, metres.
        point, direction: of the chief ray in the focal-plane frame, (3,), metres and unit.
        imagers: edge -> its images.
        defocus_per_shift: edge -> defocus of the image per metre of the target's move, as the edge's direction sees it:
            (f / collimator's f)^2 with the focal length in the direction of the edge's normal.
        nominal_per_shift: the same of the prescription, which the analysis may know.
        edge_focus: edge -> Z' at which its MTF at the Nyquist frequency is largest, metres.
    """

    band: str
    field: float
    place: np.ndarray
    point: np.ndarray
    direction: np.ndarray
    imagers: Mapping[str, EdgeImager]
    defocus_per_shift: Mapping[str, float]
    nominal_per_shift: Mapping[str, float]
    edge_focus: Mapping[str, float]

    @property
    def best(self) -> float:
        """Z' of best focus: midway between those of the two edges, which astigmatism moves apart, metres."""
        return float(np.mean([self.edge_focus[edge] for edge in DIRECTIONS]))

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the band, cycles/m."""
        return self.imagers[ALONG].ccd.band.nyquist

    def crossing(self, standing: Pose, height: float) -> np.ndarray:
        """Where the chief ray meets the chip, in the focal-plane frame, (3,), metres."""
        normal = standing.rotation[:, 2]
        chip = standing.translation + height * normal
        return np.asarray(self.point + self.direction * ((chip - self.point) @ normal) / (self.direction @ normal))

    def defocus(self, standing: Pose, height: float) -> float:
        """How far the chip stands downstream of best focus, metres."""
        return float(self.crossing(standing, height)[2] - self.best)

    def column(self, standing: Pose, height: float) -> int:
        """First column of the line on which the image of the edge lies in the middle."""
        imager = self.imagers[ALONG]
        along = standing.inverse().apply(self.crossing(standing, height))[1]
        middle = along / imager.ccd.band.pitch + 0.5 * (imager.ccd.band.pixels - 1)
        return int(np.clip(round(middle - 0.5 * imager.region), 0, imager.ccd.band.pixels - imager.region))

    def image(self, edge: str, standing: Pose, height: float, target_shift: float, offset: float) -> np.ndarray:
        """Share of the white signal in every pixel, for a target moved by ``target_shift`` and an edge ``offset``."""
        moved = self.crossing(standing, height)[2] - self.defocus_per_shift[edge] * target_shift
        return self.imagers[edge].image(float(moved), offset)


@dataclass(frozen=True, eq=False)
class BudgetLine:
    """What makes a band's MTF at its Nyquist frequency, in the middle of the field and at best focus.

    Attributes:
        band: name.
        edge: direction in which it is measured.
        factors: effect -> its transfer there.
        total: their product.
    """

    band: str
    edge: str
    factors: Mapping[str, float]
    total: float


class FocusBench:
    """Everything of the bench that does not change from one alignment to the next.

    Args:
        setup: the test with all it refers to.
        backend: where to trace.
        advance: told how many of how many tables are done.

    Raises:
        InputError: the camera cannot be built as the file says.
        AimError, BeamMissedError, ValueError: its beam is lost or vignetted.
    """

    def __init__(self, setup: FocusSetup, backend: Backend, advance: Advance = silent) -> None:
        test = setup.test
        self.setup = setup
        self.camera: CameraUnderTest = build_camera_under_test(test, setup.camera, backend)
        self.collimator = test.collimator.model
        self.path = TargetPath(self.camera.assembly, ROOT, ROOT, self.camera.model, backend, self.collimator)
        self.ccds = {
            name: LineCcd.from_specs(band, setup.detectors[band.detector]) for name, band in setup.camera.bands.items()
        }
        self.focal_length = float(self.camera.model.first_order.principal_distance[0])
        self.sites = self._build_sites(advance)

    def geometric_zero(self, band: str) -> float:
        """Defocus at which geometric blur takes all contrast at a band's Nyquist frequency, metres."""
        f_number = self.focal_length / self.setup.camera.entrance_pupil
        return 1.22 * f_number / self.ccds[band].band.nyquist

    def _build_sites(self, advance: Advance) -> tuple[Site, ...]:
        test, bands = self.setup.test, self.setup.camera.bands
        keys = [(name, field) for name in bands for field in test.fields]
        half = {n: 0.5 * (b.pixels - 2.0 * test.edge.region) * b.pitch for n, b in bands.items()}
        places = np.array([[field * half[name], bands[name].offset] for name, field in keys])
        directions = self.path.directions(places)
        hits = self.path.places(self.camera.as_built, directions)
        pupils = self.path.pupils(self.camera.as_built, directions, hits)
        sites = []
        for i, (name, field) in enumerate(keys):
            advance("tables of the optics", i, len(keys))
            sites.append(self._site(name, field, directions[i], hits[i], pupils[i]))
        advance("tables of the optics", len(keys), len(keys))
        return tuple(sites)

    def _site(self, band: str, field: float, direction: np.ndarray, hit: np.ndarray, pupil: PupilFunction) -> Site:
        test, ccd = self.setup.test, self.ccds[band]
        local = self.path.local_map(self.camera.as_built, direction, ccd.band.pitch * test.edge.region)
        nominal = self.path.local_map({}, direction, ccd.band.pitch * test.edge.region)
        imagers, ratio, nominal_ratio = {}, {}, {}
        for edge in DIRECTIONS:
            shape = knife_edge(edge, test.edge.angle)
            normal = shape.mapped(local).normal
            imagers[edge] = EdgeImager(EdgeOptics.build(pupil, ccd.band, normal), ccd, test.edge.region)
            ratio[edge] = _longitudinal(local, normal)
            nominal_ratio[edge] = _longitudinal(nominal, shape.mapped(nominal).normal)
        # the pupil's mean direction in (Y', X') is the chief ray's but for coma
        v, u = pupil.centre
        ray = np.array([u, v, np.sqrt(1.0 - u * u - v * v)])
        point = np.array([hit[1], hit[0], 0.0])
        focus = {edge: best_focus(imager, ccd.band.nyquist) for edge, imager in imagers.items()}
        return Site(band, field, point[:2], point, ray, imagers, ratio, nominal_ratio, focus)

    def budget(self) -> tuple[BudgetLine, ...]:
        """What makes each band's MTF at Nyquist in the middle of the field, along the line and along the track."""
        out = []
        for name, ccd in self.ccds.items():
            site = min((s for s in self.sites if s.band == name), key=lambda s: abs(s.field))
            place = site.place[None, ::-1]
            bare = TargetPath(self.camera.assembly, ROOT, ROOT, self.camera.model, self.path.backend)
            pupil = bare.pupils({}, bare.directions(place), place)[0]
            perfect = replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms))
            for edge, imager in site.imagers.items():
                f, normal = ccd.band.nyquist, imager.optics.normal
                x, y = f * normal
                designed = EdgeImager(EdgeOptics.build(pupil, ccd.band, normal, _SEARCH), ccd, imager.region)
                diffraction = _modulus(EdgeOptics.build(perfect, ccd.band, normal, _SEARCH), 0.0, f)
                design = _modulus(designed.optics, best_focus(designed, f), f)
                actual = _modulus(imager.optics, site.best, f)
                parts = {k: float(v) for k, v in ccd.factors(np.array(x), np.array(y)).items()}
                factors = {
                    "diffraction": diffraction,
                    "design": design / diffraction,
                    "wavefront": actual / design,
                    **parts,
                }
                out.append(BudgetLine(name, edge, factors, imager.mtf(site.best, f)))
        return tuple(out)


def _modulus(optics: EdgeOptics, defocus: float, frequency: float) -> float:
    return float(np.abs(optics.at(defocus, np.array([frequency])))[0])


def _longitudinal(local: LocalMap, normal: np.ndarray) -> float:
    """Longitudinal magnification in the direction of an edge's normal.

    A target moved by s adds s |p|^2 / 2F^2 to the path at p in the entrance pupil. By Lagrange's invariant p = F J^T u
    for direction cosines u at the image and the map's Jacobian J, so the image's curvature is s J J^T.
    """
    return float(np.sum((local.jacobian.T @ normal) ** 2))


def best_focus(imager: EdgeImager, frequency: float) -> float:
    """Defocus at which the MTF is largest, metres."""

    def loss(defocus: float) -> float:
        return -imager.mtf(defocus, frequency)

    coarse = np.linspace(-_SEARCH, _SEARCH, 41)
    start = int(np.argmin([loss(float(z)) for z in coarse]))
    low, high = coarse[max(start - 1, 0)], coarse[min(start + 1, len(coarse) - 1)]
    return float(minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": 1e-8}).x)
