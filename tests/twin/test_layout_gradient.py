"""Derivatives of what a monitor's layout leaves, by the numbers of the layout, and the steps that follow them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.monitor.disturbances import Disturbances, TimeLaw
from analysis.spots.likelihood import EDGE_PX
from optics.numerics.backend import Backend
from scenes.models.monitor_layout import (
    CONTINUOUS,
    Beam,
    MonitorDesignSetup,
    changed_beam,
    drawn_beam,
    layout_spec,
    start_beams,
)
from tests.twin.test_monitor_layouts import FIRST, SECOND
from twin.design import monitor_design
from twin.design.layout_bench import FULLEST, LayoutBench, LayoutFacts, _OutsideLimitsError
from twin.design.layout_search import (
    Candidate,
    End,
    LayoutNumber,
    SearchResult,
    Slope,
    known_of,
    merit,
    numbers_of,
    optima,
    refined,
    slope_of,
    spread,
)
from twin.framework.procedure import BenchError
from twin.monitor.monitor_derivative import Information

FILES = Path(__file__).with_name("layouts_differentiated")
STATED_NAME = "mirrors.yaml"


@pytest.fixture(scope="module")
def setup() -> MonitorDesignSetup:
    return MonitorDesignSetup.read(FILES / "design.yaml")


@pytest.fixture(scope="module")
def bench(setup: MonitorDesignSetup, backend: Backend) -> LayoutBench:
    return LayoutBench(setup, backend)


def information(a: np.ndarray, b: np.ndarray, c: np.ndarray, r: np.ndarray, rows: np.ndarray) -> Information:
    count = a.shape[1]
    names = tuple(map(str, range(count)))
    stated = Disturbances("some", names, names, names, np.ones(count), names, a, b, c, (TimeLaw(),) * count)
    return Information(stated, r, {"what": rows}, np.zeros(len(a) // 2))


def test_slopes_by_the_spots_derivatives_and_their_noise() -> None:
    """Against differences of the posterior itself, for motions that are correlated and a quantity of three rows."""
    rng = np.random.default_rng(3)
    a, b, rows = rng.standard_normal((8, 12)), rng.standard_normal((8, 12)), rng.standard_normal((3, 8))
    mixed, noisy = rng.standard_normal((12, 12)), rng.standard_normal((8, 8))
    c, r = mixed @ mixed.T / 12.0, 0.1 * noisy @ noisy.T + 0.1 * np.eye(8)
    by_a, by_r = information(a, b, c, r, rows).slopes("what")
    assert by_a.shape == a.shape
    assert by_r.shape == r.shape
    for _ in range(4):
        da, dr = rng.standard_normal(a.shape), rng.standard_normal(r.shape)
        dr = dr + dr.T
        h = 1e-5
        up, down = (information(a + s * h * da, b, c, r + s * h * dr, rows).sigma("what") for s in (1.0, -1.0))
        # differences are right to h^2, and to rounding over h
        assert np.sum(by_a * da) + np.sum(by_r * dr) == pytest.approx((up - down) / (2.0 * h), rel=1e-7)


def agrees_with_rebuilt_layouts(bench: LayoutBench, number: LayoutNumber) -> None:
    """A slope against plain central differences of sigmas of layouts that are built anew. They are wrong by h^2, which
    a second step takes away, and by what aiming to 1e-9 leaves: 2e-9 of a sigma over h, seen where a number does next
    to nothing.
    """
    slope = slope_of(bench, number)
    assert slope.refused == ""
    low, high = bench.setup.test.vary.model_dump()[number.name]
    here = known_of(bench, number.beams)[STATED_NAME]
    h = 2e-3 * (high - low)
    near, far = (
        [known_of(bench, number.moved(bench, sign * k * h))[STATED_NAME] for sign in (1.0, -1.0)] for k in (1.0, 2.0)
    )
    for key in ("angle", "forward/d_f", "backward/d_f"):
        one, two = ((up.sigma(key) - down.sigma(key)) / (2.0 * k * h) for (up, down), k in ((near, 1.0), (far, 2.0)))
        plain, noise = (4.0 * one - two) / 3.0, 2e-9 * here.sigma(key) / h
        value = slope.values[STATED_NAME][key]
        assert abs(value - plain) <= 1e-5 * abs(plain) + noise, (number.name, key)


@pytest.mark.second
def test_a_slope_against_layouts_that_are_built_anew(bench: LayoutBench) -> None:
    agrees_with_rebuilt_layouts(bench, LayoutNumber((FIRST,), 0, "pupil_x"))


@pytest.mark.second
def test_a_layout_at_a_limit_has_slopes_and_one_beyond_tells_why(bench: LayoutBench) -> None:
    names = [number.name for number in numbers_of(bench, (FIRST,))]
    assert names == list(CONTINUOUS)
    # the beam's prism stands in its neighbour: it cannot be built, and can be differentiated
    touching = (FIRST, replace(SECOND, prism_180_distance=2.42, pupil_x=0.2))
    assert "extends" in bench.try_layout(touching).refused
    assert known_of(bench, touching)[STATED_NAME].sigma("angle") > 0.0
    lost = slope_of(bench, LayoutNumber((replace(FIRST, pupil_x=0.6),), 0, "width", 4))
    assert lost.refused != ""
    assert not lost.values


@pytest.mark.second
def test_spots_that_fill_their_pixels_are_refused(bench: LayoutBench) -> None:
    told = bench.try_beam(replace(FIRST, photons=1e8)).refused
    assert told.startswith("its spots are too bright")
    facts = bench.try_layout((replace(FIRST, photons=8e6),))
    assert facts.refused == ""
    dim = bench.try_layout((replace(FIRST, photons=4e6),))
    assert facts.brightest == pytest.approx(2.0 * dim.brightest, rel=1e-6)
    assert 0.1 < facts.brightest.max() < FULLEST
    # d_f of one beam is limited by what its light cannot know, not by noise
    assert 0.9 < facts.sigmas[STATED_NAME]["forward/d_f"] / dim.sigmas[STATED_NAME]["forward/d_f"] < 1.0


@pytest.mark.second
def test_another_area_ccd_counts_the_same_spots_in_other_pixels(bench: LayoutBench, tmp_path: Path) -> None:
    shutil.copy(FILES / STATED_NAME, tmp_path)
    ccds = "area_ccds: {coarse: {detector: monitor_ccd, pitch: 12 um, rows: 96, columns: 96}, "
    ccds += "fine: {detector: monitor_ccd, pitch: 9 um, rows: 128, columns: 128}}\n"
    (tmp_path / "design.yaml").write_text((FILES / "design.yaml").read_text("utf-8") + ccds, "utf-8")
    setup = MonitorDesignSetup.read(tmp_path / "design.yaml")
    assert [beam.area_ccd for beam in start_beams(setup)] == ["coarse"]
    rng = np.random.default_rng(1)
    assert {drawn_beam(setup, rng).area_ccd for _ in range(20)} == {"coarse", "fine"}
    assert changed_beam(setup, replace(FIRST, area_ccd="fine"), 0.1, rng).area_ccd == "fine"
    chosen = LayoutBench(setup, bench.backend)
    coarse, fine = (known_of(chosen, (replace(FIRST, area_ccd=name),))[STATED_NAME] for name in ("coarse", "fine"))
    assert layout_spec(setup, (replace(FIRST, area_ccd="fine"),)).monitor.area_ccd.pitch == 9e-6
    # one path: what is told apart is a place in metres over the pitch
    assert fine.disturbances.spots == pytest.approx(coarse.disturbances.spots * 12.0 / 9.0, rel=1e-9, abs=1e-12)
    assert fine.brightest == pytest.approx(coarse.brightest * (9.0 / 12.0) ** 2, rel=0.02)
    # response differs over more pixels, which helps, and each adds its own dark noise, which harms
    ratio = np.sqrt(np.diag(fine.noise) / np.diag(coarse.noise)) * 9.0 / 12.0
    assert np.all((ratio > 0.7) & (ratio < 1.2))


WANTED = {"angle": 0.05 * np.pi / 648000.0, "d_f": 2e-6}


class Valley:
    """Layouts whose sigmas are known in closed form: the angle's grows away from one place, d_f's away from another,
    and both fall with light until pixels are full. Bodies stand in the way beyond a pupil_x, by half as much as the
    0-deg prism stands nearer than 0.5 m less where they may be moved aside.
    """

    def __init__(self, bench: LayoutBench, most_x: float = 1.0, aside: bool = False) -> None:
        self.bench, self.most_x, self.aside = bench, most_x, aside
        self.asked: list[str] = []

    def facts(self, beams: tuple[Beam, ...]) -> LayoutFacts:
        (beam,) = beams
        if beam.pupil_x > self.most_x + 0.5 * max(0.5 - beam.prism_0_distance, 0.0) * self.aside:
            return LayoutFacts(beams, refused="in the way")
        angle = 1.0 + 40.0 * (beam.pupil_x - 0.2) ** 2 + 100.0 * (beam.pupil_y - 0.01) ** 2
        d_f = 1.0 + 90.0 * (beam.pupil_x - 0.1) ** 2 + 100.0 * (beam.pupil_y + 0.02) ** 2
        light = self.light(beam)
        dim = 1.0 + 0.1 / light
        sigmas = {"angle": WANTED["angle"] * angle * dim}
        sigmas |= {f"{camera}/d_f": WANTED["d_f"] * d_f * dim for camera in ("forward", "backward")}
        return LayoutFacts(beams, sigmas={STATED_NAME: sigmas}, brightest=np.array([0.5 * light]))

    @staticmethod
    def light(beam: Beam) -> float:
        return (beam.photons or 4e6) / 4e6

    def slope(self, number: LayoutNumber) -> Slope:
        if number.name not in ("pupil_x", "pupil_y", "photons"):
            return Slope(number, values={STATED_NAME: dict.fromkeys(self.facts(number.beams).sigmas[STATED_NAME], 0.0)})
        low, high = self.bench.setup.test.vary.model_dump()[number.name]
        h = 1e-4 * (high - low)
        up, down = (self.facts(number.moved(self.bench, sign * h)) for sign in (1.0, -1.0))
        if up.refused or down.refused:
            return Slope(number, refused="in the way")
        ends = (up.sigmas[STATED_NAME], down.sigmas[STATED_NAME])
        values = {key: (ends[0][key] - ends[1][key]) / (2.0 * h) for key in ends[0]}
        return Slope(number, values={STATED_NAME: values}, brightest=(up.brightest - down.brightest) / (2.0 * h))

    def ask(self, part: str, items: list) -> list:
        self.asked += [part] * len(items)
        return [self.slope(item) if isinstance(item, LayoutNumber) else self.facts(item) for item in items]


@pytest.mark.second
def test_refinement_ends_where_no_ratio_can_fall(bench: LayoutBench) -> None:
    """The least of the larger of two ratios, found by scipy from the closed form alone."""
    valley = Valley(bench)
    begun = replace(FIRST, pupil_x=0.24, pupil_y=0.05, photons=4e6)
    way = refined(bench, valley.ask, "part", valley.facts((begun,)), 40, np.random.default_rng(1))
    merits = [merit(facts.sigmas, bench) for facts in way]
    assert merits == sorted(merits, reverse=True)
    x, y = np.meshgrid(np.linspace(0.03, 0.25, 2201), np.linspace(-0.06, 0.06, 1201))
    both = np.maximum(
        1.0 + 40.0 * (x - 0.2) ** 2 + 100.0 * (y - 0.01) ** 2, 1.0 + 90.0 * (x - 0.1) ** 2 + 100.0 * (y + 0.02) ** 2
    )
    least = float(both.min()) * (1.0 + 0.1 / (FULLEST / 0.5))
    # its last box is 2e-3 of a range, within which the ratios change by less than this
    assert merits[-1] == pytest.approx(least, rel=1e-3)
    assert way[-1].brightest[0] == pytest.approx(FULLEST, rel=1e-6)
    # what no goal depends on is not moved, and is differentiated once
    assert way[-1].beams[0].width == begun.width
    assert valley.asked.count("part: slopes") < len(CONTINUOUS) + 3 * 40


def test_refinement_goes_round_what_stands_in_the_way(bench: LayoutBench) -> None:
    """Toward x = 0.165 bodies stand beyond x = 0.12; y and light still find their best."""
    valley = Valley(bench, most_x=0.12)
    begun = replace(FIRST, pupil_x=0.1, pupil_y=0.05, photons=4e6)
    way = refined(bench, valley.ask, "part", valley.facts((begun,)), 40, np.random.default_rng(1))
    found = way[-1].beams[0]
    assert found.pupil_x <= 0.12
    assert way[-1].brightest[0] == pytest.approx(FULLEST, rel=1e-6)
    at = np.linspace(-0.06, 0.06, 2001)
    least = np.min(1.0 + 40.0 * (found.pupil_x - 0.2) ** 2 + 100.0 * (at - 0.01) ** 2)
    assert merit(way[-1].sigmas, bench) <= 1.01 * least * (1.0 + 0.1 / (FULLEST / 0.5))


@pytest.mark.second
def test_refinement_makes_room_with_numbers_that_no_goal_depends_on(bench: LayoutBench) -> None:
    """Bodies stand in the way beyond x = 0.12 unless the 0-deg prism is moved aside."""
    valley = Valley(bench, most_x=0.12, aside=True)
    begun = replace(FIRST, pupil_x=0.1, pupil_y=0.05, photons=4e6, prism_0_distance=0.5)
    way = refined(bench, valley.ask, "part", valley.facts((begun,)), 40, np.random.default_rng(1))
    stuck = refined(bench, Valley(bench, 0.12).ask, "part", valley.facts((begun,)), 40, np.random.default_rng(1))
    assert way[-1].beams[0].pupil_x > 0.13
    assert way[-1].beams[0].prism_0_distance < 0.5
    assert merit(way[-1].sigmas, bench) < 0.97 * merit(stuck[-1].sigmas, bench)


def test_no_step_is_taken_where_none_is_better(bench: LayoutBench) -> None:
    facts = LayoutFacts((FIRST,), sigmas={STATED_NAME: {"angle": 1e-7, "forward/d_f": 1e-6, "backward/d_f": 1e-6}})
    level = SimpleNamespace(asked=0)

    def ask(part: str, items: list) -> list:
        level.asked += len(items)
        flat = {STATED_NAME: dict.fromkeys(facts.sigmas[STATED_NAME], 0.0)}
        return [Slope(item, values=flat) for item in items]

    assert refined(bench, ask, "part", facts, 5, np.random.default_rng(1)) == [facts]
    assert level.asked == len(CONTINUOUS)


def test_beams_that_join_others_are_the_best_and_some_of_all_ranks() -> None:
    ranked = [Candidate((k,), float(k)) for k in range(20)]
    assert [one.beams[0] for one in spread(ranked, 6)] == [0, 1, 2, 3, 8, 14]
    assert spread(ranked, 20) == ranked
    assert spread(ranked, 50) == ranked
    assert spread(ranked, 1) == ranked[:1]


def test_ends_are_told_apart_by_two_percent(bench: LayoutBench) -> None:
    def end(name: str, times: float | None) -> End:
        sigmas = {STATED_NAME: {"angle": WANTED["angle"] * (times or 1.0), "forward/d_f": 0.0, "backward/d_f": 0.0}}
        layouts = () if times is None else (LayoutFacts((FIRST,), sigmas=sigmas),)
        return End(name, layouts, (1.0,), (), 1, 1, 1, 1, {"a": 1})

    ends = (end("b", 1.019), end("a", 1.0), end("none", None), end("d", 1.5), end("c", 1.03))
    found = SearchResult(LayoutFacts((FIRST,)), (), ends, 0.0)
    assert [[one.name for one in group] for group in optima(found, bench)] == [["a", "b"], ["c"], ["d"]]
    assert found.refused == {"a": 5}
    assert [found.total(name) for name in ("tried", "feasible", "compared", "built")] == [5, 5, 5, 5]


def test_layouts_beyond_their_limits_say_which() -> None:
    """Each limit by itself; a layout that stands on it is within."""
    limits = SimpleNamespace(pupil_share=0.2, mass=3.0, spot_sigmas=4.0)
    own = SimpleNamespace(setup=SimpleNamespace(test=SimpleNamespace(limits=limits)))
    ccd = SimpleNamespace(rows=96, columns=120)
    instrument = SimpleNamespace(spec=SimpleNamespace(autocollimator=SimpleNamespace(area_ccd=ccd)))
    room = 48.0 - EDGE_PX

    def spots(reach: float, fullest: float) -> None:
        found = SimpleNamespace(spot_sigma=np.array([0.1, reach / 4.0]), brightest=np.array([0.1, fullest]))
        LayoutBench._check_spots(own, {"a": found}, instrument)

    LayoutBench._check_limits(own, 0.2, 3.0)
    spots(room, FULLEST)
    for act, told in (
        (lambda: LayoutBench._check_limits(own, 0.21, 3.0), "its prisms block 21 percent of the imaging pupil"),
        (lambda: LayoutBench._check_limits(own, 0.2, 3.1), r"its prisms have a mass of 3\.1 kg"),
        (lambda: spots(room + 0.1, FULLEST), "its spots leave their area CCDs"),
        (lambda: spots(room, FULLEST + 0.01), "its spots are too bright"),
    ):
        with pytest.raises(_OutsideLimitsError, match=told):
            act()


def test_a_search_without_a_layout_that_stands_is_refused(setup: MonitorDesignSetup, monkeypatch) -> None:
    counts = {"tried": 5, "built": 4}
    found = SimpleNamespace(layouts=(), refused={"dark": 2, "in the way": 7}, total=counts.__getitem__)
    monkeypatch.setattr(monitor_design, "LayoutBench", lambda *_: None)
    monkeypatch.setattr(monitor_design, "_check_start", lambda *_: None)
    monkeypatch.setattr(monitor_design, "search", lambda *_: found)
    with pytest.raises(
        BenchError, match=r"none of 5 beams and 4 layouts is feasible; most frequent reason \(7 times\): in the"
    ):
        monitor_design.run_monitor_design(setup, None)
    found.layouts = ("a layout",)
    monkeypatch.setattr(monitor_design, "_front", lambda layouts, bench: layouts)
    monkeypatch.setattr(monitor_design, "_ghosts", lambda *_: True)
    with pytest.raises(BenchError, match="every layout on the front throws ghosts"):
        monitor_design.run_monitor_design(setup, None)


def test_of_many_layouts_the_best_the_lightest_and_some_between_are_shown(monkeypatch) -> None:
    monkeypatch.setattr(monitor_design, "merit", lambda sigmas, bench: sigmas)
    many = tuple(SimpleNamespace(sigmas=k, pupil_share=0.0, mass=-k) for k in range(101))
    assert [one.mass for one in monitor_design._front(many, SimpleNamespace())] == [0, -20, -40, -60, -80, -100]
