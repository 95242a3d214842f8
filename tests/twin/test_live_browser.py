"""The live twin as a user meets it: the command, a real browser, and what twin.render makes of the same knobs."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from scenes.specs.load import load_camera
from scenes.specs.resolved import resolve
from tests.twin.live_page import CHROMIUM, FLAGS, Command, Page, running
from twin.camera.camera_optics import CameraOptics
from twin.framework.run_folder import RunFolder, write_manifest
from twin.main_job.monitor_reading import rounded
from twin.main_job.render_job import render_job
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytestmark = [pytest.mark.second, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]

M2 = "base/forward/M2"
DESPACE = f"{M2} shift z"
TURN = "base/backward/focal_plane rotate z"


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra `test`)")
    with playwright.sync_playwright() as made:
        browser = made.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def command():
    with running("gf7_pair", "--port", "0", "--stay") as command:
        yield command


@pytest.fixture
def page(browser, command):
    """A page with M2 unfolded; whatever a test does, nothing may be wrong on it."""
    page = Page(browser, command.address)
    page.ready()
    page.unfold("base/forward", M2)
    yield page
    page.close()
    assert page.wrong == []


def job_of(page: Page, tmp_path, button: str = "#save-job"):
    """The file that a button saves."""
    with page.page.expect_download() as waited:
        page.page.click(button)
    place = tmp_path / waited.value.suggested_filename
    waited.value.save_as(place)
    return place


def canvas(page: Page, channel: str) -> np.ndarray:
    """Grey levels of a spot's canvas."""
    text = page.page.evaluate(
        """(channel) => {
        const c = document.querySelector(`canvas[data-channel="${channel}"]`);
        const all = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        return Array.from(all.filter((_, k) => k % 4 === 0)); }""",
        channel,
    )
    side = int(len(text) ** 0.5)
    return np.array(text).reshape(side, side)


def test_dragging_the_despace_moves_the_spots_as_twin_render_does(page, backend, tmp_path):
    """Canvas, table and 3-D view against a run of the job that the page saves."""
    initial_state = page.page.evaluate(f"liveTwin.scene.position('{M2}')")
    page.drag(DESPACE, 25.0)
    page.still()
    value = page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']")
    assert value > 1.0
    run = render_job(resolve(job_of(page, tmp_path)), backend)
    assert run.resolved.job.perturb[M2].shift[2] == pytest.approx(1e-6 * value, rel=1e-12)
    page.page.select_option("#crop", "whole")
    told = page.page.evaluate("liveTwin.last")
    assert told["readings"] == json.loads(json.dumps(rounded(run.recovered_dict())))
    assert told["truth"] == json.loads(json.dumps(run.truth_dict()))
    top, floor = int(run.before[:, 0].max()), page.page.evaluate("liveTwin.hello.offset")
    for k, channel in enumerate(run.experiment.path.channels):
        share = np.clip((run.after[k, 0] - floor) / (top - floor), 0.0, 1.0)
        # grey levels are rounded halves up
        assert np.array_equal(canvas(page, channel.key), np.floor(255 * share + 0.5))
    shown = page.page.locator("#readings tbody tr", has_text="Δf").first.locator("td").all_text_contents()
    true = run.truth_dict()["cameras"]["forward"]["d_f_um"]
    assert float(shown[1].replace("−", "-")) == pytest.approx(true, abs=0.5 * 10.0 ** -len(shown[1].partition(".")[2]))
    moved = page.page.evaluate(f"liveTwin.scene.position('{M2}')")
    factor = float(page.page.text_content("#factor-value").replace(",", ""))
    distance = np.linalg.norm(np.subtract(moved, initial_state))
    # the factor is shown with two digits; the view is in single precision
    assert distance == pytest.approx(1e-6 * value * factor, rel=0.06)


def test_blind(page):
    """What is hidden is in nothing that the page was told, until it is revealed."""
    page.page.click("#blind")
    page.until("liveTwin.blind && liveTwin.last.guess")
    page.still()
    told = page.page.evaluate("liveTwin.last")
    assert "truth" not in told
    assert "motions" not in told
    row = page.page.locator("#readings tbody tr", has_text="Δα").first.locator("td").all_text_contents()
    assert row[1] == "–"
    page.page.select_option("#show", "guess")
    page.number(DESPACE).fill("3")
    page.still()
    page.page.click("#blind")
    page.until("document.getElementById('revealed').open")
    text = page.page.text_content("#revealed")
    assert "σ" in text
    assert "truly" in text
    page.page.keyboard.press("Escape")
    page.still()
    assert "truth" in page.page.evaluate("liveTwin.last")


def test_record_and_repeat(page, backend, tmp_path):
    page.page.click("#record")
    page.until("document.getElementById('record').getAttribute('aria-pressed') === 'true'")
    for value in ("1", "2", "3.5"):
        page.number(DESPACE).fill(value)
        page.still()
    shown = page.page.evaluate("liveTwin.last.truth.cameras.forward.d_f_um")
    page.page.click("#record")
    page.until("!document.getElementById('save-course').disabled")
    run = render_job(resolve(job_of(page, tmp_path, "#save-course")), backend, frames=2)
    assert run.series is not None
    assert len(run.series.times) >= 3
    assert run.series.readings.row("forward", "d_f_um", "model").true[-1] == pytest.approx(shown, abs=1e-7)


def test_a_run_of_a_study_and_a_study_are_opened(browser, tmp_path):
    with RunFolder(tmp_path / "study") as made:
        made.write_text("config.yaml", resolve_study("scenes/examples/study_aperture.yaml").to_yaml())
        write_manifest(made, "twin.study", 0.0, 1.0)
    with running(str(tmp_path / "study"), "--run", "1234", "--port", "0") as command:
        page = Page(browser, command.address)
        page.ready()
        plan = Plan.of(resolve_study(tmp_path / "study" / "config.yaml"))
        for column in plan.columns:
            row = page.page.locator("#factors .knob", has_text=column.name).locator("input.number").first
            assert float(row.input_value()) == pytest.approx(float(column.values[1234]))
        assert page.page.inner_text("#opened") == "study, run 1234"
        assert "run 1234 of the study study_aperture" in page.page.get_attribute("#opened", "title")
        assert page.wrong == []
        page.close()
    with running("scenes/examples/study_aperture.yaml", "--port", "0") as command:
        page = Page(browser, command.address)
        page.ready()
        row = page.page.locator("#factors .knob", has_text="turn").locator("input.number").first
        row.fill("4")
        page.still()
        assert page.page.evaluate(f"liveTwin.knobs.knobs['{TURN}']") == 4.0
        aperture = page.page.locator("#factors .knob", has_text="aperture").locator("input.number").first
        sigma = "liveTwin.last.readings.cameras.forward.model.d_f_um_sigma_noise"
        before = page.page.evaluate(sigma)
        aperture.fill("30")
        aperture.press("Enter")
        page.until(f"{sigma} > 1.2 * {before}", 40.0)
        assert page.wrong == []
        page.close()


def test_the_page_comes_back_after_a_restart(browser):
    secret = {"TWIN_LIVE_TOKEN": "a-token-that-stays-the-same"}
    first = Command("gf7_pair", "--port", "0", **secret)
    port = re.search(r":(\d+)/", first.address)
    assert port is not None
    page = Page(browser, first.address)
    page.ready()
    page.unfold("base/forward", M2)
    page.number(DESPACE).fill("2")
    page.still()
    before = page.page.evaluate("liveTwin.last.readings")
    assert first.end() == 0
    page.until("document.getElementById('status').classList.contains('bad')")
    with running("gf7_pair", "--port", port[1], **secret):
        page.until("!document.getElementById('status').classList.contains('bad')", 40.0)
        page.still()
        assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == 2.0
        assert page.page.evaluate("liveTwin.last.readings") == before
    page.close()


def test_a_camera_is_designed_and_saved(browser, backend, tmp_path):
    """Turned, undone, redone, at a design without light, and saved, on a phone's width."""
    rms = "liveTwin.last.optics.wavefront.rms_waves"
    with running("gf7", "--port", "0") as command:
        page = Page(browser, command.address, 390, 844)
        page.ready()
        page.unfold("design", "design/M1", "design/M2")
        first = page.page.evaluate(rms)
        page.drag("design/M2 radius", 20.0)
        page.still()
        turned = page.page.evaluate(rms)
        assert turned > first + 0.1
        assert f"{turned:.4f} waves rms" in page.page.inner_text("#optics-wavefront")
        # the middle of every canvas is drawn on
        for name in ("layout", "wavefront", "spot", "psf", "mtf"):
            pixels = f"""(() => {{ const c = document.querySelector('#optics-{name} canvas');
                return new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size; }})()"""
            assert page.page.evaluate(pixels) > 3, name
        page.page.click("#undo")
        page.still()
        assert page.page.evaluate(rms) == first
        page.page.click("#redo")
        page.still()
        assert page.page.evaluate(rms) == turned
        with page.page.expect_download() as waited:
            page.page.click("#save-camera")
        waited.value.save_as(tmp_path / "camera.yaml")
        saved = CameraOptics.alone(load_camera(tmp_path / "camera.yaml"), backend)
        assert saved.wavefront((0.0, 0.0)).rms == pytest.approx(turned, rel=1e-9)
        page.number("design/M1 conic").fill("90")
        page.still()
        assert "this state is impossible; shown is the last good state" in page.page.inner_text("#problem")
        assert f"{turned:.4f} waves rms" in page.page.inner_text("#optics-wavefront")
        assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert page.wrong == []
        page.close()
