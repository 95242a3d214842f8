"""Every warning of the reports in orbit and of the laboratory is told when, and only when, it holds.

A run is what its warnings look at, with values at the edge of what needs no warning; each case changes one of them.
"""

import copy
from collections.abc import Callable
from types import SimpleNamespace as Ns
from typing import Any

import numpy as np
import pytest

from twin.laboratory import distortion_report, focus_report, turntable_report
from twin.orbit.angle import angle_report
from twin.orbit.block import block_report
from twin.orbit.calibration import calibration_report, influences
from twin.orbit.calibration.calibration_numbers import FIT, STEPWISE
from twin.orbit.conventions import check_report
from twin.orbit.export import export_report, quality_sections
from twin.orbit.export.ground_accuracy import TOGETHER
from twin.orbit.export.polynomial_control import residual_sigma
from twin.orbit.export.quality_sections import quality_answers
from twin.orbit.images import simulate_report
from twin.orbit.matching import match_report
from twin.orbit.monitoring import monitoring_report
from twin.orbit.monitoring.monitoring_numbers import PROPAGATION, SMOOTHING

FAR, NEAR = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), np.zeros((2, 3))
IDS = np.array(["a", "b"], object)
NAMES = [f"p{k}" for k in range(9)]


def jump(body: str) -> Ns:
    """Return a jump of one body."""
    return Ns(
        body=body, labels=["x"], sizes=[2.0], sigmas=[0.1], units=["um"], after=0, until=60, log_ratio=9, rivals={}
    )


def fit(**values: float) -> Ns:
    """Return a fit of an interior orientation whose sigmas are 1e-5 m."""
    return Ns(value=lambda name: values.get(name, 5.5), sigma=lambda _: 1e-5)


BLOCK = Ns(
    adjustment=Ns(
        assembly=Ns(block=Ns(points=Ns(ids=IDS, start=FAR))), groups={"gps": Ns(p_value=1e-3, ratio=4.0)}, p_value=1e-3
    ),
    rejected=[],
    datum=Ns(east=1.0, north=-2.0, up=3.0),
    datum_chance=1e-3,
    laws=[],
    network=Ns(empty=[], alone=[], parts=[["A"]], controlled=[True]),
)
LAW = type("Law", (), {"p_value": 0.9e-3, "__str__": lambda _: "readings are alike"})()
CHECK = Ns(wrong={"nadir": ()}, factor=2.0, readings=Ns(ground=Ns(accuracy=0.1), platform=Ns(earth=1)))
LINE = Ns(accepted=np.ones(1, bool), moved=np.array([10.0, -20.0]))
MATCH = Ns(
    setup=Ns(test=Ns(points=Ns(reach=40))), points=Ns(sorts={"c": Ns(kind="map", lines={"nadir": LINE})}), accuracy=0.1
)
EXPORT = Ns(
    source=Ns(scene=Ns(read=Ns(inertial_velocity=False, light_speed=False))),
    lines={"nadir": Ns(polynomial=Ns(error_px=(0.1, 0.05)), refused="too steep")},
)
CORRECTION = Ns(probability=1e-3, factor=4.0, freedom=1, used=np.array([True, True]))
QUALITY = Ns(products={"nadir": Ns(most=1.0)}, control={})
CONTROLLED = Ns(names=IDS, polynomial=Ns(correction=CORRECTION))
REJECTED = Ns(entered=100, left=90, points=(), check_points=(), factors={"nadir": 2.0})
PASS = Ns(name="P", control_ground=FAR[:1], check_ground=FAR[1:], control_ids=IDS[:1], check_ids=IDS[1:])
CALIBRATION = Ns(
    together=Ns(names=["nadir f"], from_start=np.array([0.5])),
    campaign=Ns(
        spec=Ns(effects=Ns(corrected=True)), effects=Ns(names=("aberration",)), rejected={"P": REJECTED}, passes=(PASS,)
    ),
    surprises=(),
    drift=None,
    chip_steps=(),
    truth=None,
    fields={"P": Ns(adjustment=None)},
    meeting=Ns(degrees_of_freedom=30, p_value=1e-3),
)
SURPRISES = tuple(Ns(name=n, change=c, ratio=5.0) for n, c in (("P roll", 2e-4), ("nadir f", 1e-4)))
STRIP = Ns(
    residual=np.array([0.0, 4.0]), normal=np.array([0.0, 0.0, 1.0]), strip=Ns(covariance=np.tile(np.eye(3), (2, 1, 1)))
)
ANGLE = Ns(
    flight=Ns(spec=Ns(effects=Ns(corrected=False), errors=Ns(datum=(0.0, 0.0, 0.0))), effects=Ns(names=())),
    passes=(
        Ns(
            name="P",
            pairs=["alpha"],
            ids={"nadir": NAMES},
            measurement=Ns(strips=["nadir"]),
            estimate=Ns(angles={"tls": Ns(folded=[False])}, planes={"tls": [STRIP]}, resection=Ns(p_value=1e-3)),
        ),
    ),
)
MONITOR = Ns(
    setup=None,
    flight=Ns(doubts=(), smoothed={60.0: Ns(jumps=())}, spec=Ns(interval=60.0)),
    cases={"monitored": Ns(camera_height_rms=1.0), "none": Ns(camera_height_rms=1.0)},
)
DISTORTION = Ns(
    compensated=Ns(fit=fit(constant=0.3e-5), zero=1e-5),
    truth=Ns(gross=np.array([True]), means=None),
    means=Ns(keep=np.array([False])),
    bench=Ns(true_offset=np.array([0.0, 1e-7]), design_offset=np.zeros(2), turn=np.array([0.0, 0.0201])),
    readings=Ns(file=Ns(doubts=[]), numbered=True),
    reading=np.zeros((3, 2)),
    test=Ns(measured=Ns(reversed=False, zero=1.0)),
    about=5.5 / 1.04999,
    compensation=1,
    data={"probability": 1e-3, "noise": {"white_compensated_um": 0.2}},
)
FOCUS = Ns(
    chi_square=(27.87, 9),
    states=[Ns(skew=(3.2905e-6, 1e-6), level=0)],
    shimmings=[Ns(vertex_error=1e-6)],
    readings=Ns(file=Ns(doubts=[]), excluded=(), uneven=()),
    edges=("along", "track"),
    data={"plane": {"degrees_of_freedom": 1}},
)
ROW = Ns(line=7, file="mtf.csv", reason="far off")
TABLE = Ns(
    too_few=(),
    held_out=1,
    series=Ns(angle=np.radians(np.arange(90.0, 96.0))),
    tables=[Ns(file=Ns(doubts=[]))],
    data={"heldout_chi_square": 27.87, "heldout_degrees_of_freedom": 9, "suspect_angles": 0},
)
DRIFT = Ns(
    assumed=None, seconds=30.0, course_p_value=1e-5, rate_p_value=None, most=("x", 2.0), unseen_sigmas=3.0, seen=None
)

QUIET: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "block": (BLOCK, block_report._warnings),
    "check": (CHECK, check_report._warnings),
    "match": (MATCH, match_report._warnings),
    "simulate": (Ns(patch=Ns(images={"nadir": Ns(saturated=0)})), simulate_report._warnings),
    "export": (EXPORT, export_report._warnings),
    "quality": (QUALITY, quality_sections.quality_warnings),
    "control": (
        Ns(products={}, control={"nadir": CONTROLLED}),
        lambda run: quality_sections.quality_warnings(run)[:-1],
    ),
    "calibration": (CALIBRATION, calibration_report._warnings),
    "drift": (
        DRIFT,
        lambda drift: influences.drift_warnings(Ns(spec=Ns(errors=Ns(star_tracker=Ns(drift=None)))), drift),
    ),
    "steps": (
        Ns(all=(Ns(found=False, line="nadir", axis="x", step=2e-6, sigma=1e-7, place=0.01),)),
        lambda run: influences.step_warnings(run.all),
    ),
    "angle": (ANGLE, angle_report._warnings),
    "monitor": (MONITOR, monitoring_report._warnings),
    "distortion": (DISTORTION, lambda run: distortion_report._warnings(run, run.data)),
    "focus": (FOCUS, lambda run: focus_report._warnings(run, run.data)),
    "turntable": (TABLE, lambda run: turntable_report._warnings(run, run.data)),
}
CASES: list[tuple[str, str, Any, str]] = [
    ("block", "adjustment.assembly.block.points.start", NEAR, "a = b; counted twice"),
    ("block", "rejected", [("p", "A/nadir")], "left out as gross errors: p in A/nadir"),
    ("block", "datum_chance", 0.9e-3, "+1.00 m east, -2.00 m north and +3.00 m up"),
    ("block", "laws", [LAW], "readings are alike"),
    ("block", "adjustment.groups.gps.p_value", 0.9e-3, "gps: residuals are 2 times as large as stated"),
    ("block", "adjustment.p_value", 0.9e-3, "the block as a whole contradicts"),
    ("block", "network.empty", ["A"], "scenes without image points: A"),
    ("block", "network.alone", ["A"], "scenes that share no point with another: A"),
    ("block", "network", Ns(empty=[], alone=[], parts=[["A"], ["B"]], controlled=[True, False]), "A; B (no control)"),
    ("check", "wrong", {"nadir": NAMES}, "gross errors in nadir: p0, p1"),
    ("check", "factor", 2.01, "residuals are 1.4 times as large"),
    ("check", "readings.ground.accuracy", None, "is not stated by its authority"),
    ("check", "readings.ground.accuracy", 0.11, "good to 0.11 m only"),
    ("check", "readings.platform.earth", None, "no Earth orientation was given"),
    ("match", "points.sorts.c.lines.nadir.moved", np.array([0.0, -20.1]), "near the end of the reach"),
    ("match", "accuracy", None, "is not stated by its authority"),
    ("match", "accuracy", -1.0, "is not stated by its authority"),
    ("match", "accuracy", 0.11, "good to 0.11 m only"),
    ("simulate", "patch.images.nadir.saturated", 1, "saturated pixels in nadir"),
    ("export", "source.scene.read.inertial_velocity", True, "against the stars"),
    ("export", "source.scene.read.light_speed", True, "LIGHT_SPEED_SETTING"),
    ("export", "lines.nadir.polynomial", None, "nadir has no rational polynomials: too steep"),
    ("export", "lines.nadir.polynomial.error_px", (0.05, 0.11), "off by up to 0.11 pixels"),
    ("quality", "products.nadir.most", 1.01, "off the rigorous model of nadir by up to 1"),
    ("quality", "control", {"nadir": CONTROLLED}, "the correction by control points stands in the polynomials"),
    ("control", "control.nadir.polynomial.correction.used", np.array([True, False]), "are left out: b"),
    ("control", "control.nadir.polynomial.correction.probability", 0.9e-3, "scatter by 2.0 times their sigmas"),
    ("control", "control.nadir.polynomial.correction.freedom", 0, "no control point of nadir is left over"),
    ("calibration", "surprises", SURPRISES, "P roll has changed by 41.3 arcsec, 5.0 times"),
    ("calibration", "surprises", SURPRISES[1:], "nadir f has changed by 100 µm"),
    ("calibration", "together.from_start", np.array([0.51]), "nadir f: known from launch.bias"),
    ("calibration", "campaign.spec.effects.corrected", False, "are left in the image points"),
    ("calibration", "campaign.rejected.P.points", (("p", "nadir"),), "P: left out as gross errors: p in nadir"),
    ("calibration", "campaign.rejected.P.check_points", ("c",), "P: left out as gross errors: c"),
    ("calibration", "campaign.rejected.P.left", 89, "P: 11 of 100 image points were left out"),
    ("calibration", "campaign.rejected.P.factors", {"nadir": 2.1}, "by factors of nadir 2.1"),
    ("calibration", "campaign.passes", (Ns(**vars(PASS) | {"check_ground": FAR[:1]}),), "a = b"),
    ("calibration", "meeting.p_value", 0.9e-3, "rays of the check points do not meet"),
    ("drift", "assumed", Ns(rate=np.array([1e-6, 2e-6]), walk=1e-6), "the attitude drifts during the passes"),
    ("drift", "unseen_sigmas", 3.1, "nothing is said of a drift of the attitude"),
    ("steps", "all.0.found", True, "nadir x +2.0 ± 0.1 µm at 10.0 mm"),
    ("angle", "flight.effects.names", ("aberration",), "the analysis leaves aberration in the points"),
    ("angle", "flight.spec.errors.datum", (0.0, 1.0, 0.0), "the points share a shift"),
    ("angle", "passes.0.estimate.angles.tls.folded", [True], "are parallel within their noise"),
    ("angle", "passes.0.estimate.planes.tls.0.residual", np.array([0.0, -9.0]), "the farthest p1 of nadir, 9 σ"),
    ("angle", "passes.0.estimate.resection.p_value", 0.9e-3, "the resection does not fit"),
    ("monitor", "flight.doubts", ("a doubt",), "a doubt"),
    ("monitor", "flight.smoothed", {60.0: Ns(jumps=(jump("base"),))}, "base jumped"),
    ("monitor", "cases.none.camera_height_rms", 0.99, "monitoring makes heights worse"),
    ("distortion", "means.keep", np.array([True]), "that stay in the means: 1"),
    ("distortion", "bench.true_offset", np.array([0.0, 1.1e-7]), "as-built coma that grows over the field"),
    ("distortion", "readings.file.doubts", ["copied rows"], "copied rows"),
    ("distortion", "readings.numbered", False, "spots of a point have no set numbers"),
    ("distortion", "compensated.fit", fit(constant=0.31e-5), "the line's middle is imaged 2.06 arcsec from `zero`"),
    ("distortion", "about", 5.5 / 1.0501, "are the units of angles and places right?"),
    ("distortion", "about", 5.5 / 0.9499, "are the units of angles and places right?"),
    ("distortion", "data.probability", 0.9e-3, "the excess, 0.20 µm"),
    ("distortion", "compensation", None, "no calibration of the turntable"),
    ("focus", "chi_square", (27.88, 9), "are too small by about 1.8"),
    ("focus", "states.0.skew", (-3.2906e-6, 1e-6), "all places may stand -3.3 ± 1.0 µm from"),
    ("focus", "readings.excluded", (ROW,), "1 rows do not count (lines 7 of mtf.csv)"),
    ("focus", "readings.uneven", (ROW,), "1 images have a sigma that does not hold"),
    ("focus", "readings.file.doubts", ["copied rows"], "copied rows"),
    ("focus", "edges", ("along",), "one direction only"),
    ("focus", "states.0.level", None, "the line's level was not read"),
    ("focus", "data.plane.degrees_of_freedom", 0, "three places give a plane and nothing to judge it by"),
    ("turntable", "too_few", ("network",), "too few angles for"),
    ("turntable", "held_out", None, "no held-out readings"),
    ("turntable", "data.heldout_chi_square", 27.88, "by chance once in 100"),
    ("turntable", "series.angle", np.radians([90.0, 91.0, 92.0, 93.0, 99.0]), "compensated: 93 to 99 deg"),
    ("turntable", "tables.0.file.doubts", ["copied rows"], "copied rows"),
    ("turntable", "data.suspect_angles", 2, "more than their number allows: 2"),
]
"""Report, path of what changes, its value, and words of the warning."""


def put(run: Any, path: str, value: Any) -> None:
    """Change the value at a path of attributes, keys and numbers."""
    *way, last = path.split(".")
    for name in way:
        run = run[int(name)] if name.isdigit() else run[name] if isinstance(run, dict) else getattr(run, name)
    if isinstance(run, dict):
        run[last] = value
    else:
        setattr(run, last, value)


@pytest.fixture(autouse=True)
def any_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds of runs are told by their classes, and some parts have tests of their own."""
    for module, name in (
        (export_report, "SceneSource"),
        (angle_report, "SimulatedAngleRun"),
        (distortion_report, "SimulatedDistortion"),
        (distortion_report, "MeasuredDistortionSpec"),
        (influences, "MeasuredCalibrationSpec"),
    ):
        monkeypatch.setattr(module, name, Ns)
    for module, name in ((calibration_report, "CALIBRATION"), (monitoring_report, "MONITOR")):
        monkeypatch.setattr(module, name, Ns(warnings=lambda run: []))
    for name in ("drift_warnings", "step_warnings"):
        monkeypatch.setattr(calibration_report, name, lambda *_: [])
    monkeypatch.setattr(calibration_report, "any_effect", lambda effects: bool(effects.names))
    monkeypatch.setattr(calibration_report, "meeting_of", lambda campaign, *_: campaign.meeting)


@pytest.mark.parametrize("name", QUIET)
def test_every_warning_is_told_when_and_only_when_it_holds(name: str) -> None:
    """Nothing is told of a run that needs no warning, and one sentence of each that does."""
    quiet, warnings = QUIET[name]
    if name == "calibration":
        quiet.campaign.meeting = quiet.meeting
    assert list(warnings(copy.deepcopy(quiet))) == []
    for _, path, value, words in (case for case in CASES if case[0] == name):
        run = copy.deepcopy(quiet)
        put(run, path, value)
        told = list(warnings(run))
        assert len(told) == 1, (path, told)
        assert words in told[0], (path, told)


def test_tables_of_accuracy_and_control_have_their_units() -> None:
    """Places in degrees, sigmas as roots of variances, the correction with its sigma, and residuals with theirs."""
    seen = np.array([True, True, False])
    places = {"longitude": np.radians([116.0, 117.0, 0.0]), "latitude": np.radians([40.0, 41.0, 0.0]), "height": 300.0}
    covariance = np.array([np.diag([4.0, 9.0, 16.0])] * 3)
    errors = {"ce90": np.array([5.0, 7.0, 99.0]), "le90": np.array([2.0, 3.0, 99.0]), "covariance": covariance}
    numbers = {"line": np.array([1.0, 2.0, 0.0]), "pixel": np.array([3.0, 4.0, 0.0]), "horizontal": lambda: (1.5, 0.5)}
    maps = {"nadir": Ns(seen=seen, **places, **errors, **numbers)}
    table, _, grid = quality_sections._map_section(maps).artefacts
    assert table.rows == [("nadir", 6.0, 7.0, 2.5, 3.0, 1.5, 0.5)]
    assert grid.rows[0] == pytest.approx(("nadir", 1.0, 3.0, 116.0, 40.0, 300.0, 5.0, 2.0, 2.0, 3.0, 4.0))
    assert [row[3] for row in grid.rows] == pytest.approx([116.0, 117.0])
    at, spread = np.array([[3.0, -4.0]]), np.array([np.diag([0.04, 0.25])])
    correction = Ns(at=lambda *_: at, covariance_at=lambda *_: spread, middle=(0.0, 0.0), chi_square=5.0, freedom=2)
    correction = Ns(**vars(correction), residual=np.array([[0.1, 0.2]]), used=np.array([False]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality_sections, "residual_sigma", lambda _: np.array([[0.3, 0.4]]))
        control = {"nadir": Ns(polynomial=Ns(correction=correction), names=IDS[:1])}
        table, full = quality_sections.control_section(control).artefacts
    assert table.rows == [("nadir", 3.0, pytest.approx(0.2), -4.0, pytest.approx(0.5), 5.0, 2)]
    assert full.rows == [("nadir", "a", 0.1, 0.3, 0.2, 0.4, "left out")]


def test_sentences_of_accuracy_and_residuals_name_their_own_numbers() -> None:
    """Points that are used, the bias after the correction, the largest CE90 and the LE90 of intersected points."""
    correction = Ns(used=np.array([True, False]), kind="shift")
    polynomial = Ns(correction=correction, before=Ns(bias_m=9.0), after=Ns(bias_m=0.25))
    maps = {
        TOGETHER: Ns(ce90=np.array([1.0, 2.0]), le90=np.array([3.0, np.nan])),
        "nadir": Ns(ce90=np.array([4.0, np.nan])),
    }
    first, second, third = quality_answers(Ns(control={"nadir": Ns(polynomial=polynomial, names=IDS)}, maps=maps))
    assert first.startswith("1 of 2 control points correct the polynomials of nadir by a shift, to 0.25 m")
    assert second == "CE90 is at most 4.00 m, of points of nadir"
    assert third == "LE90 of intersected points is at most 3.00 m"
    assert residual_sigma(Ns(variance=np.array([[[4.0, 1.0], [1.0, 9.0]]]))) == pytest.approx(np.array([[2.0, 3.0]]))


def test_verdicts_among_the_numbers_warn_when_they_are_false() -> None:
    """Fit and stepwise solution of a calibration, the monitor's scatter, its shifts and its smoothed heights."""
    spec = Ns(errors=Ns(switched_on=True), setup=None)
    run = Ns(together=Ns(p_value=1e-3), campaign=Ns(spec=spec, simulated=Ns(drift=())), truth=None)
    assert FIT["agrees"].of(run) is True
    run.together.p_value = 0.9e-3
    assert FIT["agrees"].of(run) is False
    assert "a chi-square as large has a chance of 0.0009; biases" in FIT["agrees"].warning(run)
    spec.errors.switched_on = False
    assert FIT["agrees"].of(run) is None
    right = Ns(agrees=True, spread=3.0, sigma=2.0, limits=(0.8, 1.2), chi_square=9.5, limit=8.25, furthest=5.0)
    wrong = Ns(**vars(right) | {"agrees": False})
    for verdict, whole, part, words in (
        (STEPWISE["converged"], "stepwise", None, "has not settled after 7 rounds"),
        (PROPAGATION["agrees"], "scatter", None, "ratio 1.5, limits 0.80 to 1.20"),
        (SMOOTHING["shifts_agree"], "smoothed", "consistency", "contradict the prior: chi-square 9.5, limit 8.25"),
        (SMOOTHING["agrees"], "smoothed", None, "wrong by up to 5 of their sigma, limit 8.25"),
    ):
        for one, value in ((right, True), (wrong, False)):
            found = Ns(**vars(one), converged=value, rounds=7)
            run = Ns(**{whole: found if part is None else Ns(**{part: found})})
            assert verdict.of(run) is value
            assert words in verdict.warning(run)
