"""Reports as a reader opens them: from a file, without network, on a wide screen and a phone, by day and by night."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup

from optics.geometry.tree import Motion
from scenes.specs.resolved import resolve
from twin.main_job.render_folder import render_report
from twin.main_job.render_job import render_job
from twin.pictures.light_paths import trace_light_paths
from twin.pictures.scene_file import scene_bytes, viewer_page

CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.second,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed"),
    pytest.mark.drawn,
]

# software rendering, so that it needs no GPU
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def run(backend):
    return render_job(resolve("scenes/examples/perturb.yaml"), backend, frames=2)


@pytest.fixture(scope="module")
def report(run, tmp_path_factory) -> Path:
    """The main report, with a view of a focal plane that is turned and shifted."""
    place = tmp_path_factory.mktemp("report")
    state = {"base/backward/focal_plane": Motion(rotate=(0.0, 0.0, 1e-4), shift=(0.0, 1e-5, 0.0))}
    instrument = run.experiment.instrument
    paths = trace_light_paths(instrument, run.experiment.backend, state)
    page = render_report(run, scene=scene_bytes(instrument, state, paths))
    (place / "report.html").write_text(page, encoding="utf-8")
    return place / "report.html"


@pytest.fixture(scope="module")
def launcher():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra `test`)")
    with playwright.sync_playwright() as made:
        yield made.chromium


@pytest.fixture(scope="module")
def browser(launcher):
    browser = launcher.launch(executable_path=CHROMIUM, args=SOFTWARE)
    yield browser
    browser.close()


class Reader:
    """A page that is open, and what went wrong on it."""

    def __init__(self, browser, file: Path, width: int, scheme: str) -> None:
        self.context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True, accept_downloads=True
        )
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.page.on("console", lambda told: self._note(told.type, told.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda asked: self._asked(asked.url, file))
        self.page.goto(file.as_uri())

    def _note(self, kind: str, text: str) -> None:
        if kind in ("error", "warning") and "GPU stall" not in text:  # the software renderer says that of itself
            self.wrong.append(text)

    def _asked(self, address: str, file: Path) -> None:
        if address != file.as_uri() and not address.startswith(("data:", "blob:")):
            self.wrong.append(f"asked for {address}")

    def unfold(self) -> None:
        self.page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")

    def luminance(self, what: str) -> float:
        """Of the page's ground or ink, 0 to 1."""
        colour = self.page.evaluate(f"getComputedStyle(document.body).{what}")
        channels = np.array([float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255.0
        return float(channels**2.2 @ [0.2126, 0.7152, 0.0722])


@pytest.fixture
def open_page(browser):
    opened: list[Reader] = []

    def open_it(file: Path, width: int, scheme: str) -> Reader:
        opened.append(Reader(browser, file, width, scheme))
        return opened[-1]

    yield open_it
    for reader in opened:
        reader.context.close()


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (390, "dark")])
def test_nothing_overflows_and_all_can_be_read(report, open_page, width, scheme) -> None:
    """Folded and unfolded; ink and ground differ as much as guidelines for reading ask for (a ratio of 7)."""
    reader = open_page(report, width, scheme)
    assert reader.page.evaluate(OVERFLOW) == 0
    reader.unfold()
    assert reader.page.evaluate(OVERFLOW) == 0
    ground, ink = reader.luminance("backgroundColor"), reader.luminance("color")
    assert (ground < ink) == (scheme == "dark")
    light, dark = max(ground, ink), min(ground, ink)
    assert (light + 0.05) / (dark + 0.05) > 7.0
    assert reader.wrong == []


def test_the_view_turns_and_its_motions_grow(report, open_page) -> None:
    reader = open_page(report, 390, "light")
    page = reader.page
    page.locator("#viewer[data-ready]").wait_for(timeout=60_000)
    assert page.locator("#fallback").is_hidden()  # folded away with the light path
    canvas, slider, output = page.locator("#viewer canvas"), page.locator("#viewer input[type=range]"), "#viewer output"
    canvas.scroll_into_view_if_needed()
    first, shown = canvas.screenshot(), float(page.inner_text(output).replace("\u202f", ""))
    assert shown > 10.0  # micrometres and arcseconds are not seen at a metre's scale

    slider.evaluate("one => { one.value = 0; one.dispatchEvent(new Event('input')); }")
    true_size = canvas.screenshot()
    assert float(page.inner_text(output)) == 1.0
    slider.evaluate("one => { one.value = one.max; one.dispatchEvent(new Event('input')); }")
    largest = canvas.screenshot()
    assert float(page.inner_text(output).replace("\u202f", "")) > shown
    assert len({first, true_size, largest}) == 3

    page.locator("#viewer input[type=checkbox]").uncheck()
    dark = canvas.screenshot()
    assert dark != largest
    box = canvas.bounding_box()
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60.0, y + 15.0, steps=4)
    page.mouse.up()
    turned = canvas.screenshot()
    assert turned != dark
    page.locator("#viewer button").click()
    page.mouse.move(1.0, 1.0)
    assert canvas.screenshot() != turned
    assert reader.wrong == []


def test_the_slider_is_named_only_where_something_moved(run, tmp_path, open_page) -> None:
    instrument = run.experiment.instrument
    state = {"base/backward/focal_plane": Motion(shift=(0.0, 1e-5, 0.0))}
    for moved in ({}, state):
        paths = trace_light_paths(instrument, run.experiment.backend, moved)
        page = viewer_page("view", scene_bytes(instrument, moved, paths), "", Markup(""))
        (tmp_path / "view.html").write_text(page, encoding="utf-8")
        reader = open_page(tmp_path / "view.html", 1000, "light")
        reader.page.locator("#viewer[data-ready]").wait_for(timeout=60_000)
        assert ("whatever the slider says" in reader.page.inner_text("#viewer")) == bool(moved)
        assert reader.page.locator("#viewer input[type=range]").is_visible() == bool(moved)
        assert "scene.glb" in reader.page.inner_text("#viewer")
        assert reader.wrong == []


def test_a_drawing_stands_in_where_there_is_no_webgl(launcher, report) -> None:
    browser = launcher.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    try:
        reader = Reader(browser, report, 1400, "light")
        assert reader.page.locator("#fallback svg").is_visible()
        assert reader.page.locator("#viewer").is_hidden()
        assert reader.wrong == []
    finally:
        browser.close()
