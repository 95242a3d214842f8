"""Range studies of paper 001's formulas: limits, kinds of return, and rows that turn with a broken formula."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.monitor import monitor_formulas
from analysis.spots.spot_image import SpotError
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from twin.validation import group
from twin.validation.check import CORRECTED, REFUTED
from twin.validation.group import Context
from twin.validation.paper_001 import ranges
from twin.validation.paper_001 import ranges_checks as show
from twin.validation.paper_001.ranges import FORMS, NAMES, Bench, single_range, variant
from twin.validation.paper_001.ranges_checks import GROUP
from twin.validation.registry import select
from twin.validation.runner import run_checks

EXPECTED = {check.id: check.expected for check in GROUP.checks}


@pytest.fixture(scope="module")
def resolved():
    return resolve_job(JobSpec(instrument=show.INSTRUMENT))


@pytest.fixture(scope="module")
def bench(resolved, backend):
    return Bench(variant(resolved, backend, "forward"))


@pytest.fixture(scope="module")
def wide(resolved, backend, bench):
    return Bench(variant(resolved, backend, "forward", pixels=ranges.WIDE_PX), bench, shapes=True)


def test_a_limit_is_found_between_the_points():
    calls = []

    def share(size):
        calls.extend(size)
        return {
            "power": (size / 3.7) ** 2,
            "bent": size / 50 + (size / 9.0) ** 3,
            "never": 0.0 * size,
            "at once": 2 + size,
        }

    curves = ranges.sampled(share, [0.1, 1.0, 10.0, 100.0])
    # interpolated on logarithmic axes, in which a power law is straight
    assert curves.crossing("power") == pytest.approx(3.7, rel=1e-9)
    exact = np.roots([1 / 9.0**3, 0.0, 1 / 50, -1.0])
    assert curves.crossing("bent") == pytest.approx(float(exact[np.isreal(exact)][0].real), rel=2e-3)
    assert curves.crossing("never") is None
    assert curves.crossing("at once") == 0.0
    assert len(calls) > 4


def test_larger_ccds_read_the_same_positions(bench, wide):
    # the same light on the same pixels; single precision of the images is 1e-7 of the peak
    assert wide.positions([{}]) == pytest.approx(bench.positions([{}]), abs=1e-4)
    # where beams are traced from the middles of the CCDs, pixels: coma of the edge against the middle
    assert np.abs(bench.traced([{}])).max() < 0.1


def test_the_box_just_keeps_the_spots_on_the_area_ccds(bench):
    """At the worst of its corners, by the trace; a seventh more and one leaves it."""
    camera = bench.cameras[0]
    middle = 0.5 * (np.array(bench.experiment.path.shape) - 1)
    half = middle.min() - ranges.EDGE_PX
    origin, traced = bench.positions([{}]), bench.traced([{}])
    for share, stays in ((1.0, True), (1.15, False)):
        moved = bench.traced(ranges.joint_states(bench, {camera: share * ranges.CORNERS * ranges.BOX})) - traced
        assert bool(np.max(np.abs(origin + moved - middle)) <= half) is stays


def test_the_figure_over_the_field_shows_readings_over_truth_less_one(monkeypatch):
    """In per cent over degrees, each number at its field."""
    rng = np.random.default_rng(3)
    gains = [{form: 1.0 + 0.01 * rng.normal(size=4) for form in (show.PRINTED, show.CORRECTED)} for _ in range(3)]
    points = [
        ranges.FieldPoint(np.radians(f), 2.0, g, np.zeros(4)) for f, g in zip((0.0, 0.6, 1.2), gains, strict=True)
    ]
    monkeypatch.setattr(group, "to_svg", lambda figure: figure)
    (axes,) = show.field_svg(points).axes
    law, *lines = [line for line in axes.get_lines() if len(line.get_xdata()) > 2]
    degrees = law.get_xdata()
    assert (degrees.min(), degrees.max()) == pytest.approx((0.0, 1.2))
    base = gains[0][show.CORRECTED][1]
    np.testing.assert_allclose(law.get_ydata(), 100 * (base * np.cos(np.pi / 180 * degrees) ** 2 - 1), atol=1e-9)
    shown = [(show.PRINTED, 1), *((show.CORRECTED, k) for k in (1, 0, 2, 3))]
    for line, (form, k) in zip(lines, shown, strict=True):
        np.testing.assert_allclose(line.get_xdata(), [0.0, 0.6, 1.2], atol=1e-12)
        np.testing.assert_allclose(line.get_ydata(), [100 * (g[form][k] - 1) for g in gains], atol=1e-12)


def test_the_figure_of_defocus_shows_false_readings_beside_the_theory(monkeypatch):
    """A ray at a height h moves by z h / f over a defocus of z, which reads as an angle of z h / f^2."""
    rng = np.random.default_rng(4)
    offset = np.array([[-0.2, 0.0], [0.1, 0.0], [0.0, 0.1], [0.0, -0.3], [0.0, 0.0]])
    slope, size = 1e6 * rng.normal(size=(5, 4)), np.array([1e-5, 1e-4, 1e-3])
    curves = ranges.Curves(size, {f"{name} claimed": rng.uniform(0.1, 9.0, 3) for name in NAMES})
    monkeypatch.setattr(group, "to_svg", lambda figure: figure)
    study = ranges.PupilStudy(offset, slope, np.zeros((4, 2)), np.zeros(4))
    left, right = show.defocus_svg(study, curves, (5.0, 6.0)).axes
    for axis, (f, sign) in enumerate(((5.0, -1.0), (6.0, 1.0))):
        theory, marks = left.get_lines()[2 * axis : 2 * axis + 2]
        # mm, and seconds of arc per um
        np.testing.assert_allclose(theory.get_ydata(), sign * 1e-9 * theory.get_xdata() / f**2 * 206264.806, rtol=1e-8)
        here = offset[:, 1 - axis] == 0.0
        np.testing.assert_allclose(marks.get_xdata(), 1e3 * offset[here, axis], atol=1e-12)
        np.testing.assert_allclose(marks.get_ydata(), 1e-6 * slope[here, axis], rtol=1e-12)
    for line, name in zip(right.get_lines()[1:], ("d_beta", "d_alpha", "d_gamma", "d_f"), strict=True):
        np.testing.assert_allclose(line.get_xdata(), [10.0, 100.0, 1000.0], rtol=1e-12)
        np.testing.assert_array_equal(line.get_ydata(), curves.value[f"{name} claimed"])


def test_the_figure_of_single_changes_shows_errors_and_limits_in_its_units(monkeypatch):
    """Arcsec, and mm of the principal distance; one per cent is one per cent of what is drawn below it."""
    rng, size = np.random.default_rng(5), np.geomspace(1.0, 1000.0, 6)
    parts = [{form: np.stack([size * up, rng.normal(size=6)], axis=-1) for form in FORMS} for up in (1.0, 2000.0)]
    one = SimpleNamespace(raw=parts[0], raw_traced=parts[1], lost=3e6, window=500.0)
    monkeypatch.setattr(group, "to_svg", lambda figure: figure)
    panels = show.singles_svg(dict.fromkeys(NAMES, (one,))).axes
    for axes, per, fine in zip(panels, (1.0, 1.0, 1.0, 1e-3), (0.1, 0.1, 0.1, 0.04), strict=True):
        percent, limit, *rest = axes.get_lines()
        np.testing.assert_allclose(percent.get_xdata(), [per, 3e6 * per])
        np.testing.assert_allclose(percent.get_ydata(), 0.01 * percent.get_xdata())
        assert limit.get_ydata()[0] == pytest.approx(fine)
        drawn = next(line for line in rest if len(line.get_xdata()) == 12)
        found = per * np.concatenate([part[show.PRINTED] for part in parts])
        np.testing.assert_allclose(drawn.get_xydata(), np.abs(found), rtol=1e-12)


def test_an_unknown_kind_of_return_is_refused(bench):
    with pytest.raises(ValueError, match="no return 'mirror'; there are plane, "):
        ranges.with_return(bench.experiment, "mirror")
    assert ranges.with_return(bench.experiment, "plane") is bench.experiment


@pytest.mark.second
def test_the_edge_of_the_window_is_where_the_centroid_refuses(bench, wide):
    found = single_range(bench, wide, "d_beta", 1, 3)
    motion, unit = ranges.motion_of("forward", "d_beta", bench.geometry("forward"))
    scale = found.window / 1.0016  # the traced change is 1.0016 times the nominal one
    inside, outside = (motion.state(unit * scale * share) for share in (0.995, 1.035))
    place = bench.positions([inside])
    assert np.min(place[..., 0]) == pytest.approx(ranges.EDGE_PX, abs=0.5)
    with pytest.raises(SpotError, match=r"edge|template"):
        bench.positions([outside])


@pytest.mark.second
def test_the_range_of_a_formula_turns_with_a_wrong_factor(bench, wide, backend, monkeypatch):
    parameter, row, verdict = "d_alpha", "001.eq3.range", CORRECTED
    context = Context(backend, 1, frozenset({row}), {check.id: check for check in GROUP.checks}, fast=True)

    def judged():
        both = [single_range(bench, wide, parameter, 1, 3)]
        return show._range(context, row, both, bench.geometry("forward")).verdict

    assert judged() == verdict
    right = monitor_formulas.coefficients
    monkeypatch.setattr(monitor_formulas, "coefficients", lambda name, geometry: 0.5 * right(name, geometry))
    assert judged() == REFUTED


@pytest.mark.second
def test_only_a_plane_face_returns_what_the_formulas_take(backend):
    results = run_checks(select([GROUP], "001.returns"), backend, 1, fast=True).results
    found = {r.id.rpartition(".")[2]: r for r in results}
    assert {r.id: r.verdict for r in results} == {i: v for i, v in EXPECTED.items() if "returns" in i}
    # pinhole images on a mirror's far side of its normal, and on itself by a retroreflector
    assert found["plane"].measured == pytest.approx(-2.0, abs=1e-3)
    for kind in ("roof", "roof_along", "corner"):
        assert found[kind].measured == pytest.approx(0.0, abs=1e-3)
