"""``twin.orbit adjust``: what the command says of blocks that are right, and of blocks that are not."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.specs.load import SCENES
from scenes.specs.orbit.setup import AdjustSetup, MeasuredCalibrationSetup, without_sensors
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import InputError
from twin.framework.procedure import BenchError
from twin.orbit.block.block_report import block_report
from twin.orbit.block.block_run import ALL, TIES_ALONE, run_adjustment
from twin.orbit.block.measured_block import change_covariance, measured_block
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign_adjustment import simultaneous

FILE = SCENES / "orbit" / "adjust.yaml"


def setup(tmp_path=None, *changes):
    """The shipped block with fewer points, and texts of its file replaced."""
    text = FILE.read_text("utf-8").replace("tie: 120, check: 60", "tie: 40, check: 30")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    if tmp_path is None:
        return AdjustSetup.read(FILE)
    file = tmp_path / "adjust.yaml"
    file.write_text(text, "utf-8")
    return AdjustSetup.read(file)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return run_adjustment(setup(tmp_path_factory.mktemp("block")), None, 3)


@pytest.mark.second
def test_errors_of_check_points_are_those_predicted_and_every_sensor_helps(run):
    assert 0.3 < run.contributions[ALL].normalised_squared_error < 2.0
    full = run.contributions[ALL].predicted
    for name, one in run.contributions.items():
        # less is known without a sensor; rounding of the quantiles
        assert one.predicted.ce90 > full.ce90 * (1 - 1e-6), name
        assert one.predicted.le90 > full.le90 * (1 - 1e-6), name
    assert run.contributions["without control"].predicted.ce90 > 2 * full.ce90
    assert run.contributions[TIES_ALONE].predicted.le90 > 3 * full.le90
    assert run.adjustment.p_value > 1e-4
    report, observed = block_report(run), run.contributions[ALL].observed
    assert report.warnings == ()
    assert f"; observed are {observed.ce90:.2f} m and {observed.le90:.2f} m" in report.verdict
    (ground,) = (section for section in report.sections if section.name == "ground")
    assert [artefact.file for artefact in ground.artefacts] == ["artefacts/ground.svg"]
    small = replace(observed, ce90=0.2 * full.ce90, le90=0.1 * full.le90)
    found = replace(run.contributions[ALL], observed=small)
    verdict = block_report(replace(run, contributions={**run.contributions, ALL: found})).verdict
    assert "at most 0.2 of the prediction, which covers errors common to all points" in verdict


@pytest.mark.second
def test_cameras_are_found_within_their_sigmas(run):
    ratio = np.array([(c.value - c.truth) / c.sigma for c in run.cameras.values()])
    # 16 normals: beyond 4 by chance in 1 of 1000 blocks
    assert np.max(np.abs(ratio)) < 4.0
    assert all(np.all(c.sigma < c.before) for c in run.cameras.values())


@pytest.mark.second
def test_readings_of_another_law_are_told(tmp_path):
    said = FILE.read_text("utf-8")
    laws = said[said.index("errors:\n") : said.index("angles:")]
    true = laws.replace("errors:", "truth:").replace(
        "{law: white, sigma: [0.5 arcsec, 0.5 arcsec, 1 arcsec], interval: 1 s}",
        "{law: walk, sigma: [1 arcsec, 1 arcsec, 1 arcsec], interval: 1 s}",
    )
    wrong = run_adjustment(setup(tmp_path, ("\nangles:", "\n" + true + "angles:")), None, 3)
    told = " ".join(block_report(wrong).warnings)
    assert "readings: errors that should be independent in a white process are positively correlated" in told


@pytest.mark.second
def test_gross_errors_are_left_out_by_name(tmp_path):
    found = run_adjustment(setup(tmp_path, ("image: 0.2", "image: 0.2, gross: 0.1, gross_size: 20")), None, 3)
    ids = found.drawn.block.points.ids
    bad = {(str(ids[p]), scene) for scene, points in found.drawn.gross.items() for p in points}
    told = set(found.rejected)
    assert len(bad) > 8
    # an error along the ray of the other scenes is absorbed by the point's height
    assert len(bad - told) <= 0.2 * len(bad)
    assert 0.3 < found.contributions[ALL].normalised_squared_error < 2.0
    assert any(w.startswith("rejected as gross errors: ") for w in block_report(found).warnings)


@pytest.mark.second
def test_a_wrong_datum_is_told(tmp_path):
    found = run_adjustment(setup(tmp_path, ("seed: 1", "seed: 1\ndatum: [80 m, 0 m, -20 m]")), None, 3)
    assert found.datum.east == pytest.approx(80.0, abs=4 * found.datum.sigma[0])
    assert found.datum.up == pytest.approx(-20.0, abs=4 * found.datum.sigma[2])
    assert any("another datum" in w for w in block_report(found).warnings)


def test_sensors_that_are_not_there_are_refused():
    with pytest.raises(InputError, match="no such sensor; did you mean 'control'"):
        without_sensors(AdjustSetup.read(FILE), ["controls"])


def test_scenes_that_share_no_ground_are_an_error_with_a_key(tmp_path):
    text = FILE.read_text("utf-8")
    backward = text[text.index("  backward:\n") : text.index("monitor: {angles")]
    one = (("lines: [forward, backward]", "lines: [forward]"), (backward, ""))
    alone = setup(tmp_path, *one, ("longitude: 117.4 deg, ", "longitude: 120 deg, "))
    with pytest.raises(BenchError, match=r"only 0 of .* candidate points of the area are seen by two scenes"):
        run_adjustment(alone, None, 1)


def test_covariance_of_changes_holds_all_three_laws():
    spec = setup().test.changes["forward"]
    walk = spec.walk.model_copy(update={"angles": (1e-6, 0.0, 0.0)})
    spread = change_covariance(spec.model_copy(update={"walk": walk}), np.array([0.0, 4.0, 9.0]))
    lasting, each = spec.lasting.angles[0] ** 2, spec.each_pass.angles[0] ** 2
    assert spread[0, 0] == pytest.approx(lasting + each)
    assert spread[8, 8] == pytest.approx(lasting + each + 9e-12)
    assert spread[4, 8] == pytest.approx(lasting + 4e-12)
    assert spread[4, 9] == 0.0


MEASURED = SCENES / "orbit" / "measured" / "adjust.yaml"


@pytest.mark.second
def test_measured_passes_as_their_calibration_has_them():
    """The tables of the shipped campaign: an image point of a control and one of a check point were moved."""
    found = run_adjustment(PROCEDURES["orbit adjust"].resolve(MEASURED), None, 0)
    assert found.drawn is None
    assert set(found.rejected) == {("Beijing c4", "Beijing/forward"), ("Beijing k39", "Beijing/nadir")}
    assert 0.5 < found.contributions[ALL].normalised_squared_error < 1.6
    assert found.adjustment.p_value > 1e-3
    assert len(found.network.parts) == 2
    assert found.contributions["without control"].predicted.le90 > 20 * found.contributions[ALL].predicted.le90
    # the same passes calibrated by the campaign's adjustment: the principal distances agree
    calibrated = simultaneous(source_of(MeasuredCalibrationSetup.read(MEASURED.with_name("calibrate.yaml")), None))
    for line in ("forward", "nadir", "backward"):
        change = found.cameras[f"Beijing/{line}"]
        laboratory = found.adjustment.assembly.block.cameras[line].interior[0]
        apart = laboratory + change.value[3] - calibrated.value(f"{line} f")
        assert abs(apart) < 2.0 * calibrated.sigma[f"{line} f"]


def test_monitor_readings_of_measured_passes_hold_the_cameras(tmp_path):
    text = MEASURED.read_text("utf-8").replace("data: .", f"data: {MEASURED.parent}")
    reading = "{angles: [1 arcsec, 2 arcsec, 3 arcsec], principal_distance: 20 um}"
    monitor = (
        "monitor:\n  angles: [0.1 arcsec, 0.1 arcsec, 0.1 arcsec]\n  principal_distance: 0.1 um\n"
        f"  readings: {{Anhui: {{nadir: {reading}}}}}\n"
    )
    file = tmp_path / "adjust.yaml"
    file.write_text(text + monitor, "utf-8")
    block, given = measured_block(PROCEDURES["orbit adjust"].resolve(file))
    setup_ = PROCEDURES["orbit adjust"].resolve(file)
    known = {name: change for name, change in setup_.test.changes.items() if name != "nadir"}
    setup_ = setup_.model_copy(update={"test": setup_.test.model_copy(update={"changes": known})})
    with pytest.raises(BenchError, match="the prior changes of nadir are missing"):
        measured_block(setup_)
    known = block.monitored["nadir"]
    # what lasts is read in one pass and known in both, to the reading's sigma
    assert known.mean[0, 3] == pytest.approx(20e-6, rel=1e-3)
    assert np.sqrt(known.covariance[3, 3]) == pytest.approx(0.1e-6, rel=1e-3)
    assert np.allclose(block.monitored["forward"].covariance, block.known["forward"].covariance)
    assert np.isfinite(given[block.points.role == "check"]).all()
