"""Points measured in a user's images: the simulation's images and maps, through files alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.measurements import OrbitMatchSpec, with_absolute_files
from scenes.specs.orbit.setup import MatchSetup, SimulateSetup, load_three_line_camera
from tests.twin import orbit_file_bench as bench
from twin.orbit.images.simulate_run import Simulation, run_simulation
from twin.orbit.matching.match_run import Match, run_match


@pytest.fixture(scope="module")
def flown() -> Simulation:
    setup = SimulateSetup.read(SCENES / ORBIT / "simulate.yaml")
    patch = setup.test.patch.model_copy(update={"lines": 320, "pixels": 320})
    update = {"patch": patch, "points": None, "oversampling": 2}
    return run_simulation(setup.model_copy(update={"test": setup.test.model_copy(update=update)}), None, 3)


@pytest.fixture(scope="module")
def files(flown: Simulation, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("match")
    tifffile.imwrite(folder / "nan.tiff", np.full((40, 40), np.nan, np.float32))
    tifffile.imwrite(folder / "complex.tiff", np.zeros((40, 40), np.complex64))
    return folder, bench.match_files(folder, flown)


def matched(folder: Path, data: dict[str, Any]) -> Match:
    spec = with_absolute_files(OrbitMatchSpec.model_validate(data), folder)
    return run_match(MatchSetup.model_construct(test=spec, camera=load_three_line_camera("th1")), None, 0)


def errors(flown: Simulation, found: Match) -> dict[str, np.ndarray]:
    """Line -> (n, 2) of the control and check points against the exact sensor and the true ground, px."""
    ground, patch = found.measurements.ground, flown.patch
    east, north, _ = patch.frame.local(ground.itrs)
    away = patch.control.error(east, north)
    east, north = east - away[0], north - away[1]
    true = patch.frame.itrs(east, north, patch.terrain.height(east, north))
    out = {}
    for name, row in found.measurements.images.items():
        rows = row.taken(ground.role[row.point] != "tie")
        line, pixel = patch.images[name].sensor.image(true[rows.point])
        window = patch.images[name].window
        out[name] = np.stack([rows.line - (line - window.first_line), rows.pixel - pixel], axis=-1)
    return out


@pytest.mark.second
def test_points_in_files_are_where_the_true_sensor_has_them(flown: Simulation, files) -> None:
    """As in a simulated patch: 0.25 px with another season's light on 5 m pixels, and the covariance holds it."""
    found = matched(*files)
    for name, off in errors(flown, found).items():
        assert len(off) >= 15, name
        # the shift of the map moves all alike; what is left is the matching
        assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 0.25), name
        row = found.measurements.images[name]
        spread = row.taken(found.measurements.ground.role[row.point] != "tie").covariance
        square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
        assert np.median(square) < 5.0, name  # chi-square of two degrees of freedom has 1.4
    role = found.measurements.ground.role
    assert {*role} == {"control", "check", "tie"}
    assert np.all(np.isnan(found.measurements.ground.itrs[role == "tie"]))


@pytest.mark.second
def test_a_mirrored_image_and_a_window_change_nothing(flown: Simulation, files, tmp_path: Path) -> None:
    """Columns the other way round, said so: the same points to a hundredth of a pixel."""
    folder, data = files
    found = matched(folder, data)
    images = {}
    for name, image in flown.patch.images.items():
        window = image.window
        wide = np.zeros((window.lines + 30, window.pixels + 20), np.uint16)
        wide[10 : 10 + window.lines, 5 : 5 + window.pixels] = image.frame[:, ::-1]
        tifffile.imwrite(tmp_path / f"{name}.tiff", wide, compression="lzw")
        last = load_three_line_camera("th1").pixels_of(name) - window.first_pixel - window.pixels
        images[name] = {
            "file": str(tmp_path / f"{name}.tiff"),
            "first_line": 0,
            "first_pixel": last - 5,
            "first_pixel_sees": "left",
            "window": {"row": 10, "column": 5, "rows": window.lines, "columns": window.pixels},
        }
    # the table of times begins 10 lines before the window, so that its first line is the image's
    table = [row.split(",") for row in (folder / "lines.csv").read_text().splitlines()[1:]]
    table = [(name, int(k) and int(k) + 10, float(s) - (0.0 if int(k) else 7e-3)) for name, k, s in table]
    bench.csv(tmp_path / "lines.csv", ("camera", "line", "time [s]"), *zip(*table, strict=True))
    other = {**data, "images": images, "lines": {**data["lines"], "file": str(tmp_path / "lines.csv")}}
    again = matched(folder, other)
    for name, row in found.measurements.images.items():
        there = again.measurements.images[name]
        both = dict(zip(again.measurements.ground.ids[there.point], range(len(there.line)), strict=True))
        pairs = [(k, both[i]) for k, i in enumerate(found.measurements.ground.ids[row.point]) if i in both]
        assert len(pairs) > 20
        a, b = np.array(pairs).T
        np.testing.assert_allclose(there.pixel[b], row.pixel[a], rtol=0, atol=0.02)
        np.testing.assert_allclose(there.line[b] - 10.0, row.line[a], rtol=0, atol=0.02)
