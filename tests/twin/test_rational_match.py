"""Tie points between images with rational polynomials: simulated images of a terrain whose every position is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from rasterio.io import MemoryFile
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, map_coordinates

from analysis.matching.matches import EXPLAINED, consensus
from scenes.specs.orbit.rational import SurfaceSpec
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.csv_table import read_table
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.rational_bench import HALF, LOOKS, PLACE, polynomial
from twin.framework.data_files import FrameFacts, tiff
from twin.framework.procedure import BenchError
from twin.orbit.block.rational_block import IMAGE_POINTS
from twin.orbit.export.rational_polynomial import PolynomialImage
from twin.orbit.flight.earth import Earth
from twin.orbit.images.simulate_run import MATCHED
from twin.orbit.matching.surface import Surface, _displacements, _frame, _fused, _ranges, _side, _View, surface

MATCH, ADJUST = PROCEDURES["orbit match"], PROCEDURES["orbit adjust"]
SIDE = 360
FIRST = HALF - 0.5 * (SIDE - 1.0)
"""First line and sample of the crop in the image of the polynomials."""
SHIFTS = {"first": (1.3, -2.2), "second": (-0.7, 0.4), "third": (2.1, 1.6)}
"""Errors of the polynomials, measured less predicted, px."""
TEXTURE = 2048
GRID = SurfaceSpec.model_validate({"spacing": "0.5 m"})


def terrain(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """Heights above the mean, metres: hills of 30 m."""
    return 15.0 * np.sin(north / 60.0) * np.cos(east / 45.0) + 0.1 * north


def metres(latitude: np.ndarray, longitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (latitude - PLACE[0]) * 111_100.0, (longitude - PLACE[1]) * 111_300.0 * np.cos(np.radians(PLACE[0]))


class Landscape:
    """Images of the terrain, and where each sees what."""

    def __init__(self) -> None:
        rng = np.random.default_rng(12)
        rough = gaussian_filter(rng.standard_normal((TEXTURE, TEXTURE)), 1.6)
        self.texture = rough / rough.std() + gaussian_filter(rng.standard_normal(rough.shape), 8.0) * 20.0
        self.images = {}
        for name, look in LOOKS.items():
            whole = polynomial(look)
            offset = whole.offset - np.array([FIRST, FIRST, 0.0, 0.0, 0.0])
            self.images[name] = PolynomialImage.of(replace(whole, offset=offset), (SIDE, SIDE))

    def ground(self, name: str, position: np.ndarray) -> np.ndarray:
        """Latitude, longitude, height (n, 3) of the terrain at true positions (n, 2) of an image."""
        height = np.full(len(position), 400.0)
        for _ in range(10):  # each leaves a tenth: slopes of 0.4 under looks of a quarter
            at = (position - SHIFTS[name]).T
            latitude, longitude = self.images[name].polynomial.ground(*at, height)
            height = 400.0 + terrain(*metres(latitude, longitude))
        return np.column_stack([latitude, longitude, height])

    def seen(self, name: str, ground: np.ndarray) -> np.ndarray:
        """True positions (n, 2) of ground points in an image."""
        return np.column_stack(self.images[name].polynomial.image(*ground.T)) + SHIFTS[name]

    def picture(self, name: str) -> np.ndarray:
        few, every = np.linspace(0.0, SIDE - 1.0, 61), np.arange(SIDE)  # splines between them are right to 1e-6 m
        grid = np.stack(np.meshgrid(few, few, indexing="ij"), axis=-1).reshape(-1, 2)
        north, east = (
            RectBivariateSpline(few, few, one.reshape(61, 61))(every, every).ravel()
            for one in metres(*self.ground(name, grid).T[:2])
        )
        places = np.stack([north, east]) / 0.4 + 0.5 * TEXTURE
        grey = map_coordinates(self.texture, places, order=3, mode="wrap").reshape(SIDE, SIDE)
        noise = np.random.default_rng(len(name)).standard_normal(grey.shape)
        return np.clip(2000.0 + 300.0 * grey + 10.0 * noise, 0.0, 65535.0).astype(np.uint16)


@pytest.fixture(scope="module")
def landscape() -> Landscape:
    return Landscape()


@pytest.fixture(scope="module")
def folder(landscape: Landscape, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for name, image in landscape.images.items():
        facts = FrameFacts(georeference=image.polynomial)
        (folder / f"{name}.tif").write_bytes(tiff(landscape.picture(name)[None], facts))
    return folder


def run(procedure: Any, folder: Path, **keys: Any) -> Any:
    file = folder / "file.yaml"
    images = {name: {"file": f"{name}.tif"} for name in LOOKS}
    file.write_text(dump_yaml({"name": "hills", "images": images, **keys}))
    return procedure.run(procedure.resolve(file), None, 0, lambda *_: None)


@pytest.fixture(scope="module")
def found(folder: Path) -> Any:
    made = run(MATCH, folder, heights=["300 m", "500 m"], points={"tie": 60, "search_radius": 8})
    (folder / "ties.csv").write_text(MATCH.export(made)["image_points.csv"])
    return made


@pytest.mark.second
def test_matches_lie_where_the_terrain_is_seen(landscape: Landscape, found: Any) -> None:
    wrong, squares = [], []
    for source, points in found.points.items():
        ground = landscape.ground(source, points.lines[source].position)
        for name, line in points.searched_lines.items():
            assert line.accepted.mean() > 0.4, (source, name)
            # at the matched height the prediction lies beside the match, by the shifts across the epipolar line
            assert np.max(np.abs(line.position - line.predicted)[line.accepted]) < 5.0, (source, name)
            miss = (line.position - landscape.seen(name, ground))[line.accepted]
            wrong.append(np.abs(miss).max())
            spread = line.covariance[line.accepted]
            squares.append(np.einsum("ni,nij,nj->n", miss, np.linalg.inv(spread), miss))
    assert max(wrong) < 0.3
    assert np.median(np.concatenate(squares)) < 2.0 * 1.386  # the median of chi-square of two is 1.386


@pytest.mark.second
def test_the_block_of_the_matches_has_the_heights_of_the_terrain(
    landscape: Landscape, folder: Path, found: Any
) -> None:
    block_run = run(ADJUST, folder, image_points="ties.csv", errors={"shift": [3.0, 3.0]})
    assert block_run.adjustment.p_value > 1e-3
    for image in block_run.images.values():
        assert image.rms_after.max() < 0.1 < 0.3 < image.rms_before.max()
    longitude, latitude, height = Earth().geodetic(block_run.adjustment.ground)
    # the three shifts in common move the block: plan by 1 m, heights as the priors let them
    truth = 400.0 + terrain(*metres(np.degrees(latitude), np.degrees(longitude)))
    off = (height - truth)[np.isfinite(height)]
    assert 1.4826 * np.median(np.abs(off - np.median(off))) < 0.3
    assert abs(np.median(off)) < 3.0 * 3.0 * 0.5 / 0.25  # three sigma of the shifts of a base of 0.25 at least


@pytest.mark.second
def test_heights_without_ground_are_refused(folder: Path) -> None:
    with pytest.raises(BenchError, match="no two images have common points at heights of 8000 to 8100 m") as error:
        run(MATCH, folder, heights=["8000 m", "8100 m"], points={"tie": 20})
    assert "this range probably does not contain it" in error.value.remedy


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"heights": ["500 m", "300 m"]}, "not a range of heights"),
        ({"heights": ["300 m", "500 m"], "points": {"template": 24}}, "odd"),
        ({"heights": ["300 m", "500 m"], "images": {"first": {"file": "first.tif"}}}, "a single image"),
        ({"heights": ["300 m", "500 m"], "images": {"a": {"rpc": "first.tif"}, "b": {"rpc": "first.tif"}}}, "no image"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    (tmp_path / "first.tif").write_bytes(b"")
    images = {"first": {"file": "first.tif"}, "second": {"file": "first.tif"}}
    (tmp_path / "file.yaml").write_text(dump_yaml({"name": "hills", "images": images, **keys}))
    with pytest.raises(InputError, match=words):
        MATCH.resolve(tmp_path / "file.yaml")


@pytest.mark.second
def test_the_table_is_what_adjust_reads(folder: Path, found: Any) -> None:
    table = read_table(folder / "ties.csv", IMAGE_POINTS)
    assert set(table["image"]) == set(LOOKS)
    assert len(table) == MATCH.numbers(found)["image_points"]
    assert f"{MATCH.numbers(found)['tie_points']} tie points" in MATCH.report(found).verdict


def test_a_scatter_that_the_covariances_explain_is_no_number(folder: Path, found: Any) -> None:
    line = next(iter(found.points.values())).searched_lines["second"]
    assert MATCHED(replace(line, scatter=EXPLAINED))["consensus_scatter_px"] is None
    assert MATCHED(replace(line, scatter=0.02))["consensus_scatter_px"] == 0.02
    rng = np.random.default_rng(3)
    place = rng.uniform(0.0, 900.0, (30, 2))
    agreed = consensus(place, place + 0.01 * rng.standard_normal((30, 2)), covariance=np.tile(np.eye(2), (30, 1, 1)))
    assert agreed.scatter == EXPLAINED
    assert "no scatter beyond their covariances" in agreed.text


def errors(grid: Surface, truth: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Heights of the exported grid minus the true ones at the middle of each cell, and their sigmas."""
    with MemoryFile(grid.tiff()) as file, file.open() as source:
        height, sigma = source.read()
        rows, columns = np.indices(height.shape)
        east, north = source.transform @ (columns + 0.5, rows + 0.5)
        to_degrees = pyproj.Transformer.from_crs(source.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(east, north)
    return height - 400.0 - truth(*metres(latitude, longitude)), sigma


def exact_frames(landscape: Landscape, *names: str) -> dict[str, tuple[np.ndarray, PolynomialImage]]:
    """Pictures with polynomials without errors."""
    frames = {}
    for name in names:
        polynomial_of = landscape.images[name].polynomial
        exact = replace(polynomial_of, offset=polynomial_of.offset + np.array([*SHIFTS[name], 0.0, 0.0, 0.0]))
        frames[name] = (landscape.picture(name).astype(np.float32), PolynomialImage.of(exact, (SIDE, SIDE)))
    return frames


@pytest.mark.second
@pytest.mark.parametrize("names", [("first", "second"), ("first", "second", "third")])
def test_the_surface_is_the_terrain(landscape: Landscape, names: tuple[str, ...]) -> None:
    """Images with exact polynomials: heights of a grid against the terrain's formula at the middle of each cell."""
    grid = surface(exact_frames(landscape, *names), (360.0, 440.0), GRID)
    wrong, sigma = errors(grid, terrain)
    seen = np.isfinite(wrong)
    assert grid.share == pytest.approx(seen.mean())
    assert grid.share > 0.84
    # a twentieth of a pixel of 0.5 m at a base of 0.3 is 0.08 m
    assert abs(np.median(wrong[seen])) < 0.08
    normalised = np.median(np.abs(wrong[seen] / sigma[seen])) * 1.4826
    # the stated 0.25 px is for rough scenes; here the matches are better, and no sigma is too small
    assert 0.2 < normalised < 1.0
    # windows that reach beyond an image gave 1.4 and 1.6 %
    assert np.mean(np.abs(wrong[seen]) > 4.0 * sigma[seen]) < 1e-3
    assert (grid.scatter is None) == (len(names) == 2)
    if grid.scatter is not None:
        assert 0.2 < grid.scatter < 1.0
        # three images are better than two, and slopes are smeared alike in all pairs
        assert np.nanmedian(grid.sigma) < 0.75 * min(grid.sigmas["first", "second"], grid.sigmas["second", "third"])


def terraces(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """Heights above the mean, metres: a quarry with faces of 9 m, about 70 degrees steep."""
    step = (0.12 * north + 4.0 * np.sin(east / 40.0 + 2.0) + 3.0 * np.sin(north / 25.0)) / 9.0
    return 9.0 * (np.floor(step) + np.clip((step - np.floor(step) - 0.4) / 0.05, 0.0, 1.0))


def terraced(image: PolynomialImage, seed: int) -> np.ndarray:
    """The picture of the terraces: the highest ground on each line of sight, found in steps of 2 m and halves."""
    line, sample = np.indices((SIDE, SIDE)).reshape(2, -1).astype(float)
    top, bottom = (np.array(metres(*image.polynomial.ground(line, sample, h))) for h in (440.0, 360.0))

    def above(height: np.ndarray) -> np.ndarray:
        return height - 400.0 - terraces(*(bottom + (top - bottom) * (height - 360.0) / 80.0))

    height = np.full(line.size, 440.0)
    for _ in range(40):
        height = np.where(above(height) > 0.0, height - 2.0, height)
    for step in 2.0 ** -np.arange(12):  # to half a millimetre
        height = np.where(above(height + step) > 0.0, height, height + step)
    place = (bottom + (top - bottom) * (height - 360.0) / 80.0) / 0.4 + 0.5 * TEXTURE
    rng = np.random.default_rng(31)
    rough, soft, shade = (gaussian_filter(rng.standard_normal((TEXTURE, TEXTURE)), s) for s in (1.2, 4.0, 40.0))
    # contrast differs by places, down to that of the noise
    texture = (rough / rough.std() + soft / soft.std()) * np.clip(0.55 + 0.5 * shade / shade.std(), 0.08, 1.5)
    grey = map_coordinates(texture, place, order=3, mode="wrap").reshape(SIDE, SIDE)
    return 2000.0 + 200.0 * grey + 10.0 * np.random.default_rng(seed).standard_normal(grey.shape)


@pytest.mark.second
def test_sigmas_hold_at_steps_and_in_weak_texture(landscape: Landscape, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another scene than those on which the marks of mismatches were chosen, in one tile and in many."""
    frames = {name: (terraced(image, k), image) for k, (name, image) in enumerate(landscape.images.items())}
    grid = surface(frames, (360.0, 440.0), GRID)
    wrong, sigma = errors(grid, terraces)
    seen = np.isfinite(wrong)
    assert grid.share > 0.85
    assert np.mean(np.abs(wrong[seen]) > 4.0 * sigma[seen]) < 3e-3
    # steps are smeared, and only they have large sigmas
    assert np.nanmedian(sigma) < 0.4 < 1.0 < np.nanpercentile(sigma, 97)
    monkeypatch.setattr("twin.orbit.matching.surface._TILE", 150)
    tiled = surface({name: frames[name] for name in ("second", "first")}, (360.0, 440.0), GRID)
    whole = grid.pairs["first", "second"]
    shape = [min(a, b) for a, b in zip(whole.shape, tiled.height.shape, strict=True)]
    # the middle image looks down and the other aslant: tiles reach as far as either sees
    inner = tiled.height[20 : shape[0] - 20, 20 : shape[1] - 20]
    assert np.isfinite(inner).mean() > 0.9


def test_tiles_fit_into_the_memory(landscape: Landscape, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables of all displacements of all pixels grow with tiles and with the range of heights."""
    frames = {name: (np.zeros((SIDE, SIDE)), landscape.images[name]) for name in ("first", "third")}
    monkeypatch.setenv("TWIN_MEMORY", "300 MB")
    with pytest.raises(BenchError, match=r"matching between -800 and 1600 m needs .* GB of memory") as error:
        surface(frames, (-800.0, 1600.0), GRID)
    assert error.value.key == ("heights",)
    views = [_View(*frame, "EPSG:32631") for frame in frames.values()]
    middle = views[0].ground(np.full(2, 0.5 * SIDE), 400.0)
    monkeypatch.setenv("TWIN_MEMORY", "20 GB")
    for spacing, heights in ((0.5, (380.0, 420.0)), (8.0, (380.0, 420.0)), (0.5, (-100.0, 900.0))):
        spec = SurfaceSpec.model_validate({"spacing": f"{spacing} m"})
        side = _side(views[0], views[1], np.stack([middle, middle]), heights, spec)
        assert (side == 800) == (spacing < 1.0 and heights[0] > 0.0)
        frame = _frame(views[0], views[1], middle, np.full(2, side * spacing), heights)
        assert 4.0 * frame.rows * frame.columns * 2.0 * frame.most < 4.5e9
        assert side * spacing > 60.0


def test_contradicting_pairs_have_no_height_and_shared_images_count_once() -> None:
    pairs = {
        ("a", "b"): [1.0, 1.0, np.nan, 5.0],
        ("a", "c"): [1.2, 1.2, np.nan, 9.0],
        ("b", "c"): [np.nan, 9.0, 2.0, 1.0],
    }
    grids = {pair: np.array([heights]) for pair, heights in pairs.items()}
    no_steps = {pair: np.zeros((1, 4)) for pair in grids}
    height, sigma = _fused(grids, dict.fromkeys(grids, 0.5), no_steps)
    assert np.allclose(height[0], [1.1, 1.1, 2.0, np.nan], equal_nan=True)
    # two independent parallaxes of three images: two or three pairs are worth two
    assert np.allclose(sigma[0, :3], [0.5 / 2**0.5, 0.5 / 2**0.5, 0.5])
    grids |= {("b", "c"): np.array([[1.1, 1.1, 1.1, 1.1]])}
    height, sigma = _fused(grids, dict.fromkeys(grids, 0.5), no_steps)
    assert sigma[0, 0] == pytest.approx(0.5 / 2**0.5)
    # all pairs smear a step alike
    height, sigma = _fused(grids, dict.fromkeys(grids, 0.5), {pair: np.full((1, 4), 1.2) for pair in grids})
    assert sigma[0, 0] == pytest.approx(np.hypot(0.5 / 2**0.5, 1.2))


def test_a_grid_of_another_system_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file.yaml"
    images = {name: {"file": "a.tif"} for name in ("first", "second")}
    for keys, words in (({"spacing": "0.5 m", "crs": "UTM 31"}, "crs"), ({"crs": "EPSG:32631"}, "spacing")):
        (tmp_path / "a.tif").write_bytes(b"")
        file.write_text(dump_yaml({"name": "a", "images": images, "heights": ["0 m", "9 m"], "surface": keys}))
        with pytest.raises(InputError, match=words):
            MATCH.resolve(file)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "EPSG:1"])
def test_a_grid_that_is_not_in_metres_is_refused(folder: Path, crs: str) -> None:
    """Degrees and feet would count as metres of `spacing`."""
    with pytest.raises(InputError, match=r"not metres|not a coordinate reference system"):
        run(MATCH, folder, heights=["360 m", "440 m"], surface={"spacing": "1 m", "crs": crs})


@pytest.mark.second
def test_the_command_exports_and_shows_the_surface(folder: Path) -> None:
    """These polynomials are wrong by pixels: the run says so, and what to do."""
    found = run(MATCH, folder, heights=["360 m", "440 m"], points={"tie": 30}, surface={"spacing": "1 m"})
    numbers = MATCH.numbers(found)["surface"]
    with MemoryFile(MATCH.export(found)["surface.tif"]) as file, file.open() as source:
        assert source.descriptions == ("height", "sigma")
        assert source.crs.to_string() == numbers["crs"] == "EPSG:32631"
        assert source.width * source.height == numbers["cells"]
    report = MATCH.report(found)
    assert "Surface" in [section.title for section in report.sections]
    assert any("correct them by `twin.orbit adjust` first" in text for text in report.warnings)


@pytest.mark.second
def test_displacements_of_a_photographed_scene() -> None:
    """Stereo pair with measured disparities of scikit-image (Middlebury 2014, motorcycle): a near
    scene, most of whose depth lies in steps; nothing is chosen on it."""
    left, right, truth = pytest.importorskip("skimage.data").stereo_motorcycle()
    first, second = (one[..., :3] @ [0.2125, 0.7154, 0.0721] for one in (left, right))
    found = _displacements(first, second, 72)
    seen = np.isfinite(found) & np.isfinite(truth)
    wrong, sigma = (found - truth)[seen], np.hypot(0.25, 0.25 * _ranges(found)[seen])
    assert seen.sum() > 0.8 * np.isfinite(truth).sum()
    # 0.21 px, where the default sigma is 0.25 px
    assert 1.4826 * np.median(np.abs(wrong - np.median(wrong))) < 0.25
    assert abs(np.median(wrong)) < 0.15
    # 3.0 % beyond four sigma: spokes, cables and bare walls, on which windows of 5 pixels see another depth
    assert np.mean(np.abs(wrong) > 4.0 * sigma) < 0.04
