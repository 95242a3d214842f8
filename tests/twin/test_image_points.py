"""Points measured in rendered and in a user's images, against the exact sensor; the commands that use them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.stats import chi2

from analysis.orbit.three_line_model import BIAS
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.calibration import OrbitCalibrationSpec
from scenes.specs.orbit.measurements import OrbitMatchSpec, with_absolute_files
from scenes.specs.orbit.scene import ImagePointsSpec
from scenes.specs.orbit.setup import CalibrationSetup, MatchSetup, SimulateSetup, load_three_line_camera
from tests.twin import orbit_file_bench as bench
from twin.orbit.calibration.calibration_run import true_values
from twin.orbit.calibration.campaign import Campaign, FieldImages
from twin.orbit.calibration.campaign_adjustment import screen_campaign, simultaneous
from twin.orbit.calibration.flown_campaign import fly_fields
from twin.orbit.images import image_points
from twin.orbit.images.image_points import MatchedPoints, map_points, tie_points
from twin.orbit.images.patch import judged, true_ground
from twin.orbit.images.simulate_run import Simulation, run_simulation
from twin.orbit.matching import match_run
from twin.orbit.matching.match_run import Match, run_match

pytestmark = pytest.mark.second

SIMULATE, CALIBRATE = (SCENES / ORBIT / f"{name}.yaml" for name in ("simulate", "calibrate_images"))


@pytest.fixture(scope="module")
def flown() -> Simulation:
    setup = SimulateSetup.read(SIMULATE)
    patch = setup.test.patch.model_copy(update={"lines": 320, "pixels": 320})
    update = {"patch": patch, "points": None, "oversampling": 2}
    return run_simulation(setup.model_copy(update={"test": setup.test.model_copy(update=update)}), None, 3)


@pytest.fixture(scope="module")
def control(flown: Simulation) -> MatchedPoints:
    return map_points(flown.patch, asked().model_copy(update={"control": 60, "check": 20, "tie": 40}))


def asked() -> ImagePointsSpec:
    points = SimulateSetup.read(SIMULATE).test.points
    assert points is not None
    return points


def test_map_points_are_where_the_sensor_has_them(flown: Simulation, control: MatchedPoints) -> None:
    """0.2 px: another season's light on a 5 m pixel; the predicted places are 10 to 35 px off. None of some 60 accepted
    may be wrong: 3 px are twenty sigmas."""
    for name, found in judged(flown.patch, control).items():
        assert found.accepted >= 15
        assert np.all(found.rms < 0.2)
        assert np.all(np.abs(found.mean) < 5.0 * 0.2 / np.sqrt(found.accepted))
        assert found.wrong_accepted == 0
        # sigmas of matching are up to 1.6 too small, for light and changes are not in them
        assert 0.3 < found.chi_square / found.degrees_of_freedom < 2.56
        line = control.lines[name]
        moved = np.linalg.norm((line.position - line.predicted)[line.accepted], axis=1)
        assert moved.min() > 5.0
    share = control.check.mean()
    assert share == pytest.approx(0.25, abs=0.05)


def test_true_ground_is_the_map_less_its_errors(flown: Simulation, control: MatchedPoints) -> None:
    """Plan: 0.6 and -0.4 m and five times 0.5 m; height: five times 2 m, and slopes of 0.5 under 3 m."""
    east, north, height = flown.patch.frame.local(true_ground(flown.patch, control))
    for moved, shift in ((control.east - east, 0.6), (control.north - north, -0.4)):
        assert np.abs(moved - shift).max() < 2.5
        assert np.abs(moved).max() > 0.0
    assert 0.0 < np.abs(control.height - height).max() < 12.0


def test_what_is_not_known_of_heights_adds_its_variance(flown: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times the sigma of the reference's heights is nine times what it adds to a match's covariance; without it
    there are the match itself and the roughness."""
    agreed, seen = image_points.consensus, []
    matching, matches = image_points.match_windows, []
    monkeypatch.setattr(image_points, "consensus", lambda *a, **k: seen.append(k["covariance"]) or agreed(*a, **k))
    monkeypatch.setattr(image_points, "match_windows", lambda *a, **k: matches.append(matching(*a, **k)) or matches[-1])
    for sigma in (0.0, 1.0, 3.0):
        map_points(flown.patch, asked().model_copy(update={"control": 60, "check": 20, "height_sigma": sigma}))
    none, one, three = seen[:: len(flown.patch.images)]
    good = np.abs(none).max(axis=(1, 2)) < 1.0  # of the others nothing is known
    np.testing.assert_allclose((three - none)[good], 9.0 * (one - none)[good], rtol=0, atol=1e-12)
    assert (one - none)[good].max() > 1e-3
    alone = none - asked().roughness ** 2 * np.eye(2)
    np.testing.assert_allclose(alone[good], matches[0].covariance[good], rtol=0, atol=1e-12)


def test_tie_points_are_five_times_better(flown: Simulation, control: MatchedPoints) -> None:
    """The same ground on the same day: 0.05 px."""
    spec = asked().model_copy(update={"tie": 40})
    ties = tie_points(flown.patch, spec, control)
    assert ties.source == "nadir"
    assert ties.in_all.sum() >= 15
    for found in judged(flown.patch, ties).values():
        assert np.all(found.rms < 0.05)
        assert found.wrong_accepted == 0
    # without control the heights are read 100 m off, so that the prediction is worse, and still within reach
    alone = tie_points(flown.patch, spec)
    assert alone.in_all.sum() >= 10


def test_ground_without_points_is_refused(flown: Simulation) -> None:
    """A map of other ground, a map and an image of one grey value."""
    patch, maps = flown.patch, flown.patch.control
    photo, nadir = maps.orthophoto, flown.patch.images["nadir"]
    grey = FrozenMap({**patch.images, "nadir": replace(nadir, frame=np.zeros_like(nadir.frame))})
    for points, wrong, words in (
        (map_points, replace(patch, control=replace(maps, orthophoto=replace(photo, west=1e5))), "no point of the"),
        (
            map_points,
            replace(patch, control=replace(maps, orthophoto=replace(photo, values=np.zeros_like(photo.values)))),
            "the orthophoto has no distinct points",
        ),
        (tie_points, replace(patch, images=grey), "nadir: no distinct point is seen"),
    ):
        with pytest.raises(image_points.PointsError, match=words):
            points(wrong, asked())


def test_matches_that_agree_on_nothing_are_refused(flown: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    """Places all over the windows that are searched."""
    right, random = image_points.match_windows, np.random.default_rng(1)

    def wrong(*what: Any, **how: Any) -> Any:
        found = right(*what, **how)
        return replace(found, position=found.position + random.uniform(-20.0, 20.0, found.position.shape))

    monkeypatch.setattr(image_points, "match_windows", wrong)
    with pytest.raises(image_points.PointsError, match=r"forward: .*no consensus.*; .* accepted"):
        map_points(flown.patch, asked().model_copy(update={"control": 60, "check": 20}))


def two_patches() -> OrbitCalibrationSpec:
    test = CalibrationSetup.read(CALIBRATE).test
    assert test.images is not None
    places = tuple(test.images.patches[k] for k in (0, 4))
    points = test.images.points.model_copy(update={"control": 40, "check": 12, "tie": 12})
    images = test.images.model_copy(
        update={"patches": places, "lines": 300, "pixels": 300, "points": points, "oversampling": 2}
    )
    return test.model_copy(update={"images": images, "fields": type(test.fields)({"Beijing": test.fields["Beijing"]})})


def parameters_fit(campaign: Campaign) -> None:
    """Interior and biases against the truth, false alarm 1e-4."""
    found = simultaneous(campaign)
    names = [*campaign.inner, *(f"{p.name} {axis}" for p in campaign.passes for axis in BIAS)]
    chosen = [k for k, n in enumerate(found.names) if n in names and found.sigma[n] > 0.0]
    error = (found.values - true_values(campaign, found.names))[chosen]
    spread = found.covariance[np.ix_(chosen, chosen)]
    assert error @ np.linalg.solve(spread, error) < chi2.isf(1e-4, len(chosen))


def test_calibration_from_images() -> None:
    """Two patches of one field."""
    setup = CalibrationSetup.read(CALIBRATE)
    campaign = fly_fields(setup.model_copy(update={"test": two_patches()}), np.random.SeedSequence(5))
    assert campaign.images is not None
    done = screen_campaign(campaign)
    parameters_fit(done)
    (one,) = done.images or ()
    assert isinstance(one, FieldImages)
    assert one.screening is not None
    assert one.screening.wrong_left == 0
    assert one.screening.right_lost <= 0.02 * one.screening.entered


# --- points measured in a user's images, through files alone ----------------------------------------------------------


@pytest.fixture(scope="module")
def files(flown: Simulation, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("match")
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


def test_an_unknown_accuracy_is_not_hidden_by_a_known_one(files, monkeypatch: pytest.MonkeyPatch) -> None:
    """PROJ gives -1 for a transformation whose accuracy its authority does not state."""
    opened = match_run.UserMap.open

    class Unknown:
        accuracy = -1.0

        def __init__(self, transformer: Any) -> None:
            self.transform = transformer.transform

    def dem_unknown(*what: Any, **how: Any) -> Any:
        user_map = opened(*what, **how)
        return replace(user_map, to_geographic=Unknown(user_map.to_geographic)) if how.get("heights") else user_map

    assert matched(*files).accuracy == 0.0
    monkeypatch.setattr(match_run.UserMap, "open", dem_unknown)
    assert matched(*files).accuracy is None


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
