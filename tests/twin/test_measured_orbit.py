"""Calibration in orbit on files: the simulation's measurements read back, other conventions, independent solutions."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import twin.orbit.__main__ as command
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import EffectsSpec
from scenes.specs.orbit.measurements import body_axes_matrix
from scenes.specs.orbit.setup import AngleSetup, MeasuredAngleSetup, MeasuredCalibrationSetup, SimulateSetup
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from tests.tiers import quick
from tests.twin.commands import invoke
from tests.twin.orbit_files import FIELDS, WHOLE, edit, export, flown, read_back, scaled, set_keys, small
from twin.orbit.angle.angle_run import run_angle
from twin.orbit.angle.measured_angle import angle_exported, run_measured_angle
from twin.orbit.calibration.campaign_adjustment import calibrated_alone, gauge_of, simultaneous
from twin.orbit.calibration.schemes import scheme_errors
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import line_cameras
from twin.orbit.flight.sensor import LightEffects, Sensor
from twin.orbit.images.simulate_run import run_simulation, simulation_exported
from twin.orbit.measured.measurement_tables import read_measurements

run = partial(invoke, command.app)
TIGHT = 1e-9
"""Of a sigma: numbers are written with all digits, and only unit quaternions are rounded again."""


def same(one, other, tolerance: float = TIGHT) -> None:
    """Two adjustments agree within a share of their sigmas."""
    assert one.names == other.names
    sigma = np.sqrt(np.diag(one.covariance))
    free = sigma > 0.0
    assert np.abs((one.values - other.values)[free] / sigma[free]).max() < tolerance
    assert np.array_equal(one.values[~free], other.values[~free])
    scale = sigma[free]
    unit = (one.covariance - other.covariance)[np.ix_(free, free)] / scale / scale[:, None]
    assert np.abs(unit).max() < tolerance


@pytest.fixture(scope="module")
def campaign():
    """Flown once."""
    return flown(small())


@pytest.fixture
def files(tmp_path, campaign):
    """Its files; the path of the test file."""
    return export(tmp_path / "data", small(), campaign)


@pytest.mark.second
def test_files_give_the_estimates_of_the_simulation(campaign, files) -> None:
    """Together, each field by itself, and at check points."""
    _, again = read_back(files)
    same(simultaneous(campaign), simultaneous(again))
    alone = [{p.name: calibrated_alone(c, p) for p in c.passes} for c in (campaign, again)]
    for name in FIELDS:
        same(alone[0][name], alone[1][name])
    for one, other in zip(
        *(scheme_errors(c, a).values() for c, a in zip((campaign, again), alone, strict=True)), strict=True
    ):
        for name in FIELDS:
            assert other[name].plan_rms == pytest.approx(one[name].plan_rms, rel=1e-9)
            assert other[name].height_rms == pytest.approx(one[name].height_rms, rel=1e-9)
    assert again.known_truth is None
    with pytest.raises(AssertionError, match="is not known"):
        _ = again.passes[0].bias


@pytest.mark.second
def test_scipy_finds_the_same_from_the_files(tmp_path) -> None:
    """Collinearity written anew from the definition of the look in camera.json, splines and least squares of SciPy.

    Image points and control have errors, readings none: their weights are then diagonal. Sigmas along the track are
    those of a line's motion at the mean height of the points, here at that of the field: 1e-5 of themselves."""
    errors = WHOLE.test.errors
    tracker = errors.star_tracker.model_copy(update={"noise": (0.0, 0.0, 0.0)})
    gps = errors.gps.model_copy(update={"noise": (0.0, 0.0, 0.0), "drift": (0.0, 0.0, 0.0)})
    update = {
        "errors": errors.model_copy(update={"star_tracker": tracker, "gps": gps}),
        "effects": EffectsSpec(light_time=False, aberration=False, refraction=False),
    }
    update["fields"] = FrozenMap({FIELDS[0]: WHOLE.test.fields[FIELDS[0]].model_copy(update={"relief": 50.0})})
    setup = small(**update, schemes=((FIELDS[0],),))
    file = export(tmp_path, setup, flown(setup))
    _, again = read_back(file)
    ours = simultaneous(again)

    orbit, attitude, lines, ground, images = (
        np.genfromtxt(tmp_path / FIELDS[0] / f"{k}.csv", delimiter=",", names=True, dtype=None, autostrip=True)
        for k in ("orbit", "attitude", "lines", "ground", "image_points")
    )
    path = CubicSpline(orbit["time_s"], np.stack([orbit[f"{k}_m"] for k in "xyz"], -1))
    turn = CubicSpline(attitude["time_s"], np.stack([attitude[f"q{k}"] for k in range(1, 5)], -1))
    camera = read_yaml(tmp_path / "camera.yaml").data
    control = ground[ground["role"] == "control"]
    ids = control["point"].tolist()
    given = np.stack([control[f"{k}_m"] for k in "xyz"], -1)
    images = images[np.isin(images["point"], ids)]
    which = np.array([ids.index(p) for p in images["point"]])
    names = list(camera["lines"])[:3]
    line_of = np.array([names.index(c) for c in images["camera"]])
    seconds = np.empty(len(images))
    for k, name in enumerate(names):
        rows = lines[lines["camera"] == name]
        seconds[line_of == k] = np.interp(images["line"][line_of == k], rows["line"], rows["time_s"])
    pitch = 6.5e-6
    y = pitch * (images["pixel"] - 0.5 * (camera["pixels"] - 1))
    station, body = path(seconds), Rotation.from_quat(turn(seconds)).as_matrix()
    start, mounts, distortion = [], [], []
    for name in names:
        said = WHOLE.camera.lines[name]
        mounts.append((Rotation.from_rotvec([0.0, said.look, 0.0]) * Rotation.from_rotvec(said.rotate)).as_matrix())
        start.append([said.principal_distance, *said.principal_point])
        distortion.append(said.k1)
    mounts, start, distortion = np.array(mounts), np.array(start), np.array(distortion)
    free = [k for k in range(9) if k not in (4, 5)]  # x and y of the nadir line are the gauge
    sigma_x = 0.3 * pitch
    scale = np.array([1e-5] * 7 + [1e-5] * 3)

    def unpacked(values):
        inner = start.ravel().copy()
        inner[free] += values[:7] * scale[:7]
        return inner.reshape(3, 3), values[7:10] * scale[7:], given + values[10:].reshape(-1, 3)

    def residuals(values):
        inner, bias, points = unpacked(values)
        arm = np.einsum("nji,nj->ni", body, points[which] - station)
        seen = arm @ Rotation.from_euler("XYZ", bias).as_matrix()
        a, b, c = np.einsum("nji,nj->ni", mounts[line_of], seen).T
        f, x0, y0 = inner[line_of].T
        u, v = -x0, y - y0
        grown = 1.0 + distortion[line_of] * (u * u + v * v)
        image = np.stack([u * grown + f * a / c, v * grown + f * b / c], -1) / sigma_x
        return np.concatenate([image.ravel(), (points - given).ravel()])

    theirs = least_squares(residuals, np.zeros(10 + given.size), jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15)
    inner, bias, _ = unpacked(theirs.x)
    covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)[:10, :10] * scale * scale[:, None]
    found = {f"{n} {k}": v for n, row in zip(names, inner, strict=True) for k, v in zip("fxy", row, strict=True)}
    found |= {f"{FIELDS[0]} {k}": v for k, v in zip(("roll", "pitch", "yaw"), bias, strict=True)}
    order = [n for n in found if n not in gauge_of(again).held]
    sigma = np.sqrt(np.diag(covariance))
    for k, name in enumerate(order):
        assert ours.value(name) == pytest.approx(found[name], abs=1e-3 * sigma[k])
        assert ours.sigma[name] == pytest.approx(sigma[k], rel=1e-3)
    where = [ours.names.index(n) for n in order]
    unit = (ours.covariance[np.ix_(where, where)] - covariance) / sigma / sigma[:, None]
    assert np.abs(unit).max() < 1e-3
    assert ours.chi_square == pytest.approx(2.0 * theirs.cost, rel=1e-3)


def _other_quaternion(heads, rows):
    """Scalar first, frame to body, and a body whose axes point forward, left and up; every other one turned in sign."""
    axes = Rotation.from_matrix(np.array(body_axes_matrix(("forward", "left", "up")), float))
    found = []
    for k, row in enumerate(rows):
        x, y, z, w = (Rotation.from_quat([float(c) for c in row[1:]]) * axes.inv()).inv().as_quat()
        found.append([row[0], *(repr(float((-1) ** k * v)) for v in (w, x, y, z))])
    return heads, found


@pytest.mark.second
def test_conventions_units_and_order_do_not_matter(files) -> None:
    """All of them changed at once, rows and columns shuffled. Quaternions go through other rotations, whose rounding of
    1e-16 rad is 1e-10 m: a 1e-7 of a sigma at most."""
    random = np.random.default_rng(5)
    for name in FIELDS:
        place = files.parent / name / "image_points.csv"
        edit(place, lambda heads, rows: ([*heads, "correlation"], [[*row, "0.4"] for row in rows]))
    before = simultaneous(read_back(files)[1])

    def shuffled(heads, rows):
        order = random.permutation(len(heads))
        return [heads[k] for k in order], [[rows[r][k] for k in order] for r in random.permutation(len(rows))]

    def other_pixels(heads, rows):
        where = {name: heads.index(name) for name in ("line", "pixel")}
        found = []
        for row in rows:
            cells = list(row)
            cells[where["line"]] = repr(float(row[where["line"]]) + 1000.5)
            cells[where["pixel"]] = repr(11999.0 - float(row[where["pixel"]]) + 1.5)
            cells[heads.index("correlation")] = "-0.4"
            found.append(cells)
        return heads, found

    def other_lines(heads, rows):
        return heads, [[c, repr(float(n) + 1000.0), repr(float(t) - 0.5 * 0.7e-3)] for c, n, t in rows]

    for name in FIELDS:
        folder = files.parent / name
        edit(folder / "attitude.csv", _other_quaternion)
        edit(folder / "image_points.csv", other_pixels)
        edit(folder / "lines.csv", other_lines)
        edit(folder / "orbit.csv", scaled("y [m]", "y [km]", 1e-3))
        edit(folder / "attitude.csv", scaled("time [s]", "time [ms]", 1e3))
        edit(folder / "ground.csv", scaled("sigma [m]", "sigma [mm]", 1e3))
        for table in ("orbit", "attitude", "lines", "ground", "image_points"):
            edit(folder / f"{table}.csv", shuffled)
    said = {
        "frame": "itrs",
        "quaternion": {"scalar": "first", "direction": "frame_to_body"},
        "body_axes": ["forward", "left", "up"],
        "time_scale": "utc",
        "line_moment": "start",
        "centre": "half",
        "first_pixel": 1,
        "first_pixel_sees": "left",
    }
    set_keys(files.parent / "data.yaml", conventions=said)
    _, again = read_back(files)
    same(before, simultaneous(again), 1e-7)


@pytest.mark.second
@pytest.mark.parametrize("procedure", ["calibrate", "adjust"])
@pytest.mark.parametrize(("key", "value"), [("scalar", "first"), ("direction", "frame_to_body")])
def test_a_wrong_quaternion_is_named_as_the_likeliest_cause(tmp_path, procedure, key, value) -> None:
    shutil.copytree(SCENES / ORBIT / "measured", tmp_path, dirs_exist_ok=True)
    data = read_yaml(tmp_path / "data.yaml").data
    data["conventions"]["quaternion"][key] = value
    (tmp_path / "data.yaml").write_text(dump_yaml(data))
    result = run(procedure, tmp_path / f"{procedure}.yaml", "--out", tmp_path / "run")
    said = " ".join(result.stderr.split())
    assert (result.exit_code, (tmp_path / "run").exists()) == (2, False)
    assert "see the points: `scalar` first or last, `direction`, `body_axes`" in said
    assert "`twin.orbit check` finds" in said


@pytest.mark.second
def test_two_lines_calibrate(campaign, files) -> None:
    """Forward and backward alone: right to its sigmas, which are larger; the steeper line is held. False alarm 1e-6."""
    for name in FIELDS:
        for table, column in (("image_points", 1), ("lines", 0)):
            edit(
                files.parent / name / f"{table}.csv",
                lambda heads, rows, column=column: (heads, [r for r in rows if r[column] != "nadir"]),
            )
    _, pair = read_back(files)
    assert pair.lines == ("forward", "backward")
    three, two = simultaneous(campaign), simultaneous(pair)
    assert set(gauge_of(pair).held) == {f"{pair.reference} x", f"{pair.reference} y"}
    assert two.p_value > 1e-6
    for line in pair.lines:
        assert two.sigma[f"{line} f"] > three.sigma[f"{line} f"]
        error = two.value(f"{line} f") - campaign.truth[line].interior[0]
        assert abs(error) < 5.0 * two.sigma[f"{line} f"]


@pytest.mark.second
def test_ccds_that_do_not_lie_in_line_are_known_not_estimated(tmp_path) -> None:
    """A nadir line of two CCDs, one a pixel and a half off: flown with them and analysed with them, the calibration is
    right to its sigmas; analysed as one straight line, the fit is impossible. False alarms 1e-6."""
    data = WHOLE.camera.plain()
    data["lines"]["nadir"]["ccds"] = [
        {"first": 0, "last": 5999, "shift": ["10 um", "0 um"], "rotate": "20 arcsec"},
        {"first": 6000, "last": 11999, "shift": ["-10 um", "3 um"]},
    ]
    camera = ThreeLineCameraSpec.model_validate(data)
    setup = small(**no_thermal(), schemes=(FIELDS,)).model_copy(update={"camera": camera})
    one = flown(setup)
    file = export(tmp_path / "data", setup, one)
    _, again = read_back(file)
    found = simultaneous(again)
    same(simultaneous(one), found)
    assert found.p_value > 1e-6
    free = [n for n in found.names if found.sigma[n] > 0.0 and n in again.inner]
    where = [found.names.index(n) for n in free]
    truth = {f"{k} {n}": v for k in again.lines for n, v in zip("fxy", one.truth[k].interior, strict=True)}
    error = np.array([found.value(n) - truth[n] for n in free])
    square = error @ np.linalg.solve(found.covariance[np.ix_(where, where)], error)
    assert 1e-6 < chi2.sf(square, len(free)) < 1.0 - 1e-6
    (tmp_path / "data/camera.yaml").write_text(dump_yaml(WHOLE.camera.plain()))
    assert simultaneous(read_back(file)[1]).p_value < 1e-6


@pytest.mark.second
def test_look_angles_are_another_way_to_know_the_same_line(campaign, files) -> None:
    """Polynomials of degree 7 fitted to the looks of the laboratory's lines, good to 1e-12 rad: the same estimates."""
    data = WHOLE.camera.plain()
    data["lines"] = {name: data["lines"][name] for name in campaign.lines}
    for name, line in data["lines"].items():
        said = WHOLE.camera.lines[name]
        mount = Rotation.from_rotvec([0.0, said.look, 0.0]) * Rotation.from_rotvec(said.rotate)
        line.pop("k1")
        line["ccds"] = []
        for first, last in ((0, 5999), (6000, 11999)):
            pixel = np.linspace(first - 0.5, last + 0.5, 201)
            look = mount.inv().apply(line_cameras(WHOLE.camera)[name].look(pixel))
            fits = [
                np.polynomial.Polynomial.fit(pixel, np.arctan2(look[:, k], look[:, 2]), 7, domain=[first, last])
                for k in (0, 1)
            ]
            psi = [[f"{c!r} rad" for c in fit.convert(domain=[-1, 1], window=[-1, 1]).coef.tolist()] for fit in fits]
            line["ccds"].append({"first": first, "last": last, "psi_x": psi[0], "psi_y": psi[1]})
    (files.parent / "camera.yaml").write_text(dump_yaml(data))
    _, again = read_back(files)
    before, after = simultaneous(campaign), simultaneous(again)
    sigma = np.array([before.sigma[n] for n in before.names])
    free = sigma > 0.0
    # distortion now counts from the laboratory's principal point and grows with f: 0.04 /m^2 x (39 mm)^2 of the changes
    assert np.abs((before.values - after.values)[free] / sigma[free]).max() < 0.05


def no_thermal() -> dict:
    """Biases that do not drift during a pass, which no sigma of an angle holds."""
    tracker = WHOLE.test.errors.star_tracker
    still = tracker.model_copy(update={"thermal": type(tracker.thermal)()})
    return {"errors": WHOLE.test.errors.model_copy(update={"star_tracker": still})}


@pytest.mark.second
def test_velocities_and_one_table_of_the_platform_may_be_left_to_the_positions(campaign, files) -> None:
    """Aberration by the derivative of noisy positions, 0.1 m/s or 3e-10 rad off; orbit and attitude at the same times
    in one table."""
    folder = files.parent / "Beijing"
    edit(folder / "orbit.csv", lambda heads, rows: (heads[:4], [row[:4] for row in rows]))
    _, again = read_back(files)
    assert again.passes[0].measurements.platform.velocity is None
    same(simultaneous(campaign), simultaneous(again), 0.01)
    data = dict(read_yaml(files.parent / "data.yaml").data)
    one = dict(data["passes"]["Beijing"])
    attitude, orbit = (np.loadtxt(folder / f"{k}.csv", delimiter=",", skiprows=1) for k in ("attitude", "orbit"))
    place = CubicSpline(orbit[:, 0], orbit[:, 1:])(attitude[:, 0])
    rows = np.column_stack([attitude[:, 0], place, attitude[:, 1:]])
    text = "time [s],x [m],y [m],z [m],q1,q2,q3,q4\n" + "\n".join(",".join(map(repr, r)) for r in rows.tolist())
    (folder / "platform.csv").write_text(text)
    del one["orbit"], one["attitude"]
    data["passes"] = {**data["passes"], "Beijing": {**one, "platform": "Beijing/platform.csv"}}
    (files.parent / "data.yaml").write_text(dump_yaml(data))
    # the orbit's readings are now told as 8 a second: their noise is stated by an interval
    same(simultaneous(campaign), simultaneous(read_back(files)[1]), 0.01)


@pytest.mark.second
def test_points_of_simulated_images_are_exported_where_they_were_found(tmp_path) -> None:
    """A patch of 400 pixels: control points lie where the true camera sees their given coordinates, but for the errors
    of matching (0.1 px), of the orthophoto and of the elevation model (0.5 m and 2 m of 5 m pixels)."""
    setup = SimulateSetup.read(SCENES / ORBIT / "simulate.yaml")
    test = setup.test
    small_patch = {"patch": test.patch.model_copy(update={"lines": 400, "pixels": 400})}
    setup = setup.model_copy(update={"test": test.model_copy(update=small_patch)})
    done = run_simulation(setup, None, 1)
    for name, text in simulation_exported(done).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    said = MeasuredCalibrationSetup.read(tmp_path / "calibrate.yaml")
    (one,) = read_measurements(said.data, said.camera)
    assert set(one.images) == {"forward", "nadir", "backward"}
    assert set(one.ground.role.tolist()) == {"control", "check", "tie"}
    given = one.ground.role == "control"
    for name, row in one.images.items():
        camera = line_cameras(done.truth)[name]
        sensor = Sensor.of_lines(camera, done.trajectory, Earth(), one.line_times[name], LightEffects())
        some = row.taken(given[row.point])
        assert len(some.point) > 14
        line, pixel = sensor.image(one.ground.itrs[some.point])
        off = np.median(np.abs([some.line - line, some.pixel - pixel]), axis=1)
        assert off.max() < 0.6
    nothing = done.setup.model_copy(update={"test": done.setup.test.model_copy(update={"points": None})})
    with pytest.raises(InputError, match="only measured points can be exported"):
        simulation_exported(replace(done, setup=nothing, points=None))


@pytest.mark.parametrize(
    "changes", quick(1, [{}, {"effects": {"corrected": False}}, {"errors": {"points": "0.1 m"}, "time": "7 s"}])
)
def test_angles_of_a_simulation_and_of_its_exported_files(tmp_path, changes) -> None:
    """Planes, along the track and resection: values to the rounding of a coordinate in the ITRS, 1e-9 m and 2e-15 rad
    from 500 km; three of it, which is 1.4e-8 of the sigmas or less. Sigmas to what 1e-6 px adds.
    """
    rounding = 3 * 2e-15
    plain = read_yaml(SCENES / ORBIT / "angle.yaml").data | {"passes": 2}
    for key, value in changes.items():
        plain[key] = plain[key] | value if isinstance(value, dict) else value
    (tmp_path / "angle.yaml").write_text(dump_yaml(plain))
    run_ = run_angle(AngleSetup.read(tmp_path / "angle.yaml"), None, 3)
    for name, text in angle_exported(run_).items():
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_text(text)
    again = run_measured_angle(MeasuredAngleSetup.read(tmp_path / "out/angle.yaml"))
    assert len(again.passes) == 1
    one, two = run_.estimate, again.passes[0].estimate
    for method in one.angles:
        assert np.abs(one.angles[method].values - two.angles[method].values).max() < rounding
        assert rounding < 1.5e-8 * one.angles[method].sigma.min()
        assert two.angles[method].covariance == pytest.approx(one.angles[method].covariance, rel=1e-8)
    assert np.abs(one.along.values - two.along.values).max() < rounding
    pairs = tuple(run_.flight.pairs.values())
    spread = one.resection.angle_covariance(pairs)
    apart = one.resection.angles(pairs) - two.resection.angles(pairs)
    assert np.abs(apart).max() < rounding
    assert two.resection.angle_covariance(pairs) == pytest.approx(spread, rel=1e-8)
