"""Layouts of a monitor: what their light can know, what they cost, which are refused, and the search for better
ones.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.monitor.parameters import ANGLE_GROUP
from optics.numerics.backend import Backend
from scenes.models.monitor_layout import (
    Beam,
    ImagingBeams,
    MonitorDesignSetup,
    changed_beam,
    drawn_beam,
    layout_spec,
    number_of,
    prism_mass,
    pupil_share,
    ranges,
)
from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.twin.study_bench import refusals
from twin.design.__main__ import app
from twin.design.layout_bench import BeamFacts, LayoutBench, combined, is_individual, touching
from twin.design.layout_search import journal_of
from twin.design.monitor_design import LAYOUTS, MonitorDesignRun, run_monitor_design
from twin.framework.run_folder import RunFolderError
from twin.monitor.monitor_derivative import Information, spot_noise
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.monitor_path import MonitorPath
from twin.uncertainty.monitor_limits import expected_covariance, find_limits

FILES = Path(__file__).with_name("layouts")
STATED, DESIGN = ((FILES / name).read_text("utf-8") for name in ("mirrors.yaml", "design.yaml"))
FIRST = Beam(0.22, 0.0, 0.034, np.radians(1.22), 2.4, 0.5, 0.15, 0.06, 0.05)
SECOND = Beam(0.13, 0.0, 0.034, np.radians(1.25), 2.65, 0.65, 0.1, 0.06, 0.11)
THIRD = Beam(0.06, 0.0, 0.030, np.radians(1.20), 2.8, 0.8, 0.1, 0.05, 0.1)


def written(folder: Path, design: str = DESIGN) -> Path:
    (folder / "mirrors.yaml").write_text(STATED, "utf-8")
    file = folder / "design.yaml"
    file.write_text(design, "utf-8")
    return file


@pytest.fixture(scope="module")
def setup() -> MonitorDesignSetup:
    return MonitorDesignSetup.read(FILES / "design.yaml")


@pytest.fixture(scope="module")
def bench(setup: MonitorDesignSetup, backend: Backend) -> LayoutBench:
    return LayoutBench(setup, backend)


@pytest.fixture(scope="module")
def facts(bench: LayoutBench) -> tuple[BeamFacts, ...]:
    tried = tuple(bench.try_beam(beam) for beam in (FIRST, SECOND, THIRD))
    assert [one.refused for one in tried] == ["", "", ""]
    return tried


def test_a_further_beam_never_raises_a_sigma(bench: LayoutBench, facts: tuple[BeamFacts, ...]) -> None:
    for fewer, more in (((0,), (0, 1)), ((1,), (0, 1)), ((0, 1), (0, 1, 2)), ((0, 2), (0, 1, 2))):
        few, many = (combined([facts[k] for k in which], "mirrors.yaml") for which in (fewer, more))
        # rounding of covariances whose largest and smallest eigenvalues are 1e9 apart
        assert np.linalg.eigvalsh(few - many).min() > -1e-9 * np.trace(few)
        assert np.trace(many) < np.trace(few)


@pytest.mark.second
def test_beams_combined_are_the_layout_that_is_built(bench: LayoutBench, facts: tuple[BeamFacts, ...]) -> None:
    built = bench.try_layout((FIRST, SECOND))
    assert built.refused == ""
    left = combined(facts[:2], "mirrors.yaml")
    for name, rows in bench.rows.items():
        sigma = float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", rows, left, rows))))
        # the second facet stands elsewhere on the block than alone: the beams' ways differ by some millimetres
        assert built.sigmas["mirrors.yaml"][name] == pytest.approx(sigma, rel=0.01)
    shares = built.shares["mirrors.yaml"]["angle"]
    assert np.sqrt(sum(shares.values())) == pytest.approx(built.sigmas["mirrors.yaml"]["angle"], rel=1e-9)
    assert built.mass == pytest.approx(facts[0].mass + facts[1].mass, rel=1e-3)


@pytest.fixture(scope="module")
def path(bench: LayoutBench) -> MonitorPath:
    return MonitorPath(bench.start, bench.backend)


def with_light(path: MonitorPath, times: float, frames: int) -> MonitorPath:
    """The monitor with other light and another number of frames."""
    start = path.instrument
    monitor = start.spec.monitor.model_copy(update={"frames": frames})
    channels = tuple(replace(channel, photons=times * channel.photons) for channel in start.channels)
    spec = start.spec.model_copy(update={"monitor": monitor})
    return MonitorPath(replace(start, spec=spec, channels=channels), path.backend)


def fisher(found: Information) -> np.ndarray:
    """(M, M) information of the spots on the motions, per standard deviation squared."""
    spots = found.disturbances.spots
    return np.asarray(spots.T @ np.linalg.solve(found.noise, spots))


def posterior(found: Information) -> np.ndarray:
    """(4 K, 4 K) covariance of the parameters that is left, rad and m."""
    return np.asarray(found.disturbances.misfit(found.gain) + found.gain @ found.noise @ found.gain.T)


@pytest.mark.second
def test_information_of_frames_adds_and_light_counts_as_beams_do(bench: LayoutBench, path: MonitorPath) -> None:
    even = replace(bench.detector(), prnu=0.0, dsnu_e=0.0, dark_noise_e=0.0, dark_current_e_per_s=0.0)
    # rounding falls with the number of frames where read noise spreads over its steps
    read = replace(even, dark_noise_e=10.0)
    four = spot_noise(with_light(path, 1.0, 4), read)[0]
    assert spot_noise(with_light(path, 1.0, 12), read)[0] == pytest.approx(four / 3.0, rel=1e-12)
    once = spot_noise(with_light(path, 1.0, 4), even)[0]
    # shot noise alone, but for what rounding to grey values adds
    assert spot_noise(with_light(path, 2.0, 4), even)[0] == pytest.approx(once / 2.0, rel=0.01)
    stated = bench.information(bench.start, FIRST)["mirrors.yaml"].disturbances
    shared = np.array([not is_individual(body) for body in stated.bodies])
    own = stated.scaled(shared.astype(float))
    one = Information(own, once, bench.rows, np.zeros(4))
    twice = replace(
        one, disturbances=replace(own, spots=np.concatenate([own.spots, own.spots])), noise=np.kron(np.eye(2), once)
    )
    brighter = replace(one, noise=once / 2.0)
    known = fisher(one)
    assert fisher(twice) == pytest.approx(fisher(brighter), rel=1e-9, abs=1e-9 * float(np.abs(known).max()))
    left = posterior(one)
    assert posterior(twice) == pytest.approx(posterior(brighter), rel=1e-6, abs=1e-9 * float(np.trace(left)))
    for name, rows in one.quantities.items():
        assert one.sigma(name) ** 2 == pytest.approx(np.trace(rows @ left @ rows.T) / len(rows), rel=1e-9)
    # the two forms of the posterior are one
    root = own.parameters @ np.linalg.solve(np.eye(len(shared)) + known, own.parameters.T)
    assert left == pytest.approx(root, rel=1e-5, abs=1e-9 * float(np.trace(root)))


@pytest.mark.second
def test_noise_of_shot_light_alone_is_that_of_an_airy_disk(bench: LayoutBench, path: MonitorPath) -> None:
    """N photons through a round aperture tell a place to wavelength / (2 pi NA sqrt(N)), and a shift is of two images.
    Pinhole and pixel, and rounding to grey values, fill the dark rings, which tell much of it.
    """
    even = replace(bench.detector(), prnu=0.0, dsnu_e=0.0, dark_noise_e=0.0, dark_current_e_per_s=0.0)
    lit = with_light(path, 1.0, 4)
    electrons = 4 * even.quantum_efficiency * np.array([channel.photons for channel in lit.channels])
    airy = lit.wavelength / (2.0 * np.pi * lit.numerical_aperture * np.sqrt(electrons)) / lit.pitch
    sigma = np.sqrt(np.diag(spot_noise(lit, even)[0]).reshape(-1, 2))
    assert np.all(sigma > np.sqrt(2.0) * airy[:, None])
    assert np.all(sigma < 1.35 * np.sqrt(2.0) * airy[:, None])


@pytest.mark.second
def test_beams_that_stand_in_each_other_are_not_combined(bench: LayoutBench, facts: tuple[BeamFacts, ...]) -> None:
    assert not touching(facts[0], facts[1])
    # CCDs of 1.152 mm at 5.51 m and fields near 1.22 deg have room from 0.0120 deg on
    for apart, room in ((0.0118, False), (0.0121, True)):
        aside = replace(FIRST, field=FIRST.field + np.radians(apart))
        assert bench.boards_apart(FIRST, aside) is room
        assert bench.boards_apart(aside, FIRST) is room
    near = bench.try_beam(replace(SECOND, pupil_x=0.135, spread_y=0.105))
    assert near.refused == ""
    assert touching(facts[1], near)


def test_a_layout_whose_prisms_collide_is_refused_with_both_bodies_and_the_line(
    setup: MonitorDesignSetup, tmp_path: Path
) -> None:
    near = replace(SECOND, prism_180_distance=2.42, pupil_x=0.2)
    file = tmp_path / "hand.yaml"
    file.write_text(layout_spec(setup, (FIRST, near)).file_text("made by hand"), "utf-8")
    design = written(tmp_path, DESIGN.replace("instrument: gf7_pair", "instrument: hand.yaml"))
    result = CliRunner().invoke(app, ["monitor", str(design), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    told = " ".join(result.output.split())
    assert "base/forward/monitor/left/prism_180" in told
    assert "base/forward/monitor/left_2/prism_180" in told
    lines = file.read_text("utf-8").splitlines()
    number = int(told.split("hand.yaml:")[1].split(":")[0])
    assert "distance: 2.42 m" in lines[number - 1] or "distance: 2.4 m" in lines[number - 1]
    assert not (tmp_path / "out").exists()


def test_a_changed_beam_is_near_the_other_and_thrown_back_by_the_ends(setup: MonitorDesignSetup) -> None:
    """Half of the numbers stay; of 1200 normal ones the rest are 5 deviations away at most."""
    rng, names = np.random.default_rng(5), ranges(setup)
    low, high = np.array(list(names.values())).T

    def shares(beam: Beam) -> np.ndarray:
        """Where in their ranges 200 changed beams have their numbers, (200, K)."""
        changed = (changed_beam(setup, beam, 0.01, rng) for _ in range(200))
        return np.array([[number_of(setup, one, name) for name in names] for one in changed] - low) / (high - low)

    drawn = drawn_beam(setup, rng)
    place = np.array([(number_of(setup, drawn, name) - names[name][0]) / np.ptp(names[name]) for name in names])
    assert np.all((place > 0.05) & (place < 0.95))
    assert 0.005 < np.std(shares(drawn) - place) < 0.01
    for end, value in ((0.0, low), (1.0, high)):
        found = shares(drawn.changed(dict(zip(names, value.tolist(), strict=True))))
        assert np.all((found >= 0.0) & (found <= 1.0))
        assert np.max(np.abs(found - end)) < 0.05
        assert np.mean(np.abs(found - end) < 1e-9) == pytest.approx(0.5, abs=0.07)


class Stop(Exception):
    """Breaks a search off."""


@pytest.fixture(scope="module")
def whole(setup: MonitorDesignSetup, backend: Backend) -> MonitorDesignRun:
    return run_monitor_design(setup, backend, seed=1)


@pytest.mark.second
def test_a_short_search_finds_a_better_layout(whole: MonitorDesignRun, tmp_path: Path) -> None:
    best = whole.points[0]
    assert whole.merit(best.facts) < whole.merit(whole.results.start)
    assert best.facts.pupil_share <= 0.2


def test_a_journal_keeps_every_bit_and_is_of_one_search(facts: tuple[BeamFacts, ...], tmp_path: Path) -> None:
    file = tmp_path / "a.search"
    with journal_of(file, "one") as journal:
        journal.keep({repr(FIRST): facts[0]})
        kept = file.read_text("utf-8")
    # a line of another layout that was damaged, one that is none, bytes that are no text, and a line that was cut
    damaged = kept.split("\n")[1].replace(str(FIRST), str(SECOND))
    whole_lines = f"{kept}{damaged}\n[]\n".encode() + b"\xff\xfe\n"
    file.write_bytes(whole_lines + b'{"of": "a line that was cut')
    with pytest.raises(RunFolderError, match="another search"), journal_of(file, "two"):
        pass
    with journal_of(file, "one") as journal:
        again = journal.known[repr(FIRST)]
        assert (repr(SECOND) in journal.known, journal.damaged) == (False, 3)
    assert file.read_bytes() == whole_lines  # a search that cannot write its results, on a full disk, does not lose it
    assert again.beam == FIRST
    for name in ("taken", "facets", "light"):
        assert np.array_equal(getattr(again, name), getattr(facts[0], name))
    for name in ("shared", "individual", "parameters"):
        assert np.array_equal(getattr(again.seen["mirrors.yaml"], name), getattr(facts[0].seen["mirrors.yaml"], name))


@pytest.mark.second
def test_a_search_that_is_broken_off_goes_on_to_the_same_end(
    setup: MonitorDesignSetup, backend: Backend, whole: MonitorDesignRun, tmp_path: Path
) -> None:
    journal = tmp_path / "out.search"

    def stop(part: str, done: int, total: int) -> None:
        if done == 2:
            raise Stop

    with pytest.raises(Stop):
        run_monitor_design(setup, backend, 1, stop, journal=journal)
    kept = len(journal.read_text("utf-8").splitlines())
    assert kept == 3  # the head and both beams
    again = run_monitor_design(setup, backend, 1, journal=journal)
    assert journal.exists()  # the command removes it, when the run folder stands
    assert LAYOUTS(again) == LAYOUTS(whole)


@pytest.mark.second
def test_a_start_that_throws_a_ghost_is_refused_with_both_bodies_and_the_line(
    setup: MonitorDesignSetup, tmp_path: Path
) -> None:
    """Path-traced: faces that stand square to the beam send their reflections onto the spot."""
    file = tmp_path / "hand.yaml"
    hand = setup.instrument.plain()
    hand["monitor"]["prism_0"].pop("tilt")  # type: ignore[index]
    file.write_text(dump_yaml({k: v for k, v in hand.items() if v not in ("", {})}), "utf-8")
    text = DESIGN.replace("instrument: gf7_pair", "instrument: hand.yaml")
    text = text.replace("pupil_share: 20 percent", "pupil_share: 20 percent, ghost_paths: 10000")
    result = CliRunner().invoke(app, ["monitor", str(written(tmp_path, text)), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    told = " ".join(result.output.split())
    assert re.search(r"base/(\w+)/monitor/(\w+)/prism_0 throws a ghost on base/\1/focal_plane/\2/area_ccd", told)
    number = int(told.split("hand.yaml:")[1].split(":")[0])
    assert "prism_0:" in file.read_text("utf-8").splitlines()[number - 1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("change", "to", "told"), refusals("layouts"))
def test_bad_input_is_told_with_its_line(tmp_path: Path, change: str, to: str, told: str) -> None:
    file = written(tmp_path, DESIGN.replace(change, to, 1))
    with pytest.raises(InputError) as error:
        MonitorDesignSetup.read(file)
    assert told in str(error.value)
    issue = error.value.issues[0]
    assert issue.line is not None
    assert file.read_text("utf-8").splitlines()[issue.line - 1].split(":")[0].strip() in to


@pytest.mark.second
@pytest.mark.parametrize(
    ("name", "less", "pupil", "disturbances"),
    [("gf7_pair_two", (12.0, 10.0), 1.3, "launch"), ("gf7_pair_best", (18.0, 30.0), 1.4, "orbit")],
)
def test_the_shipped_layouts_know_more(backend, name, less, pupil, disturbances):
    """What their page says: how many times less the posterior leaves of the angle and of d_f, at about the same share
    of the imaging pupils, and a fifteenth of the mass.
    """
    left, share, mass = {}, {}, {}
    for one in ("gf7_pair", name):
        named = {"instrument": one, "disturbances": {"file": disturbances}}
        experiment = MonitorExperiment(resolve_job(JobSpec.model_validate(named)), backend)
        limits = find_limits(experiment, expected_covariance(experiment, experiment.instrument.spec.monitor.frames), 9)
        sigma = limits.splits["posterior"].sigma
        angle = next(s for q, s in zip(limits.quantities, sigma, strict=True) if q.group == ANGLE_GROUP)
        left[one] = angle, max(s for q, s in zip(limits.quantities, sigma, strict=True) if q.key == "d_f_um")
        share[one] = pupil_share(ImagingBeams.of(experiment.instrument, backend).taken(experiment.instrument))
        mass[one] = prism_mass(experiment.instrument)
    for before, after, times in zip(left["gf7_pair"], left[name], less, strict=True):
        assert times * after < before
    assert share[name] < pupil * share["gf7_pair"]
    assert 14.0 * mass[name] < mass["gf7_pair"]
