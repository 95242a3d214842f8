"""Rendered images: places by the sensor's own inverse, grey values by hand, sharpness by a slanted edge."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import constants
from scipy.special import erf

from analysis.mtf.slanted_edge import slanted_edge_mtf
from optics.numerics.array_math import UnphysicalError
from scenes.specs.load import load_detector
from scenes.specs.orbit.scene import ControlSpec, GroundSpec, TerrainSpec
from scenes.specs.orbit.setup import load_three_line_camera
from tests.twin.pushbroom_bench import LINE_TIME, LINES, PLACE, Ground, lines, lost, optics, shaken
from twin.orbit.flight.line_camera import LineCamera
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.images import pushbroom
from twin.orbit.images.line_optics import ImageMotion, LineOptics, optics_of
from twin.orbit.images.patch import PatchError, fly_patch, window_of
from twin.orbit.images.pushbroom import (
    MARGIN,
    PushbroomScene,
    SteepTerrainError,
    Window,
    extent_of,
    look_map,
    render_patch,
    require_open,
)

FRAME = GroundFrame(*PLACE)
ROUGH = TerrainSpec.model_validate({"kind": "fractal", "relief": "80 m", "height": "600 m", "exponent": 2.0})
SIGMA = 2.5
"""Metres. A mark of half a pixel: the terrain's curvature under it (slopes change by 0.4 in 30 m, times 0.5 for the
look) moves its centroid by 0.5 x 0.4/30 x 0.5 x sigma^2 = 2 cm, 0.004 pixels, at most."""
SIDE = 320
REACH = MARGIN + 4


def rough() -> Terrain:
    return Terrain.fractal(ROUGH, 3000.0, np.random.SeedSequence(5))


def marks() -> tuple[np.ndarray, np.ndarray]:
    """Places of nine marks, so far apart that no point spread function reaches the next, metres."""
    random = np.random.default_rng(3)
    east, north = (v.ravel() for v in np.meshgrid([-330.0, 0.0, 330.0], [-330.0, 0.0, 330.0]))
    return east + random.uniform(-20.0, 20.0, 9), north + random.uniform(-20.0, 20.0, 9)


def spots(east: np.ndarray, north: np.ndarray) -> Ground:
    def formula(e, n):
        out = np.zeros(np.shape(e))
        for a, b in zip(east, north, strict=True):
            square = (e - a) ** 2 + (n - b) ** 2
            near = square < (8.0 * SIGMA) ** 2
            out[near] += np.exp(-0.5 * square[near] / SIGMA**2)
        return out

    return Ground(formula)


def photograph(name: str, terrain: Terrain, ground: Ground, side: int = SIDE, window: Window | None = None):
    one = lines()[name]
    height = float(terrain.height(np.zeros(1), np.zeros(1))[0])
    window = window or window_of(name, one.sensor, FRAME, height, (side, side))
    return render_patch(one.sensor, one.optics, PushbroomScene(FRAME, terrain, ground), window)


def centroid(image: np.ndarray, row: float, column: float) -> tuple[float, float]:
    """Of what lies within the reach of a point spread function from a place; it holds all of it."""
    r, c = round(row), round(column)
    part = image[r - REACH : r + REACH + 1, c - REACH : c + REACH + 1]
    assert part.shape == (2 * REACH + 1,) * 2
    place = np.arange(-REACH, REACH + 1)
    total = part.sum()
    return r + float(part.sum(axis=1) @ place / total), c + float(part.sum(axis=0) @ place / total)


@pytest.mark.second
@pytest.mark.parametrize("name", LINES)
def test_marks_lie_where_the_sensor_says(name: str) -> None:
    """Known places on rough terrain, all effects on, found in the noise-free image to 0.01 pixels."""
    terrain, (east, north) = rough(), marks()
    done = photograph(name, terrain, spots(east, north))
    points = FRAME.itrs(east, north, terrain.height(east, north))
    line, pixel = lines()[name].sensor.image(points)
    away = []
    for k in range(9):
        at = line[k] - done.window.first_line, pixel[k] - done.window.first_pixel
        found = centroid(done.photons, *at)
        away.append(np.subtract(found, at))
    assert done.error < 1e-3
    assert len(away) == 9
    assert np.abs(away).max() < 0.01
    # without the terrain the marks would lie elsewhere by many times that
    level = lines()[name].sensor.image(FRAME.itrs(east, north, 600.0))
    if name != "nadir":
        assert np.abs(level[0] - line).max() > 3.0


@pytest.mark.second
def test_grey_ground_has_the_grey_value_of_the_hand() -> None:
    """The Sun as a black body, Lambert's ground, pi/4 F^2, pixel, time, quantum efficiency and gain; quadrature and the
    finite point spread function agree to 1e-4, single precision to 1e-6."""
    name, reflectance = "nadir", 0.21
    done = photograph(name, Terrain.flat(300.0), Ground(lambda e, n: np.full(np.shape(e), reflectance)), 64)
    wavelength = np.linspace(510e-9, 690e-9, 2001)
    x = constants.h * constants.c / (wavelength * constants.k * 5772.0)
    photons = 2.0 * constants.c / wavelength**4 / np.expm1(x) * (6.957e8 / 1.495978707e11) ** 2
    radiance = np.trapezoid(photons, wavelength) * reflectance
    expected = radiance * np.pi / (4.0 * 36.0) * 0.75 * (6.5e-6) ** 2 * 0.7e-3
    assert done.photons == pytest.approx(np.full((64, 64), expected), rel=1e-4)
    # sunlight above the air is between 1.4 and 1.9 W/(m^2 nm) everywhere in the band
    energy = np.trapezoid(photons * constants.h * constants.c / wavelength, wavelength) * np.pi / 180.0
    assert 1.4 < energy < 1.9
    grey = lines()[name].optics.ccd.detector.expected_dn(done.photons, 0.7e-3)
    assert grey.mean() == pytest.approx(20.0 + 0.025 * (0.55 * expected + 14.0), rel=1e-4)


@pytest.mark.second
@pytest.mark.parametrize(("name", "direction"), [("nadir", "x"), ("nadir", "y"), ("forward", "x"), ("forward", "y")])
def test_an_edge_on_the_ground_has_the_mtf_of_the_optics(name: str, direction: str) -> None:
    """An edge of 1 m rms softness on level ground, measured from the image's pixels. 0.01: what a slanted edge of 80
    pixels without noise is good to, and tails that are cut at 24 pixels."""
    one, side, soft, height = lines()[name], 96, 1.0, 300.0
    window = window_of(name, one.sensor, FRAME, height, (side, side))
    line, pixel = window.middle
    ends = np.array([-1.0, 1.0])
    # the edge runs along the track (x) or along the line (y), tilted by 5.5 degrees in the image
    tilt = np.tan(np.radians(5.5))
    run = (ends, tilt * ends) if direction == "x" else (tilt * ends, ends)
    points = one.sensor.ground(line + 40.0 * run[0], pixel + 40.0 * run[1], height)
    (e0, e1), (n0, n1), _ = FRAME.local(points)
    long = np.hypot(e1 - e0, n1 - n0)
    normal = np.array([n1 - n0, -(e1 - e0)]) / long

    def formula(e, n):
        return 0.2 + 0.05 * erf(((e - e0) * normal[0] + (n - n0) * normal[1]) / (np.sqrt(2.0) * soft))

    done = photograph(name, Terrain.flat(height), Ground(formula), window=window)
    # marks of the image axes on the ground, to take the edge's own softness out
    edge = slanted_edge_mtf(np.ascontiguousarray(done.photons), frequency=np.linspace(0.0, 0.5, 26))
    assert edge.axis == direction
    assert np.degrees(abs(edge.angle)) == pytest.approx(5.5, abs=0.3)
    f = edge.frequency
    square = np.cos(edge.angle), np.sin(edge.angle)
    # normal of column = position + tan(angle) row is (cos, -sin) in (column, row)
    along, across = (square[0], -square[1]) if direction == "x" else (-square[1], square[0])
    axes = one.sensor.ground(line + np.array([0.0, 1.0, 0.0]), pixel + np.array([0.0, 0.0, 1.0]), height)
    east, north, _ = FRAME.local(axes)
    jacobian = np.array([[east[2] - east[0], east[1] - east[0]], [north[2] - north[0], north[1] - north[0]]])
    step = abs(float(normal @ jacobian @ np.array([along, across])))
    own = np.exp(-2.0 * (np.pi * soft * f / step) ** 2)
    expected = one.optics.transfer(f * along, f * across, done.motion) * own
    assert np.abs(edge.mtf - np.abs(expected)).max() < 0.01
    assert edge.mtf[-1] < 0.35


@pytest.mark.second
def test_what_stands_before_the_lens_takes_light_and_contrast() -> None:
    """A bar across the middle of the pupil: its area is known, and so is its transfer function along its length."""
    payload = load_three_line_camera("th1")
    bar = ((-1.5, -0.1), (1.5, -0.1), (1.5, 0.1), (-1.5, 0.1))
    image = payload.image_of("nadir").model_copy(update={"obstruction": (bar,)})
    sheet = load_detector("th1_line")
    free = optics()["nadir"]
    cut = LineOptics.from_specs(image, 12000, 6.5e-6, LINE_TIME, sheet)
    # pixels of a line of twice the pitch get four times the light
    wide = payload.lines["forward"].model_copy(update={"pitch": 13e-6})
    two = payload.model_copy(update={"lines": payload.lines | {"forward": wide}})
    both = optics_of(two, ("nadir", "forward"), LINE_TIME, {"th1_line": sheet})
    assert both["forward"].photons_per_reflectance == pytest.approx(4.0 * both["nadir"].photons_per_reflectance)
    # a strip of half width a of the unit disk: 2 (a sqrt(1 - a^2) + asin a)
    share = 2.0 * (0.1 * np.sqrt(0.99) + np.arcsin(0.1)) / np.pi
    assert cut.photons_per_reflectance / free.photons_per_reflectance == pytest.approx(1.0 - share, rel=2e-5)
    motion = ImageMotion(1.0, 0.0)
    zero, half = np.zeros(1), np.array([0.5])
    assert cut.transfer(zero, zero, motion)[0] == pytest.approx(1.0, abs=1e-4)
    along = np.abs(cut.transfer(half, zero, motion)) / np.abs(free.transfer(half, zero, motion))
    assert abs(along[0] - 1.0) > 0.005
    kernel = cut.kernel(2, 12, motion)
    assert kernel.sum() == pytest.approx(1.0)
    # an even shadow in an even pupil has an even image, and its centroid lies in the middle
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-5 * kernel.max())
    # one beside the middle has not, but its centroid still does
    beside = ((0.3, 0.3), (0.8, 0.3), (0.8, 0.6), (0.3, 0.6))
    image = image.model_copy(update={"obstruction": (beside,)})
    low = 1e-3 * np.ones(1)
    other = LineOptics.from_specs(image, 12000, 6.5e-6, LINE_TIME, sheet)
    assert np.iscomplexobj(other.transfer(half, zero, motion))
    for place in ((low, zero), (zero, low)):
        assert abs(np.angle(other.transfer(*place, motion)[0])) / (2.0 * np.pi * low[0]) < 1e-4  # pixels


def test_steep_terrain_is_refused() -> None:
    """The forward look lies 27 degrees off the vertical: slopes of 63 degrees hide ground, gentler ones do not."""
    one = lines()["forward"]
    east = 10.0 * np.arange(-100, 101)
    for slope, hidden in ((1.3, False), (2.3, True)):
        # a saw of slopes along the track, rounded by the spline
        north = np.abs((east + 1000.0) % 400.0 - 200.0)[:, None] * slope
        terrain = Terrain.through(600.0 + np.repeat(north, 201, axis=1), (10.0, 10.0), (-1000.0, -1000.0))
        window = window_of("forward", one.sensor, FRAME, 600.0, (60, 60))

        def looked(terrain: Terrain = terrain, window: Window = window) -> None:
            looks = look_map(one.sensor, FRAME, terrain, window)
            require_open(looks, extent_of(looks))

        if hidden:
            with pytest.raises(SteepTerrainError):
                looked()
        else:
            looked()


@pytest.mark.second
def test_looks_that_cannot_be_followed_are_refused() -> None:
    """A window at the image's end, looks past the Earth, an attitude that no node follows."""
    flat, inside = Terrain.flat(600.0), Window(40, 6000, 10, 10)
    for sensor, window, words in (
        (lines()["nadir"].sensor, Window(0, 0, 40, 40), "a line lies outside the image"),
        (lost(), Window(64_000, 6000, 40, 40), "a line of sight misses the Earth"),
        (shaken(), inside, "the attitude varies too fast"),
    ):
        with pytest.raises(ValueError, match=words):
            look_map(sensor, FRAME, flat, window)


@pytest.mark.second
@pytest.mark.parametrize(
    ("limit", "value", "words"),
    [
        ("_MOST_STEPS", 1, "looks and terrain do not meet within"),
        ("LARGEST_ERROR", 0.0, "terrain so rough that places"),
    ],
)
def test_places_that_are_not_found_well_are_no_image(limit: str, value: float, words: str, monkeypatch) -> None:
    """A limit is set that no slope can hold; what would be returned is where the search stands."""
    heights = 600.0 + 20.0 * np.sin(np.arange(201) / 9.0)[:, None] * np.ones(201)
    terrain, ground = Terrain.through(heights, (10.0, 10.0), (-1000.0, -1000.0)), Ground(lambda e, n: 0.3 + 0.0 * e)
    assert np.all(photograph("forward", terrain, ground, 40).photons > 0.0)
    monkeypatch.setattr(pushbroom, limit, value)
    with pytest.raises(UnphysicalError if limit == "LARGEST_ERROR" else SteepTerrainError, match=words):
        photograph("forward", terrain, ground, 40)


HILLS = TerrainSpec.model_validate({"kind": "fractal", "relief": "60 m", "height": "600 m", "exponent": 2.3})
GROUND = GroundSpec(terrain=HILLS)


def test_what_cannot_be_imaged() -> None:
    spec, control, seed = GROUND, ControlSpec(), np.random.SeedSequence(1)
    cases = [
        ((PLACE[0] + 0.02, PLACE[1]), (60, 60), "place"),
        ((PLACE[0], PLACE[1] + 0.12), (60, 60), "span"),
        (PLACE, (60, 11990), "size"),
        (PLACE, (12_000, 60), "size"),
    ]
    for place, size, part in cases:
        with pytest.raises(PatchError) as caught:
            fly_patch(lines(), place, size, spec, control, seed)
        assert caught.value.part == part, str(caught.value)


@pytest.mark.second
def test_light_falls_off_along_the_line_by_the_fourth_power_of_the_cosine() -> None:
    """Even ground at the end of a line of 8 degrees to each side against its middle, noise-free: cos^4 of the field
    angle of a lens without distortion. The point spread function's cut and single precision leave 1e-5.
    """
    one, pixels = lines()["nadir"], 12000
    tangent = np.tan(np.radians(8.0))
    camera = LineCamera("wide", pixels, np.array([[0.0, 0.0, 1.0], [0.0, -tangent, 0.0]]), np.zeros((1, 3)))
    sensor = replace(one.sensor, camera=camera)
    scene = PushbroomScene(FRAME, Terrain.flat(600.0), Ground(lambda e, n: np.full(np.shape(e), 0.3)))
    line = window_of("nadir", one.sensor, FRAME, 600.0, (40, 40)).first_line
    light = [render_patch(sensor, one.optics, scene, Window(line, k, 40, 40)).photons.mean(axis=0) for k in (30, 5980)]
    angle = np.arctan(((30 + np.arange(40) + 0.5) * 2.0 / pixels - 1.0) * tangent)
    np.testing.assert_allclose(light[0] / light[1].mean(), np.cos(angle) ** 4, rtol=2e-5)
