"""Images and transfer functions: a far point through the perturbed gf7, closed forms, cut-offs, the table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import ConvexHull, HalfspaceIntersection

from optics.geometry import zernike
from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.assembly import Assembly
from optics.raytrace.system import assemble
from optics.raytrace.trace import BeamMissedError, make_rays, trace
from optics.waves import optical_transfer as transfer
from optics.waves.diffraction import Grid, PupilField, image
from optics.waves.imaging import aim_collimated, imaging_rays, pupil_field
from optics.waves.optical_transfer import TransferTable, polychromatic_transfer
from optics.waves.pupil_stack import PupilFunction, circular_pupil, fit_pupils
from optics.waves.pupil_terms import PupilEdge
from scenes.models.camera_model import IMAGE, field_direction
from tests.tiers import quick

ARCSEC = np.pi / 180 / 3600
WAVELENGTH = 650e-9
PERTURBED: State = {
    "M2": Motion(rotate=(20 * ARCSEC, -15 * ARCSEC, 0.0), shift=(20e-6, -30e-6, 15e-6)),
    "M3": Motion(rotate=(-5 * ARCSEC, 8 * ARCSEC, 0.0)),
}
FINE = quadrature.disk(16, 64)
AXIS = Grid(-15.5 * 3e-6, 3e-6, 32)


def huygens(
    points: np.ndarray,
    path: np.ndarray,
    direction: np.ndarray,
    amplitude: np.ndarray,
    wavelength: float,
    pixels: np.ndarray,
    normal: np.ndarray | None = None,
    chunk: int = 256,
) -> np.ndarray:
    """Irradiance by Huygens' sum of spherical wavelets from points on the exit wavefront; slow, the check of ``image``.

    Args:
        points: (N, 3) points on the exit reference sphere, metres.
        path: (N,) optical path at these points.
        direction: (N, 3) unit ray directions there.
        amplitude: (N,) area element times field amplitude at the points (m^2 * field).
        wavelength: metres.
        pixels: (M, 3) points where the irradiance is wanted.
        normal: (3,) unit normal of the detector: each wavelet counts with the root of the cosine of its incidence, so
            that the result is power per detector area, as in ``image``; None: square to the light.
        chunk: pixels done at once, to bound memory.

    Returns:
        (M,) irradiance, 1/m^2 for unit power (sum amplitude * field = 1).
    """
    k = 2.0 * np.pi / wavelength
    out = np.empty(len(pixels))
    for start in range(0, len(pixels), chunk):
        arm = pixels[start : start + chunk, None, :] - points[None]
        distance = np.linalg.norm(arm, axis=-1)
        obliquity = np.einsum("mnx,nx->mn", arm, direction) / distance
        if normal is not None:
            obliquity = obliquity * np.sqrt(np.abs(arm @ normal) / distance)
        phase = k * ((path - path[0]) + (distance - distance[:, :1]))
        field = np.sum(amplitude * obliquity / distance * np.exp(1j * phase), axis=1) / wavelength
        out[start : start + chunk] = np.abs(field) ** 2
    return out


class Camera:
    """The camera in its prescription frame, looking at one point of the field's edge."""

    def __init__(self, backend, gf7, state: State) -> None:
        self.backend, self.stop = backend, gf7.apertures["M2"]
        self.assembly: Assembly = gf7.bare_assembly()
        self.systems = assemble(self.assembly, ["imaging"], [state])
        self.to_stop = assemble(self.assembly, [gf7.mirrors[:2]], [state])
        self.direction = field_direction(gf7.spec, np.radians(1.0), np.radians(0.05))
        self.launch = -3.0 * self.direction
        self.frame = self.assembly.place([state]).pose(IMAGE)
        self.centre = trace(backend, self.systems, self.rays(np.zeros((1, 2)))[0]).numpy()[0][0, 0]

    def rays(self, target: np.ndarray):
        position, _ = aim_collimated(self.backend, self.to_stop, self.direction, self.launch, target)
        return make_rays(self.backend, position[0], self.direction), position[0]

    def field(self, nodes: PupilNodes, origin: np.ndarray | None = None) -> PupilField:
        origin = self.centre if origin is None else origin
        beam = self.systems, self.to_stop, self.direction, self.launch, self.stop, nodes
        return pupil_field(imaging_rays(self.backend, *beam), WAVELENGTH, origin)


def focal_plane_at(dz: float) -> State:
    return {**PERTURBED, IMAGE: Motion(shift=(0.0, 0.0, dz))}


@pytest.mark.second
@pytest.mark.parametrize("dz", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("where", ["behind M3", "exit pupil"])
def test_against_huygens(backend, gf7, dz: float, where: str) -> None:
    """Wavelets from points of the reference sphere, where the traced rays really cross it, with the ray tube's area.

    gf7's exit pupil lies 181 m behind its image (it is nearly telecentric): there the light has passed its focus and
    the sum runs back in time. The second sphere stands between M3 and the image, where Debye's plane waves are good to
    the order of 1 / Fresnel number, 1e-4.
    """
    camera = Camera(backend, gf7, focal_plane_at(dz))
    got = image(camera.field(FINE), AXIS, AXIS)[0]

    nodes = quadrature.disk(20, 72)
    rays, launch = camera.rays(camera.stop.radius * np.stack([nodes.x, nodes.y], axis=-1))
    traced = trace(backend, camera.systems, rays, world=True)
    assert traced.world is not None
    position, direction, path, valid = (a[0] for a in traced.numpy(traced.world))
    assert valid.all()
    focus = Camera(backend, gf7, PERTURBED).frame.apply(Camera(backend, gf7, PERTURBED).centre)
    radius = float(gf7.first_order.exit_pupil_distance[0]) if where == "exit pupil" else 1.9
    offset = position - focus
    along = np.sum(offset * direction, axis=-1)
    step = -along - np.sign(radius) * np.sqrt(along**2 - np.sum(offset**2, axis=-1) + radius**2)
    points = position + step[:, None] * direction
    np.testing.assert_allclose(np.linalg.norm(points - focus, axis=-1), abs(radius), rtol=1e-12)

    basis = zernike.basis(45, nodes.x, nodes.y)
    slopes = [zernike.gradient_basis(45, nodes.x, nodes.y, axis) for axis in (0, 1)]
    root = np.sqrt(nodes.weight)[:, None]

    def tube(surface: np.ndarray) -> np.ndarray:
        """Area on a surface of points (N, 3) per area of the stop's unit disk."""
        terms, *_ = np.linalg.lstsq(basis * root, surface * root, rcond=None)
        return np.linalg.norm(np.cross(slopes[0] @ terms, slopes[1] @ terms), axis=-1)

    entrance = tube(launch)
    amplitude = np.sqrt(tube(points - focus) * entrance / np.sum(entrance * nodes.weight)) * nodes.weight
    x, y = np.meshgrid(AXIS.points(), AXIS.points())
    pixels = camera.frame.apply(camera.centre + np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3))
    sense = np.sign(radius)
    normal = camera.frame.rotation[:, 2]
    want = huygens(points, sense * (path + step), sense * direction, amplitude, WAVELENGTH, pixels, normal)
    error = np.max(np.abs(got.ravel() - want)) / np.max(want)
    assert error < (2e-6 if where == "exit pupil" else 1e-4)
    assert np.max(want) * (3e-6) ** 2 > 0.03  # there is an image on these pixels
    assert np.sum(want) * (3e-6) ** 2 == pytest.approx(0.977, abs=0.005)


def test_a_blocked_beam_is_an_explained_error(backend, gf7) -> None:
    camera = Camera(backend, gf7, {"M3": Motion(shift=(2.0, 0.0, 0.0))})
    with pytest.raises(BeamMissedError, match="imaging path"):
        camera.field(FINE)


F_NUMBER = 9.2
NODES = quadrature.disk(12, 48)
FOCUS = np.zeros(1)
BAND = np.linspace(450e-9, 900e-9, 7)
DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [0.8, 0.6], [-0.6, 0.8]])


def perfect(ratio: np.ndarray) -> np.ndarray:
    """Diffraction transfer function of an evenly lit circle over frequency / cut-off."""
    v = np.minimum(ratio, 1.0)
    return 2.0 / np.pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v))


def circle(eikonal: np.ndarray | None = None, nodes: PupilNodes = NODES) -> PupilField:
    """Evenly lit circular pupil of F/9.2 with an eikonal at the nodes, metres."""
    aperture = 0.5 / F_NUMBER
    amplitude = nodes.weight * aperture / np.sqrt(np.pi)
    flat = np.zeros(nodes.count) if eikonal is None else eikonal
    return PupilField(aperture * nodes.x[None], aperture * nodes.y[None], flat[None], amplitude[None], WAVELENGTH)


def frequencies(pupil: PupilFunction, ratios: np.ndarray, wavelength: float = WAVELENGTH) -> np.ndarray:
    """Frequencies at ratios of the cut-off along ``DIRECTIONS``, (directions * ratios, 2)."""
    unit = DIRECTIONS * pupil.cutoff(DIRECTIONS, wavelength)[:, None]
    return (ratios[:, None] * unit[:, None]).reshape(-1, 2)


def random_frequencies(pupil: PupilFunction, count: int, wavelength: float, reach: float = 0.75) -> np.ndarray:
    most = np.max(pupil.cutoff(DIRECTIONS, wavelength))
    return np.random.default_rng(4).uniform(-reach, reach, (count, 2)) * most


@pytest.fixture(scope="module")
def traced(backend, gf7) -> PupilFunction:
    (pupil,) = fit_pupils(Camera(backend, gf7, PERTURBED).field(NODES), NODES)
    return pupil


@pytest.mark.parametrize("pupil", [circular_pupil(F_NUMBER), *fit_pupils(circle(), NODES)], ids=["ideal", "fitted"])
def test_perfect_circle(pupil: PupilFunction) -> None:
    ratio = np.array([0.0, 1e-9, 1e-6, 1e-4, 0.01, 0.1, 0.3, 0.5, 0.8, 0.95, 0.999, 0.999999, 1.0 + 1e-9, 1.1, 3.0])
    got = transfer.transfer(pupil, frequencies(pupil, ratio), WAVELENGTH, FOCUS)[0].reshape(4, -1)
    np.testing.assert_allclose(pupil.cutoff(DIRECTIONS, WAVELENGTH), 1.0 / (WAVELENGTH * F_NUMBER), rtol=1e-12)
    np.testing.assert_allclose(got, np.broadcast_to(perfect(ratio), got.shape), rtol=0, atol=1e-9)
    assert np.all(got[:, ratio > 1.0] == 0.0)


@pytest.mark.parametrize("waves", [0.25, 1.0, 3.0])
def test_defocused_circle_against_hopkins(waves: float) -> None:
    """Hopkins' single integral, by adaptive quadrature: W rho^2 over a circle, paper of 1955, before his eq. (20)."""
    (pupil,) = fit_pupils(circle(waves * WAVELENGTH * (NODES.x**2 + NODES.y**2)), NODES)
    ratio = np.array([0.02, 0.1, 0.25, 0.5, 0.75, 0.95])
    want = []
    for v in ratio:
        a = 8.0 * np.pi * waves * v
        edge = np.sqrt(1.0 - v * v)
        area = quad(lambda t, a=a, v=v: np.sin(a * (np.cos(t) - v)) * np.cos(t), 0.0, np.arcsin(edge), epsabs=1e-13)[0]
        want.append(4.0 / (np.pi * a) * area)
    got = transfer.transfer(pupil, frequencies(pupil, ratio), WAVELENGTH, FOCUS)[0].reshape(4, -1)
    np.testing.assert_allclose(got, np.broadcast_to(want, got.shape), rtol=0, atol=1e-8)
    assert np.max(np.abs(perfect(ratio) - want)) > 0.1  # the defocus is seen


@pytest.mark.second
@pytest.mark.parametrize("dz", [-300e-6, 0.0, 300e-6])
def test_against_the_transform_of_the_image(backend, gf7, traced: PupilFunction, dz: float) -> None:
    """The image on a moved detector, summed with the kernel, against the transfer function of the unmoved one.

    The far wings of an image fall only like 1/r^3 and cannot be had. So the image is multiplied by a Gaussian window
    that is 1e-9 at the grid's edge, and the transfer function convolved with the window's transform by Gauss-Hermite
    quadrature, which is as exact. The sum over the samples has no error: image and window are band-limited.
    """
    # light reaches the image along -z of the prescription: downstream is -z
    camera = Camera(backend, gf7, {**PERTURBED, IMAGE: Motion(shift=(0.0, 0.0, -dz))})
    width, step, n = 30e-6, 2.5e-6, 157
    axis = Grid(-0.5 * (n - 1) * step, step, n)
    fine = quadrature.disk_for(2.0 * np.pi * 0.055 * np.hypot(*2 * [0.5 * n * step]) / WAVELENGTH)
    origin = Camera(backend, gf7, PERTURBED).centre
    window = np.exp(-0.5 * (axis.points() / width) ** 2)
    light = image(camera.field(fine, origin), axis, axis)[0] * window[:, None] * window * step**2

    # far enough from zero, where the transfer function has a cusp, and from the cut-off, for Gauss' rule
    ratio = np.array([0.25, 0.4, 0.6, 0.8])
    f = frequencies(traced, ratio)
    x_wave, y_wave = (np.exp(-2j * np.pi * np.outer(f[:, i], axis.points())) for i in (0, 1))
    got = np.einsum("mr,rc,mc->m", y_wave, light, x_wave)

    node, weight = np.polynomial.hermite_e.hermegauss(10)
    weight = weight / np.sum(weight)
    near = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2) / (2.0 * np.pi * width)
    around = transfer.transfer(traced, (f[:, None] + near).reshape(-1, 2), WAVELENGTH, np.array([dz]))[0]
    want = around.reshape(len(f), -1) @ np.outer(weight, weight).ravel()
    # the window ends at 1e-9, each quadrature's error is about as large
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)
    assert np.max(np.abs(want)) > 0.15
    assert np.max(np.abs(np.angle(want))) > 0.05  # coma of the moved mirrors: the phase is checked as well


def test_symmetry_energy_and_shift(backend, gf7, traced: PupilFunction) -> None:
    f = random_frequencies(traced, 50, WAVELENGTH, 0.6)
    dz = np.array([-2e-4, 0.0, 5e-4])
    got = transfer.transfer(traced, f, WAVELENGTH, dz)
    np.testing.assert_allclose(transfer.transfer(traced, -f, WAVELENGTH, dz), np.conj(got), rtol=0, atol=1e-12)
    np.testing.assert_allclose(transfer.transfer(traced, np.zeros((1, 2)), WAVELENGTH, dz), 1.0, rtol=0, atol=1e-9)
    # the stop takes all of the beam: unit power, through the fit of the amplitude and its Jacobian
    assert traced.power == pytest.approx(1.0, abs=1e-9)

    x0, y0 = 35e-6, -20e-6
    field = Camera(backend, gf7, PERTURBED).field(NODES)
    (moved,) = fit_pupils(replace(field, eikonal=field.eikonal - x0 * field.u - y0 * field.v), NODES)
    want = got * np.exp(-2j * np.pi * f @ [x0, y0])
    np.testing.assert_allclose(transfer.transfer(moved, f, WAVELENGTH, dz), want, rtol=0, atol=1e-9)


def test_overlap_of_a_distorted_edge() -> None:
    """Area of the overlap against the intersection of polygons, for an edge as far from a circle as is allowed.

    A polygon of N corners on a circle lacks (2 pi / N)^2 / 6 of its area.
    """
    harmonics = np.zeros(11, complex)
    harmonics[5 + np.array([1, -2, 2, -3, 4])] = [1.0, 0.02 + 0.01j, -0.015j, 0.008, 0.002 - 0.003j]
    edge = PupilEdge(harmonics)
    angle = 2.0 * np.pi * np.arange(1200) / 1200
    corners = edge.boundary(angle)[0]
    planes = ConvexHull(np.stack([corners.real, corners.imag], axis=-1)).equations
    rule = np.polynomial.legendre.leggauss(24)
    sizes = np.array([0.01, 0.3, 1.0, 1.7, 1.9])
    shift = (sizes[:, None] * np.exp(1j * np.array([0.1, 1.5, 2.9, -2.0]))).ravel()
    right, left, inside = edge.corners(shift)
    assert inside.all()
    area = np.sum(edge.overlap(shift, right, left, rule, rule)[1], axis=-1)
    for s, got in zip(shift, area, strict=True):
        half = 0.5 * np.array([s.real, s.imag])
        both = np.concatenate([planes - [[0, 0, 1]] * (planes[:, :2] @ way)[:, None] for way in (half, -half)])
        want = ConvexHull(HalfspaceIntersection(both, np.zeros(2)).intersections).volume
        assert got == pytest.approx(want, rel=1e-4 if abs(s) > 1.6 else 1e-5)
    # copies that are farther apart than the longest chord: no overlap, and numbers that a factor of zero takes out
    way = np.array([0.1, 1.5, 2.9, -2.0])
    longest = edge.extent(way)[0] * np.exp(1j * way)
    for beyond in (1.0 + 1e-9, 1.05, 4.0):
        right, left, inside = edge.corners(beyond * longest)
        assert not inside.any()
        assert np.isfinite([right, left]).all()


@pytest.mark.parametrize("span", [0.1, 1.0, 3.0, 10.0, 30.0, 100.0])
def test_rule_for_the_nodes(span: float) -> None:
    node, weight = np.polynomial.legendre.leggauss(transfer.nodes_for(span, transfer.LEAST_ALONG))
    assert np.sum(weight * np.cos(span * node)) == pytest.approx(2.0 * np.sin(span) / span, abs=1e-8)


def test_polychromatic_mean(traced: PupilFunction) -> None:
    f = random_frequencies(traced, 30, 550e-9)
    dz = np.array([-1e-4, 2e-4])
    got = polychromatic_transfer(traced, f, np.array([500e-9, 600e-9]), np.array([1.0, 3.0]), dz)
    want = sum(w * transfer.transfer(traced, f, at, dz) for w, at in ((0.25, 500e-9), (0.75, 600e-9)))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)
    assert got.shape == (2, 30)


@pytest.mark.second
@pytest.mark.parametrize(("band", "dz"), quick(1, [(BAND, 0.0), (BAND, -1e-3), (BAND[:1], 3e-4)]))
def test_table(traced: PupilFunction, band: np.ndarray, dz: float) -> None:
    weights = np.linspace(1.0, 2.0, len(band))
    table = TransferTable.build(traced, band, weights, dz)
    f = random_frequencies(traced, 1800, band[0])
    f[:200] *= 1e-3
    f[0] = 0.0
    f[-150:] *= 2.0
    want = polychromatic_transfer(traced, f, band, weights, np.array([dz]))[0]
    got = table(f[:, 0].reshape(60, 30), f[:, 1].reshape(60, 30)).ravel()
    assert np.max(np.abs(got - want)) < 3e-6
    beyond = want == 0.0
    assert 100 < np.sum(beyond) < 600
    assert np.all(got[beyond] == 0.0)
    assert table(np.zeros(3), 1e4).shape == (3,)


def test_errors_say_what_is_wrong(backend, gf7, traced: PupilFunction) -> None:
    field = Camera(backend, gf7, {}).field(NODES)
    dark = field.amplitude.copy()
    dark[0, 5] = 0.0
    with pytest.raises(ValueError, match=r"0.2% of the pupil of image 0 carries no light"):
        fit_pupils(replace(field, amplitude=dark), NODES)
    few = quadrature.disk(4, 12)
    with pytest.raises(ValueError, match="48 nodes do not determine"):
        fit_pupils(circle(nodes=few), few, degree=10)
    ripple = 20e-9 * np.cos(12.0 * NODES.x)
    with pytest.raises(ValueError, match="too rough for a pupil"):
        fit_pupils(circle(ripple), NODES, degree=4)
    bent = circle()
    with pytest.raises(ValueError, match="too far from an ellipse"):
        fit_pupils(replace(bent, u=bent.u + 0.4 * bent.u * bent.v / np.max(bent.v)), NODES)
    f = np.zeros((1, 2))
    with pytest.raises(ValueError, match="frequency"):
        transfer.transfer(traced, np.zeros(2), WAVELENGTH, FOCUS)
    with pytest.raises(ValueError, match="finite"):
        transfer.transfer(traced, f, WAVELENGTH, np.array([np.nan]))
    with pytest.raises(ValueError, match="one weight"):
        polychromatic_transfer(traced, f, BAND, np.ones(3), FOCUS)
    with pytest.raises(ValueError, match="must be positive"):
        polychromatic_transfer(traced, f, BAND, np.zeros(7), FOCUS)
