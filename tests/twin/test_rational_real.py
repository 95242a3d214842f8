"""The measured triplet of Pleiades crops beside the surface model that another program made of it.

The images and the model are in tests/data of the repository centreborelli/s2p (images CNES), published with that
program; the model is no truth. No setting is chosen on them: the shift's prior is the location accuracy of Pleiades
that its user guide states (CE90 8.5 m: 4 m an axis, 8 px), and the range of heights is that of the site's map.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio

from analysis.block import block as model
from analysis.block.block_adjustment import intersected
from scenes.specs.orbit.rational import SurfaceSpec
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.yaml_file import dump_yaml
from twin.orbit.export.rational_polynomial import PolynomialImage, read_rpc
from twin.orbit.flight.earth import Earth
from twin.orbit.matching.surface import surface

REAL = Path(os.environ.get("TWIN_REAL") or Path(__file__).parents[3] / "shared/real") / "s2p_triplet"
NAMES = ("img_01", "img_02", "img_03")
pytestmark = [
    pytest.mark.second,
    pytest.mark.skipif(
        not REAL.is_dir(), reason="the measured triplet is not here: set TWIN_REAL to the folder that has s2p_triplet"
    ),
]


def run(kind: str, folder: Path, names: tuple[str, ...] = NAMES, **keys: Any) -> Any:
    """Run a command on some of the images with these keys in its file."""
    file = folder / f"{kind}.yaml"
    images = {name: {"file": str(REAL / f"{name}.tif")} for name in names}
    file.write_text(dump_yaml({"name": "triplet", "images": images, **keys}))
    procedure = PROCEDURES[f"orbit {kind}"]
    return procedure.run(procedure.resolve(file), None, 0, lambda *_: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tie points."""
    folder = tmp_path_factory.mktemp("triplet")
    found = run("match", folder, heights=["0 m", "500 m"])
    table = PROCEDURES["orbit match"].export(found)["image_points.csv"]
    (folder / "ties.csv").write_text(table)
    return folder


def adjusted(folder: Path, names: tuple[str, ...] = NAMES) -> Any:
    ties = (folder / "ties.csv").read_text().splitlines()
    (folder / "some.csv").write_text(
        "\n".join([ties[0], *(row for row in ties[1:] if row.split(",")[1] in names)]) + "\n"
    )
    return run("adjust", folder, names, image_points="some.csv", errors={"shift": [8.0, 8.0]})


def heights(block_run: Any) -> dict[str, tuple[float, float, float]]:
    """Longitude, latitude and height of every adjusted point by its name."""
    ground = block_run.adjustment.ground
    ids = block_run.adjustment.assembly.block.points.ids
    longitude, latitude, height = Earth().geodetic(ground)
    return {
        str(name): values
        for name, *values in zip(ids, np.degrees(longitude), np.degrees(latitude), height, strict=True)
        if np.isfinite(values[2])
    }


def beside_the_model(points: dict[str, tuple[float, float, float]]) -> np.ndarray:
    """Heights less those of the other program's surface model, at points where it has a value."""
    longitude, latitude, height = np.array(list(points.values())).T
    with rasterio.open(REAL / "expected_dsm.tif") as source:
        surface = source.read(1)
        to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True)
        columns, rows = ~source.transform * to_map.transform(longitude, latitude)
    at = np.floor(rows).astype(int), np.floor(columns).astype(int)
    inside = (at[0] >= 0) & (at[1] >= 0) & (at[0] < surface.shape[0]) & (at[1] < surface.shape[1])
    difference = height[inside] - surface[at[0][inside], at[1][inside]]
    return difference[np.isfinite(difference)]


def nmad(values: np.ndarray) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def test_another_program_projects_alike() -> None:
    """Numbers of rpcm 1.4.10 (centreborelli, PyPI) for two of the images: longitude 5.4435, latitude 43.2655, 300 m."""
    for name, column, row in (
        ("img_01", 353.15857589407824, -290.7593353113516),
        ("img_02", 351.68907431702246, -358.130328398267),
    ):
        line, sample = read_rpc(REAL / f"{name}.tif").image(43.2655, 5.4435, 300.0)
        assert abs(line - row) < 1e-6
        assert abs(sample - column) < 1e-6


def test_residuals_and_heights_of_three_images(folder: Path) -> None:
    block_run = adjusted(folder)
    for image in block_run.images.values():
        assert image.rms_after.max() < 0.1 < image.rms_before.max()
        assert np.all(np.abs(image.value) < 8.0)  # within one sigma of what CNES states
    difference = beside_the_model(heights(block_run))
    assert len(difference) > 100
    # the model's grid is 0.5 m; the pairs' heights scatter by some decimetres on roofs and trees
    assert nmad(difference) < 1.0


def test_the_surface_beside_the_other_program(folder: Path) -> None:
    """Corrected polynomials, and heights 30 m beyond those of the tie points."""
    block_run = adjusted(folder)
    known = np.array(list(heights(block_run).values()))[:, 2]
    frames = {}
    for name, image in block_run.images.items():
        with rasterio.open(REAL / f"{name}.tif") as source:
            frames[name] = source.read(1).astype(np.float32), PolynomialImage.of(image.polynomial, (1024, 1024))
    spec = SurfaceSpec.model_validate({"spacing": "0.5 m", "crs": "EPSG:32631"})
    grid = surface(frames, (float(known.min()) - 30.0, float(known.max()) + 30.0), spec)
    with rasterio.open(REAL / "expected_dsm.tif") as source:
        other = source.read(1)
        west, north = source.transform.c, source.transform.f
    row, column = round((grid.north - north) / 0.5), round((west - grid.west) / 0.5)
    region = slice(row, row + other.shape[0]), slice(column, column + other.shape[1])
    here, seen = grid.height[region], np.isfinite(grid.height[region] - other)
    difference = (here - other)[seen]
    assert len(difference) > 0.98 * np.isfinite(other).sum()
    # errors of both programs, at edges, too; without correction it is 1.0 m
    assert nmad(difference) < 0.6
    assert abs(np.median(difference)) < 3.0  # the images leave a common height of 25 m open
    apart = np.abs(difference - np.median(difference))
    # 0.06 %, where it was 0.6 % with the same sigma in flat places and at the faces of the quarry
    assert np.mean(apart > 4.0 * grid.sigma[region][seen]) < 1.5e-3
    assert np.mean(apart > 3.0) < 5e-3
    assert grid.scatter is not None
    assert 0.4 < grid.scatter < 1.2


def test_without_each_image(folder: Path) -> None:
    three = heights(adjusted(folder))
    for name in NAMES:
        two = heights(adjusted(folder, tuple(n for n in NAMES if n != name)))
        apart = np.array([two[point][2] - three[point][2] for point in two if point in three])
        difference = beside_the_model(two)
        assert nmad(apart) < 0.5
        assert nmad(difference) < 1.0


def test_heights_of_the_three_pairs_scatter_as_their_sigmas_say(folder: Path) -> None:
    """Heights of a point by each pair of corrected images differ by the errors of its image points alone."""
    block_run = adjusted(folder)
    block = block_run.adjustment.assembly.block
    corrected = {name: PolynomialImage.of(image.polynomial, (1024, 1024)) for name, image in block_run.images.items()}
    use = np.isfinite(block_run.adjustment.ground).all(axis=1)
    counts = np.zeros(len(use))
    for scene in block.model_scenes:
        np.add.at(counts, scene.rays.point, 1)
    which = np.flatnonzero(use & (counts == 3))
    by_pair, sigma = [], []
    for name in NAMES:
        scenes = tuple(
            replace(scene, model=corrected[scene.name], rays=scene.rays.taken(np.isin(scene.rays.point, which)))
            for scene in block.model_scenes
            if scene.name != name
        )
        pair = replace(
            block,
            scenes=scenes,
            points=model.Points(
                *(block.points.ids, block_run.adjustment.ground, block.points.role, block.points.covariance)
            ),
        )
        by_pair.append(Earth().geodetic(intersected(pair)[which])[2])
        normal = np.zeros((len(use), 3, 3))
        for scene in scenes:
            slope = scene.model.seen(pair.points.start[scene.rays.point])[1]
            np.add.at(normal, scene.rays.point, np.swapaxes(slope, 1, 2) @ np.linalg.inv(scene.rays.spread) @ slope)
        up = pair.points.start[which] / np.linalg.norm(pair.points.start[which], axis=1, keepdims=True)
        sigma.append(np.sqrt(np.einsum("ni,nij,nj->n", up, np.linalg.inv(normal[which]), up)))
    scatter = {}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        # two pairs share an image: their heights' difference is at most the sum of both errors
        scatter[a, b] = nmad(by_pair[a] - by_pair[b])
        stated = float(np.median(np.hypot(sigma[a], sigma[b])))
        assert scatter[a, b] < 1.5 * stated
