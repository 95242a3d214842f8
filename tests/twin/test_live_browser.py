"""The live twin as a user meets it: the command, a real browser, and what twin.render makes of the same knobs."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes.specs.resolved import resolve
from tests.twin.live_page import CHROMIUM, FLAGS, Command, Page, running
from twin.main_job.monitor_reading import stated
from twin.main_job.render_job import render_job
from twin.run.run_folder import RunFolder, write_manifest
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra `test`)")
pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
pytestmark = [pytest.mark.second, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]

M2 = "base/forward/M2"
DESPACE = f"{M2} shift z"
TURN = "base/backward/focal_plane rotate z"


@pytest.fixture(scope="module")
def browser():
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


def test_the_page_loads_by_itself(page):
    assert page.page.url.endswith("/")  # the token left the address
    assert page.page.locator("#spots canvas.image").count() == 4
    assert page.page.title().startswith("gf7_pair")
    assert "ms" in page.page.text_content("#status")


def test_dragging_the_despace_moves_the_spots_as_twin_render_does(page, backend, tmp_path):
    """Canvas, table and 3-D view against a run of the job that the page saves."""
    at_rest = page.page.evaluate(f"liveTwin.scene.position('{M2}')")
    page.drag(DESPACE, 25.0)
    page.still()
    value = page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']")
    assert value > 1.0
    run = render_job(resolve(job_of(page, tmp_path)), backend)
    assert run.resolved.job.perturb[M2].shift[2] == pytest.approx(1e-6 * value, rel=1e-12)
    page.page.select_option("#crop", "whole")
    told = page.page.evaluate("liveTwin.last")
    assert told["readings"] == json.loads(json.dumps(stated(run.recovered_dict())))
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
    distance = np.linalg.norm(np.subtract(moved, at_rest))
    # the factor is shown with two digits; the view is in single precision
    assert distance == pytest.approx(1e-6 * value * factor, rel=0.06)


def test_a_filter_opens_what_fits_and_the_way_there(page):
    """M2 shows the knobs of both M2, not those of the bodies that carry them; an empty filter folds all as before."""
    shown = """[...document.querySelectorAll('#tree .knob')].filter((one) => one.checkVisibility())
        .map((one) => one.dataset.knob.split(' ')[0])"""
    page.page.evaluate("document.querySelectorAll('#tree details').forEach((one) => { one.open = false; })")
    page.page.fill("#filter", "m2")
    page.page.wait_for_timeout(100)
    assert set(page.page.evaluate(shown)) == {M2, "base/backward/M2"}
    page.page.fill("#filter", "back m2")
    page.page.wait_for_timeout(100)
    assert set(page.page.evaluate(shown)) == {"base/backward/M2"}
    page.page.fill("#filter", "central")
    page.page.wait_for_timeout(100)
    assert set(page.page.evaluate(shown)) == {"base/central_prism"}
    page.page.fill("#filter", "")
    page.page.wait_for_timeout(100)
    assert page.page.evaluate(shown) == []


@pytest.mark.parametrize(("typed", "value"), [("3,5", 3.5), ("3.5", 3.5), ("\N{MINUS SIGN}0,25", -0.25), ("1e-1", 0.1)])
def test_a_typed_number_has_a_point_or_a_comma(page, typed, value):
    field = page.number(DESPACE)
    field.press("Control+a")
    field.type(typed)
    field.press("Enter")
    page.still()
    assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == value
    field.press("ArrowUp")
    step = page.page.evaluate(f"liveTwin.knobs.rows.get('{DESPACE}')[0].step")
    assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == pytest.approx(value + step)


def test_what_is_no_number_is_marked_and_not_taken(page):
    field = page.number(DESPACE)
    field.fill("2")
    for typed in ("1.234,5", "2 um", "two", ""):
        field.fill(typed)
        assert field.get_attribute("aria-invalid") == "true"
        assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == 2
    page.page.fill("#frames", "3,5")
    assert page.page.get_attribute("#frames", "aria-invalid") == "true"


def test_spots_are_shown_near_and_fill_their_picture(page):
    """A picture shows the spot, not a CCD with a point of light in it; crosses leave its light free."""
    assert page.page.input_value("#crop") == "spot"
    grey = canvas(page, "forward/left")
    assert grey.shape[0] <= 32
    assert np.count_nonzero(grey > 25) > 0.03 * grey.size


def test_wide_tables_show_that_they_scroll(browser, command):
    """At the width of a phone a shadow lies at the edge behind which there is more; scrolled there it is gone."""
    page = Page(browser, command.address, 390, 844)
    page.ready()
    table = page.page.locator(".wide").first
    table.scroll_into_view_if_needed()
    assert table.evaluate("(one) => one.scrollWidth > one.clientWidth + 20")

    def edge(side: int) -> float:
        box = table.bounding_box()
        x = box["x"] + (1 if side < 0 else box["width"] - 4)
        clip = {"x": x, "y": box["y"] + 40, "width": 3, "height": box["height"] - 60}
        place = np.frombuffer(page.page.screenshot(clip=clip), np.uint8)
        return float(np.median(cv2.imdecode(place, cv2.IMREAD_GRAYSCALE)))

    assert edge(1) < 225.0 < 245.0 < edge(-1)
    table.evaluate("(one) => { one.scrollLeft = one.scrollWidth; }")
    page.page.wait_for_timeout(200)
    assert edge(-1) < 225.0 < 240.0 < edge(1)
    page.close()


def test_the_view_in_three_dimensions_does_not_hold_up_a_drag(page):
    """Without a graphics card it is slow to draw: of two seconds of a drag not more than two frames show it anew.

    A busy machine may hold up the drag itself; the knob then rests, and a frame may show it.
    """
    drawn = page.page.evaluate(
        """async (knob) => {
          const slider = document.querySelector(`#tree .knob[data-knob="${knob}"] input[type=range]`);
          const render = Object.getPrototypeOf(liveTwin.scene).render;
          let drawn = 0, stalls = 0, last = performance.now();
          liveTwin.scene.render = function () { drawn += 1; render.call(this); };
          const end = performance.now() + 2000;
          for (let k = 1; performance.now() < end; k += 1) {
            slider.value = 2 * Math.sin(k / 9);
            slider.dispatchEvent(new Event('input', { bubbles: true }));
            await new Promise((next) => setTimeout(next, 30));
            const now = performance.now();
            if (now - last > 100) { stalls += 1; }
            last = now;
          }
          const during = drawn - stalls;
          await new Promise((next) => setTimeout(next, 1500));
          delete liveTwin.scene.render;
          return [during, drawn, liveTwin.scene.cost];
        }""",
        DESPACE,
    )
    during, after, cost = drawn
    assert cost > 12.0, "the time of a software drawing is that of its work, not of handing it over"
    assert during <= 2
    assert after > during, "the last state is drawn once the knob rests"


def test_undo_redo_reset_and_typed_numbers(page):
    page.number(DESPACE).fill("2.5")
    page.number(DESPACE).press("Enter")
    page.still()
    page.number(DESPACE).fill("-1e2")
    page.number(DESPACE).press("Tab")
    page.still()
    known = "liveTwin.knobs.knobs"
    assert page.page.evaluate(known) == {DESPACE: -100.0}
    page.page.click("#undo")
    assert page.page.evaluate(known) == {DESPACE: 2.5}
    page.page.keyboard.press("Control+z")
    assert page.page.evaluate(known) == {}
    page.page.click("#redo")
    assert page.page.evaluate(known) == {DESPACE: 2.5}
    page.page.click("#reset")
    assert page.page.evaluate(known) == {}
    page.number(DESPACE).fill("1e9")
    assert page.number(DESPACE).get_attribute("aria-invalid") == "true"
    page.still()
    assert page.page.evaluate(known) == {}


def test_range_and_step_of_a_knob(page):
    knob = page.page.locator(f'#tree .knob[data-knob="{DESPACE}"]')
    knob.get_by_title("range and step").click()
    for name, value in (("from", "-2"), ("to", "4"), ("step", "0.5")):
        knob.get_by_label(name, exact=True).fill(value)
        knob.get_by_label(name, exact=True).press("Tab")
    page.slider(DESPACE).focus()
    page.page.keyboard.press("End")
    assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == 4.0
    page.page.keyboard.press("ArrowLeft")
    assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") == 3.5


def test_by_keyboard_alone(page):
    """From the top of the page to a slider that is not unfolded, and a state of it."""
    page.page.evaluate("for (const box of document.querySelectorAll('#tree details')) box.open = false")
    page.page.evaluate("document.querySelector('#tree details').open = true")
    page.page.evaluate("document.activeElement.blur()")
    for _ in range(80):
        page.page.keyboard.press("Tab")
        if page.page.evaluate("document.activeElement.closest('details')?.dataset.path === 'base/backward'"):
            break
    assert page.page.evaluate("document.activeElement.tagName") == "SUMMARY"
    page.page.keyboard.press("Enter")
    page.until("document.querySelector('details[data-path=\"base/backward\"] .list')")
    for _ in range(3):
        page.page.keyboard.press("Tab")
        if page.page.evaluate("document.activeElement.type === 'range'"):
            break
    for _ in range(3):
        page.page.keyboard.press("ArrowRight")
    page.still()
    assert list(page.page.evaluate("liveTwin.knobs.knobs")) == ["base/backward rotate x"]
    page.page.evaluate("document.getElementById('scene').focus()")
    before = page.page.evaluate("liveTwin.scene.camera.position.toArray()")
    page.page.keyboard.press("ArrowLeft")
    assert page.page.evaluate("liveTwin.scene.camera.position.toArray()") != before


@pytest.mark.parametrize("width", [360, 390, 800, 1280])
def test_every_width(browser, command, width):
    page = Page(browser, command.address, width, 800)
    page.ready()
    over = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert page.page.evaluate(over) == 0
    page.unfold("base/forward", M2)
    assert page.page.evaluate(over) == 0
    page.slider(DESPACE).scroll_into_view_if_needed()
    page.drag(DESPACE, 12.0, 4)
    page.still()
    assert page.page.evaluate(f"liveTwin.knobs.knobs['{DESPACE}']") > 0.0
    page.close()
    assert page.wrong == []


def test_a_camera_by_itself_fits_a_phone(browser):
    """The names of its numbers are longer than those of a pair's readings."""
    with running("gf7", "--port", "0", "--stay") as one:
        page = Page(browser, one.address, 360, 800)
        page.ready()
        over = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        assert page.page.evaluate(over) == 0
        page.close()
        assert page.wrong == []


def test_two_pages_have_knobs_of_their_own(browser, command, page):
    other = Page(browser, command.address)
    other.ready()
    other.unfold("base/forward", M2)
    page.number(DESPACE).fill("5")
    other.number(DESPACE).fill("-5")
    page.still()
    other.still()
    key = "liveTwin.last.truth.cameras.forward.d_f_um"
    one, two = page.page.evaluate(key), other.page.evaluate(key)
    assert one == pytest.approx(-two, rel=1e-3)
    assert abs(one) > 1.0
    other.close()
    assert other.wrong == []


def test_an_impossible_state_is_shown_and_the_next_good_one_recovers(page):
    page.number(DESPACE).fill("1")
    page.still()
    good = page.page.evaluate("liveTwin.last.readings")
    page.unfold("base/backward", "base/backward/focal_plane")
    page.number("base/backward/focal_plane shift x").fill("5000")
    page.still()
    assert page.page.is_visible("#problem")
    assert "outside its area CCD" in page.page.text_content("#problem")
    page.number("base/backward/focal_plane shift x").fill("0")
    page.still()
    assert not page.page.is_visible("#problem")
    assert page.page.evaluate("liveTwin.last.readings") == good


def test_views_of_the_spots(page):
    page.number(DESPACE).fill("40")
    page.still()
    whole = canvas(page, "forward/left")
    page.page.select_option("#stretch", "log")
    bent = canvas(page, "forward/left")
    assert bent.mean() > whole.mean()
    page.page.select_option("#crop", "spot")
    assert canvas(page, "forward/left").shape == (28, 28)
    page.page.select_option("#crop", "whole")
    page.page.select_option("#stretch", "linear")
    page.page.select_option("#show", "before")
    before = canvas(page, "forward/left")
    page.page.select_option("#show", "difference")
    assert "After − before" in page.page.text_content("#spots-caption")
    assert not np.array_equal(before, whole)
    page.page.uncheck("#noise")
    page.still()
    assert page.page.evaluate("liveTwin.last.readings.frames") == 9


@pytest.mark.parametrize("view", ["wavefront", "target"])
def test_pictures_of_a_camera(page, view):
    page.page.select_option("#view-what", view)
    page.until("document.getElementById('picture').naturalWidth > 0", 30.0)
    assert page.page.text_content("#picture-problem") == ""
    page.page.select_option("#view-what", "")
    page.until("document.getElementById('picture').hidden")


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


def test_a_course_is_played(browser):
    with running("scenes/examples/orbit.yaml", "--port", "0") as command:
        page = Page(browser, command.address)
        page.ready()
        assert page.page.text_content("#time-name") == "25 min"
        page.page.fill("#speed", "10")
        page.page.click("#play")
        page.until("liveTwin.knobs.time > 8 && liveTwin.knobs.time < 15")
        page.page.click("#play")
        page.still()
        assert page.page.evaluate("Object.keys(liveTwin.last.motions).length") > 20
        assert page.wrong == []
        page.close()
        # closing the last page ends the command by itself
        assert command.process.wait(30) == 0


def studied(folder: Path) -> Path:
    """A study's folder, as it is from the study's beginning."""
    with RunFolder(folder / "study") as made:
        made.write_text("config.yaml", resolve_study("scenes/examples/study_aperture.yaml").to_yaml())
        write_manifest(made, "twin.study", 0.0, 1.0)
    return folder / "study"


def test_a_run_folder_and_a_study_are_opened(browser, tmp_path):
    render = [sys.executable, "-m", "twin.render", "scenes/examples/perturb.yaml", "--out", str(tmp_path / "run")]
    assert subprocess.run(render, check=False, capture_output=True).returncode == 0
    with running(str(tmp_path / "run"), "--port", "0") as command:
        page = Page(browser, command.address)
        page.ready()
        assert page.page.inner_text("#opened") == "run"
        told = page.page.evaluate("liveTwin.last.readings")
        file = json.loads((tmp_path / "run" / "recovered.json").read_text())
        assert told == {key: file[key] for key in told}
        page.close()
    with running(str(studied(tmp_path)), "--run", "1234", "--port", "0") as command:
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


def test_the_page_says_when_the_token_is_another(browser):
    first = Command("gf7_pair", "--port", "0")
    port = re.search(r":(\d+)/", first.address)
    assert port is not None
    page = Page(browser, first.address)
    page.ready()
    first.end()
    with running("gf7_pair", "--port", port[1]):
        page.until("document.getElementById('status').textContent.includes('started anew')", 40.0)
    page.close()


def test_the_computing_process_is_started_again(browser):
    with running("gf7_pair", "--port", "0", "--stay") as command:
        page = Page(browser, command.address)
        page.ready()
        page.unfold("base/forward", M2)
        computer = command.computer()
        os.kill(computer, signal.SIGSTOP)
        said = "document.getElementById('problem')"
        page.until(f"!{said}.hidden && {said}.textContent.includes('kill -CONT {computer}')", 2.0)
        os.kill(computer, signal.SIGCONT)
        page.until(f"{said}.hidden && document.getElementById('status').textContent === 'connected'", 2.0)
        os.kill(computer, signal.SIGKILL)
        page.until(f"!{said}.hidden && {said}.textContent.includes('SIGKILL')", 2.0)
        page.number(DESPACE).fill("2")
        page.until(f"{said}.hidden", 60.0)
        page.until("liveTwin.last.truth && Math.abs(liveTwin.last.truth.cameras.forward.d_f_um) > 1", 40.0)
        page.close()
        assert command.end() == 0


def test_20_000_messages_leave_memory_as_it_is(browser, command, page):
    """As many states as an hour of drags sends; memory after the first 2 000 and at the end within 5 %."""
    flood = """async ([from, count]) => {
      for (let n = from; n < from + count; n += 1) {
        liveTwin.knobs.turn('base/forward/M2 shift z', Number((3 * Math.sin(n / 7)).toFixed(3)));
        liveTwin.ws.send(JSON.stringify({ ...liveTwin.state(), n: liveTwin.n }));
        if (n % 8 === 0) await new Promise((done) => setTimeout(done, 22));
      }
    }"""
    page.page.evaluate(flood, [0, 2000])
    page.still()
    before = command.memory()
    for first in range(2000, 20_000, 2000):
        page.page.evaluate(flood, [first, 2000])
    page.still()
    assert command.memory() < 1.05 * before
    assert page.page.evaluate("liveTwin.last.problem") is None
