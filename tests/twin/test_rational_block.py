"""Images with rational polynomials in ``twin.orbit adjust``: estimates, covariances, files and messages."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.stats import chi2

import twin.orbit.__main__ as command
from analysis.block.robust_start import scales
from analysis.orbit.forward_intersection import level_axes
from analysis.orbit.rational_polynomial import RationalPolynomial
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError
from tests.twin.commands import invoke
from tests.twin.rational_bench import HALF, LOOKS, SIDE, Bench, bench, polynomial
from twin.framework.artefact import Table
from twin.framework.data_files import FrameFacts, tiff
from twin.framework.procedure import BenchError
from twin.orbit.export.rational_polynomial import PolynomialImage, is_rpc, read_rpc

ADJUST = PROCEDURES["orbit adjust"]
SIGMA = {"shift": 5.0, "drift": 0.5, "affine": 0.5}
ERRORS = {term: [size, size] for term, size in SIGMA.items()}


def adjusted(file: Path) -> Any:
    return ADJUST.run(ADJUST.resolve(file), None, 0, lambda *_: None)


def dense(one: Bench, control: int, shared: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corrections (images, 2, K), points and covariance of all unknowns by plain least squares of all of them together.

    An error that the first two images share is a further unknown of each term, of `shared` times its sigma.

    Derivatives are differences of the equations themselves, and the points are latitude, longitude and height.
    """
    names, count, terms = list(one.images), len(one.ground), len(SIGMA)
    prior = np.array(list(SIGMA.values()))

    def rows(x: np.ndarray) -> np.ndarray:
        value = x[: 2 * terms * len(names)].reshape(len(names), 2, terms)
        ground = one.ground + x[2 * terms * len(names) :][: 3 * count].reshape(count, 3)
        common = x[2 * terms * len(names) + 3 * count :].reshape(-1, 2, terms)
        own = value - np.concatenate([common, common, np.zeros_like(common)])[: len(names)] if shared else value
        parts = [
            (own / prior).ravel(),
            (common / (shared or 1.0) / prior).ravel(),
            (ground[:control] - one.ground[:control]).ravel() / 0.05,
        ]
        for k, name in enumerate(names):
            image, (point, *place) = one.images[name], one.places[name].T
            position = image.seen(ground[point.astype(int)])[0]
            scaled = (position - image.middle) / image.size
            basis = np.column_stack([np.ones(len(scaled)), scaled])
            parts.append(((position + basis @ value[k].T - np.column_stack(place)) / one.sigma).ravel())
        return np.concatenate(parts)

    x = np.zeros(2 * terms * (len(names) + (shared > 0.0)) + 3 * count)
    step = 0.5
    for _ in range(6):
        columns = [(rows(x + step * unit) - rows(x - step * unit)) / (2.0 * step) for unit in np.eye(len(x))]
        jacobian = np.stack(columns, axis=1)
        x = x - np.linalg.lstsq(jacobian, rows(x), rcond=None)[0]
    return x, np.linalg.inv(jacobian.T @ jacobian), rows(x)


@pytest.mark.parametrize("control", [0, 4])
def test_it_is_the_least_squares_solution_of_all_unknowns_together(tmp_path: Path, control: int) -> None:
    one = bench(SIGMA, points=25)
    run = adjusted(one.write(tmp_path, ERRORS, control, robust=False))
    x, covariance, residual = dense(one, control)
    first = 6 * len(one.images)
    sigma = np.sqrt(np.diag(covariance))
    value = np.concatenate([image.value.ravel() for image in run.images.values()])
    assert np.abs(value - x[:first]).max() < 1e-6 * sigma[:first].min()
    order = np.concatenate([run.adjustment.assembly.changes[name] for name in one.images])
    unit = np.concatenate([run.adjustment.assembly.units[name] for name in one.images])
    joint = unit[:, None] * run.adjustment.covariance[np.ix_(order, order)] * unit
    limits = sigma[:first, None] * sigma[:first]
    # differences of the equations over a metre or a pixel are derivatives to 1e-8, in both factors of the inverse
    assert np.abs((joint - covariance[:first, :first]) / limits).max() < 1e-6
    ground = one.ground + x[first:].reshape(-1, 3)
    assert np.abs(run.adjustment.ground - ground).max() < 1e-6 * sigma[first:].min() + 2e-9  # rounding of 6e6 m
    blocks = np.array(
        [covariance[first + 3 * k : first + 3 * k + 3, first + 3 * k : first + 3 * k + 3] for k in range(25)]
    )
    assert np.allclose(run.adjustment.point_covariance(np.arange(25)), blocks, rtol=1e-6, atol=1e-6 * blocks.max())
    assert run.adjustment.chi_square == pytest.approx(float(residual @ residual), rel=1e-6)
    up = level_axes(run.adjustment.ground)[:, 2]
    joint = np.einsum("mi,minj,nj->mn", up, covariance[first:, first:].reshape(25, 3, 25, 3), up)
    minus_mean = np.eye(25) - 1.0 / 25.0
    relative = np.sqrt(np.diag(minus_mean @ joint @ minus_mean))
    # derivatives are differences of 0.5 m, to 1e-8 of the common part of the variance
    assert np.allclose(run.relative_height_sigma, relative, rtol=1e-4)
    if not control:
        assert np.all(10.0 * relative < np.sqrt(np.diag(joint)))


def test_images_of_a_pass_share_errors(tmp_path: Path) -> None:
    one = bench(SIGMA, points=25)
    errors = {term: [4.0 * size, 4.0 * size] for term, size in SIGMA.items()}
    file = one.write(tmp_path, ERRORS, robust=False, passes={"A": {"images": ["first", "second"], "errors": errors}})
    run = adjusted(file)
    x, covariance, residual = dense(one, 0, shared=4.0)
    first = 6 * len(one.images)
    sigma = np.sqrt(np.diag(covariance))
    value = np.concatenate([image.value.ravel() for image in run.images.values()])
    assert np.abs(value - x[:first]).max() < 1e-5 * sigma[:first].min()
    _, joint = run.adjustment.change(*one.images)
    limits = sigma[:first, None] * sigma[:first]
    # derivatives by differences of the equations, as in the test of independent errors
    assert np.abs((joint - covariance[:first, :first]) / limits).max() < 1e-5
    assert run.adjustment.chi_square == pytest.approx(float(residual @ residual), rel=1e-6)
    assert run.images["first"].before[0, 0] == pytest.approx(5.0 * np.hypot(1.0, 4.0))
    assert run.images["third"].before[0, 0] == 5.0
    # the two look along the track; what they share does not tilt their intersection
    independent = adjusted(one.write(tmp_path, {t: [s * 17**0.5] * 2 for t, s in SIGMA.items()}, robust=False))
    heights = [r.adjustment.point_covariance(np.arange(25)) for r in (run, independent)]
    assert np.median(np.trace(heights[0], axis1=1, axis2=2) / np.trace(heights[1], axis1=1, axis2=2)) < 0.7


@pytest.mark.second
def test_corrections_and_points_scatter_as_their_sigmas_say(tmp_path: Path) -> None:
    squares, chances = [], []
    for seed in range(30):
        one = bench(SIGMA, points=40, seed=seed)
        run = adjusted(one.write(tmp_path, ERRORS, 3, robust=False))
        order = np.concatenate([run.adjustment.assembly.changes[name] for name in one.images])
        unit = np.concatenate([run.adjustment.assembly.units[name] for name in one.images])
        wrong = np.concatenate([(image.value - one.correction[name]).ravel() for name, image in run.images.items()])
        joint = unit[:, None] * run.adjustment.covariance[np.ix_(order, order)] * unit
        squares.append(float(wrong @ np.linalg.solve(joint, wrong)))
        chances.append(run.adjustment.p_value)
    # control is exact here and stated to 0.05 m: estimates are better than stated, at most by that
    assert chi2.cdf(np.sum(squares), 30 * 18) < 0.999
    assert np.sum(squares) > 0.5 * 30 * 18
    assert min(chances) > 1e-3


@pytest.mark.parametrize(
    ("column", "size", "rejected"),
    [
        (2, 3.0, (("p7", "second"),)),
        # nearly along the common direction of the looks, three images say which one is wrong if it is far off
        (1, 10.0, (("p7", "second"),)),
        # and do not if it is not: the point is lost
        (1, 2.0, (("p7", "first"), ("p7", "second"), ("p7", "third"))),
    ],
)
def test_gross_errors_are_rejected_and_named(
    tmp_path: Path, column: int, size: float, rejected: tuple[tuple[str, str], ...]
) -> None:
    one = bench({"shift": 5.0})
    one.places["second"][7, column] += size
    run = adjusted(one.write(tmp_path, {"shift": [5.0, 5.0]}))
    assert run.rejected == rejected
    assert run.adjustment.p_value > 1e-3
    assert max(image.rms_after.max() for image in run.images.values()) < 0.25
    assert min(image.rms_before.max() for image in run.images.values()) > 0.5
    assert any("p7 in second" in text for text in ADJUST.report(run).warnings)


def test_the_report_states_the_residuals_once_and_has_nothing_empty(tmp_path: Path) -> None:
    one = replace(bench({"shift": 5.0}), sigma=1.0)  # five times the noise
    report = ADJUST.report(adjusted(one.write(tmp_path, {"shift": [5.0, 5.0]})))
    (said,) = (text for text in (report.verdict, *report.lead) if "chi-square" in text)
    assert "The residuals are 0.19 times as large as stated" in said
    assert "p < 1e\N{MINUS SIGN}6 two-sided" in said
    assert any("not CE90 and LE90, which the priors determine" in text for text in report.warnings)
    assert report.summary.heads == ["sensors", "CE90 predicted [m]", "LE90 predicted [m]"]
    assert all(table.rows for section in report.sections for table in section.artefacts if isinstance(table, Table))
    report = ADJUST.report(adjusted(bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]}, 4)))
    assert any("agree with the stated errors" in text for text in report.lead)
    assert "Weakly observable combinations" not in [section.title for section in report.sections]


def test_ground_points_without_image_points_are_named(tmp_path: Path) -> None:
    one = bench({"shift": 5.0}, points=1)
    file = one.write(tmp_path, {"shift": [5.0, 5.0]}, 1)
    table = tmp_path / "ground.csv"
    table.write_text(table.read_text().replace("p0", "P0"))
    with pytest.raises(InputError, match="no image point of these ground points; found 'P0'"):
        adjusted(file)
    report = ADJUST.report(adjusted(one.write(tmp_path, {"shift": [5.0, 5.0]})))
    assert not any("Relative to the mean" in text for text in (report.verdict, *report.lead))


def test_the_terminal_names_what_it_exported(tmp_path: Path) -> None:
    file = bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]}, 3)
    result = invoke(command.app, "adjust", file, "--out", tmp_path / "run", "--export", tmp_path / "out")
    assert f"exported:   {tmp_path / 'out'}: points.csv, first_RPC.TXT" in result.stdout
    assert "sigma_up_relative [m]" in (tmp_path / "out/points.csv").read_text()


def test_another_program_projects_alike() -> None:
    """Numbers of rpcm 1.4.10 (centreborelli, PyPI) for the polynomials of the bench: projection of longitude 5.503,
    latitude 42.998, height 520 m to column and row, and localisation of column 400.25, row 1700.5, height 180 m."""
    model = polynomial((0.25, 0.05))
    line, sample = model.image(42.998, 5.503, 520.0)
    assert abs(sample - 1499.9981015616133) < 1e-6
    assert abs(line - 1383.976895379632) < 1e-6
    latitude, longitude = model.ground(1700.5, 400.25, 180.0)
    # 1e-6 px of 0.5 m are 5e-12 deg; rpcm's own localisation ends at 1e-2 px
    assert abs(latitude - 42.99733907725773) < 1e-7
    assert abs(longitude - 5.49645287415568) < 1e-7


def test_what_is_exported_says_the_same_to_other_programs(tmp_path: Path) -> None:
    one = bench(SIGMA)
    before = replace(one.images["first"].polynomial, random_m=0.4)
    content = tiff(np.zeros((1, SIDE, SIDE), np.uint16), FrameFacts(georeference=before))
    (tmp_path / "crop.tif").write_bytes(content)
    file = one.write(tmp_path, ERRORS, 3)
    file.write_text(file.read_text().replace("rpc: first_RPC.TXT", "file: crop.tif"))
    run = adjusted(file)
    files = ADJUST.export(run)
    assert set(files) == {"points.csv", "corrections.json", "first.tif", *(f"{name}_RPC.TXT" for name in one.images)}
    for name, text in files.items():
        (tmp_path / f"out_{name}").write_bytes(text if isinstance(text, bytes) else text.encode())
    told = json.loads(files["corrections.json"])
    joint = np.array(told["joint_covariance_px2"])
    assert joint.shape == (18, 18)
    assert told["joint_unknowns"][0] == "first shift of line"
    assert np.abs(joint[:6, 6:12]).max() > 1e-5  # images have errors in common
    for k, (name, image) in enumerate(one.images.items()):
        said = told["images"][name]
        value = np.array(said["value_px"]).reshape(2, 3)
        place = image.seen(one.ground)[0]
        scaled = (place - said["middle_px"]) / np.array(said["size_px"])
        corrected = place + np.column_stack([np.ones(len(place)), scaled]) @ value.T
        found = PolynomialImage.of(read_rpc(tmp_path / f"out_{name}_RPC.TXT")).seen(one.ground)[0]
        # attaining 1e-6 px means that nothing but the correction has changed
        assert np.abs(found - corrected).max() < 1e-6, name
        assert np.allclose(said["covariance_px2"], joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6])
    tagged = read_rpc(tmp_path / "out_first.tif")
    assert np.array_equal(tagged.line_numerator, read_rpc(tmp_path / "out_first_RPC.TXT").line_numerator)
    assert tagged.random_m == 0.4
    assert tagged.bias_m == pytest.approx(run.images["first"].polynomial.bias_m)
    assert np.array_equal(tifffile.imread(tmp_path / "out_first.tif"), tifffile.imread(tmp_path / "crop.tif"))


def test_the_bias_is_the_scatter_of_the_image_on_the_ground(tmp_path: Path) -> None:
    run = adjusted(bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]}, 3))
    image = run.images["second"]  # half a metre for a pixel, along both axes
    assert image.polynomial.bias_m == pytest.approx(0.5 * np.sqrt(0.5 * np.sum(image.sigma**2)), rel=0.02)


def rpb(model: RationalPolynomial) -> str:
    """The polynomials as a file .RPB."""
    names = ("line", "samp", "lat", "long", "height")
    rows = ['satId = "QB02";', "BEGIN_GROUP = IMAGE", "\terrBias = 7.5;", "\terrRand = 0.25;"]
    for what, values in (("Offset", model.offset), ("Scale", model.scale)):
        rows += [f"\t{name}{what} = {value!r};" for name, value in zip(names, values.tolist(), strict=True)]
    parts = (model.line_numerator, model.line_denominator, model.sample_numerator, model.sample_denominator)
    for name, part in zip(("lineNum", "lineDen", "sampNum", "sampDen"), parts, strict=True):
        rows += [f"\t{name}Coef = (", ",\n".join(f"\t\t\t{v!r}" for v in part.tolist()) + ");"]
    return "\n".join([*rows, "END_GROUP = IMAGE", "END;"]) + "\n"


def test_polynomials_of_a_file_rpb(tmp_path: Path) -> None:
    model, path = polynomial((0.1, 0.2)), tmp_path / "a.RPB"
    path.write_text(rpb(model))
    assert is_rpc(path)
    found = read_rpc(path)
    for name in ("offset", "scale", "line_numerator", "line_denominator", "sample_numerator", "sample_denominator"):
        assert np.array_equal(getattr(found, name), getattr(model, name)), name
    assert (found.bias_m, found.random_m) == (7.5, 0.25)
    path.write_text(rpb(model).replace("lineNumCoef", "lineNumCoeff"))
    with pytest.raises(InputError, match="no lineNumCoef"):
        read_rpc(path)
    path.write_text(rpb(model).replace("latScale = ", "latScale = 1.0, "))
    with pytest.raises(InputError, match="another number of values"):
        read_rpc(path)


def test_slopes_are_those_of_the_positions() -> None:
    model = polynomial((0.3, -0.2))
    place = model.offset[2:] + [[0.3, -0.5, 0.6]] * model.scale[2:]
    _, slope = model.linearised(*place.T)
    for k in range(3):
        step = 1e-4 * model.scale[2 + k] * np.eye(3)[k]
        ends = [np.stack(model.image(*(place + sign * step).T), axis=-1) for sign in (0.5, -0.5)]
        # the third derivative over a step of 1e-4 leaves 1e-8; rounding of 1e3 px over it 1e-9
        assert np.allclose((ends[0] - ends[1]) / step[k], slope[..., k], rtol=1e-6, atol=1e-6 * np.abs(slope).max())
    # a longitude of another turn is the same place
    assert np.allclose(model.image(place[0, 0], place[0, 1] - 360.0, place[0, 2]), model.image(*place[0]))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("p3,second", "p3,fourth", "no such image in the block"),
        ("p3,second", "p2,second", "this point occurs twice in second"),
        ("line_sigma", "line_error", "line_sigma"),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]})
    table = tmp_path / "points.csv"
    table.write_text(table.read_text().replace(old, new))
    with pytest.raises(InputError, match=words) as told:
        adjusted(file)
    assert "points.csv" in str(told.value)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"passes": {"A": {"images": ["first", "fourth"], "errors": {"shift": [1.0, 1.0]}}}}, "no such image"),
        ({"passes": {"A": {"images": [], "errors": {"shift": [1.0, 1.0]}}}}, "passes.A.images"),
        ({"passes": {"A": {"images": ["first", "first"], "errors": {"shift": [1.0, 1.0]}}}}, "an image of two passes"),
        (
            {"passes": {"A": {"images": ["first"], "errors": {"shift": [1.0, 1.0], "drift": [1.0, 1.0]}}}},
            "first has no drift of its own",
        ),
        ({"errors": {"drift": [1.0, 1.0]}}, "shift"),
        ({"errors": {"shift": [0.0, 1.0]}}, "greater than 0"),
        ({"components": ["drift"]}, "no such group of variances"),
        ({"image_points": None}, "no image points"),
        ({"images": {"first": {}}}, "an image without a file"),
        ({"images": {"first": {"rpc": "lost_RPC.TXT"}}}, "lost_RPC.TXT"),
        ({"without": ["laser"]}, "laser"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    from scenes.yaml.yaml_file import dump_yaml, read_yaml

    file = bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]})
    data = {**read_yaml(file).data, **keys}
    file.write_text(dump_yaml({key: value for key, value in data.items() if value is not None}))
    with pytest.raises(InputError, match=words):
        ADJUST.resolve(file)


def test_points_of_another_image_are_named(tmp_path: Path) -> None:
    one = bench({"shift": 5.0})
    one.places["third"][:, 1:] += 40.0 * HALF
    with pytest.raises(BenchError, match="or half an image, from the directions of their images"):
        adjusted(one.write(tmp_path, {"shift": [5.0, 5.0]}, 3))


@pytest.mark.second
def test_images_are_projected_once_for_each_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cost of a large block is the number of projections of an image: those of one state serve all that needs them,
    however many images there are; and pieces that bound the memory change nothing."""
    calls: list[int] = []
    seen = PolynomialImage.seen
    monkeypatch.setattr(
        PolynomialImage, "seen", lambda image, ground: (calls.append(len(ground)), seen(image, ground))[1]
    )
    file = bench(SIGMA).write(tmp_path, ERRORS, 4)
    run = adjusted(file)
    # 45 for start, steps of the adjustments with and without each sensor, and residuals; 55 if none were kept
    once = len(calls) / len(LOOKS)
    assert once <= 46
    monkeypatch.setattr("analysis.block.point_reduction._AT_ONCE", 300)
    pieces = adjusted(file)
    assert len(calls) / len(LOOKS) > 2.5 * once
    assert np.allclose(pieces.adjustment.x, run.adjustment.x, rtol=0.0, atol=1e-12)
    assert pieces.rejected == run.rejected


def test_the_scale_of_a_start_is_the_median_over_that_of_good_measurements(tmp_path: Path) -> None:
    """Without it the first weights would reject good measurements of an uncorrected block."""
    sets = adjusted(bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]})).adjustment.assembly.reduction.sets
    median = float(np.sqrt(chi2.median(2)))
    for size, scale in ((3.0, 3.0), (1.4, 1.4), (0.2, 1.0)):
        sizes = [np.full(len(packets.point), size * median) for packets in sets]
        assert scales(sets, sizes)["image"] == pytest.approx(scale)


@pytest.mark.parametrize("wrong", [20.0, 2000.0])
def test_a_control_point_far_from_its_images_is_rejected(tmp_path: Path, wrong: float) -> None:
    file = bench({"shift": 5.0}).write(tmp_path, {"shift": [5.0, 5.0]}, 5)
    head, first, *others = (tmp_path / "ground.csv").read_text().splitlines()
    name, x, *rest = first.split(",")
    (tmp_path / "ground.csv").write_text("\n".join([head, ",".join([name, str(float(x) + wrong), *rest]), *others]))
    run = adjusted(file)
    assert run.rejected == (("p0", "control"),)
    assert run.adjustment.p_value > 1e-3
