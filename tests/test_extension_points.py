"""Every place where docs/architecture.md says something is added: a toy from outside is added there alone, and what it
does is seen in the results.
"""

import html
import importlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy import stats

import scenes.schema
import twin
import twin.export.__main__
import twin.lab
import twin.render
import twin.validate
from analysis.arrays import ARCSEC
from analysis.monitor import recovery
from analysis.monitor.estimators import Estimator
from analysis.monitor.parameters import CameraCalibration, Parameter
from analysis.monitor.recovery import measure_spots
from analysis.spots import Centroid
from analysis.spots.centroid import gaussian_fit, mean_frames
from analysis.spots.noise import NoiseModel
from optics.geometry.aperture import Circle
from optics.geometry.sag_terms import SAG_TERMS, scaled_term
from optics.geometry.tree import Motion, State
from optics.numerics.backend import load_backend
from optics.numerics.extension_table import PREFIX, EntryPointError, ExtensionTable, entries
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.pupil_stack import circular_pupil
from scenes.models.camera_model import surface_of
from scenes.models.obstruction import find_obstructions
from scenes.models.scenery import build_scenery
from scenes.schema import json_schema
from scenes.specs.camera import MirrorSpec
from scenes.specs.instrument import PRISMS
from scenes.specs.job import JobSpec
from scenes.specs.load import LIBRARY, load_detector
from scenes.specs.orbit.flight import OrbitSpec
from scenes.specs.procedures import Procedure
from scenes.specs.resolved import resolve
from scenes.specs.study import Sampler
from scenes.yaml.errors import InputError
from scenes.yaml.named import FileKind
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.scenes.mirror_reflectors import CORNER, TWO_PLATES
from tests.toy_twin import AGAIN, BAR, Cylinder, Half, TwoLevels, one_bar
from tests.twin import test_path_tracing as path_figure
from tests.twin import test_prism_images
from tests.twin.commands import invoke
from tests.twin.path_bench import IDEAL
from tests.twin.study_bench import write_study as write_study_file
from tests.twin.test_target_images import F_NUMBER, PITCH, REGION, identity, line_ccd
from twin.framework import provenance
from twin.framework.artefact import Table
from twin.framework.data_files import FrameFacts
from twin.framework.page import RunFacts, write_test
from twin.framework.report import Report, Section
from twin.framework.run_folder import RunFolder, write_manifest
from twin.live.live_bench import LiveBench
from twin.monitor import calibration_cache
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.orbit import Orbit, acceleration, propagate
from twin.path_tracing.path_result import NOMINAL
from twin.path_tracing.stray_light import monitor_families
from twin.path_tracing.tracer import PathTracer, RaySource
from twin.sensors.area_detector import EmvaDetector
from twin.study import scripted
from twin.study.report.study_report import write_report
from twin.study.runs.base_job import BlockResult
from twin.study.runs.plan import Plan
from twin.study.runs.setup import resolve_study
from twin.study.study_files import write_data
from twin.targets.target_images import BandPupils, View
from twin.validation.check import Check
from twin.validation.group import CheckGroup

PAGE = Path(__file__).resolve().parent.parent / "docs/architecture.md"
FALSE_ALARM = 1e-6
"""Of each statistical limit, two-sided."""

TOYS: dict[str, str] = {}
"""Place -> test that adds a toy there."""


def extends(*places: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """The test adds a toy at these places, and at no other."""

    def listed(test: Callable[..., None]) -> Callable[..., None]:
        TOYS.update(dict.fromkeys(places, test.__name__))
        return test

    return listed


def registered(place: str) -> tuple[Any, str, Any]:
    """Module, name in it, and what stands there."""
    module, _, name = place.rpartition(".")
    owner = importlib.import_module(module)
    return owner, name, getattr(owner, name)


def add(patch: pytest.MonkeyPatch, place: str, name: Any, toy: Any) -> None:
    """Register a toy as a contributor would, until the test ends."""
    owner, attribute, there = registered(place)
    if isinstance(there, ExtensionTable):
        assert name not in there
        patch.setitem(there, name, toy)
    else:
        patch.setattr(owner, attribute, (*there, toy))


def rows() -> list[tuple[str, str, str, str]]:
    """(task, place, group of entry points, test) of the page's table."""
    text = PAGE.read_text("utf-8").partition("## Where to add")[2].partition("\n## ")[0]
    return re.findall(r"^\| ([^|]+?) \| `([a-z0-9_.]+\.[A-Z_]+)`[^|]*\| `(\w+)` \| `(test_\w+)` \|$", text, re.M)


# --- the page ---------------------------------------------------------------------------------------------------------


def test_the_page_lists_the_places_that_are_tried_here_and_no_others() -> None:
    found = {place: test for _, place, _, test in rows()}
    assert found == TOYS
    assert len(rows()) == len(found) >= 9
    assert all(registered(place)[2].group == PREFIX + group for _, place, group, _ in rows() if place != GROUPS)


# --- a detector's noise -----------------------------------------------------------------------------------------------

NOISE = "twin.sensors.area_detector.NOISE_TERMS"


def sheet_file(folder: Path, noise: str) -> Path:
    """The data sheet of the monitor's CCD with further noise."""
    text = (LIBRARY / "detectors" / "monitor_ccd.yaml").read_text("utf-8")
    path = folder / "noisy.yaml"
    path.write_text(text.replace("name: monitor_ccd", "name: noisy") + f"\nnoise: {noise}\n", "utf-8")
    return path


def within_chance(chi2: float, freedom: int) -> bool:
    return bool(FALSE_ALARM / 2 < stats.chi2.sf(chi2, freedom) < 1 - FALSE_ALARM / 2)


@extends(NOISE)
def test_a_noise_term(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames scatter by it, and spot centres scatter as the analysis says that knows its variance; one that does not is
    wrong.
    """
    add(monkeypatch, NOISE, "toy", TwoLevels)
    sheet = load_detector(sheet_file(tmp_path, "{toy: 300.0}"))
    exposure, frames, count, side = 0.01, 8, 300, 24
    detector = EmvaDetector.from_sheet(sheet, exposure)
    plain = EmvaDetector.from_sheet(sheet.model_copy(update={"noise": None}), exposure)
    told, silent = detector.noise_model(exposure), plain.noise_model(exposure)
    # an even field: one frame of many pixels, fixed and temporal noise together
    photons = np.full((1, 128, 128), 20000.0)
    field = detector.expose(photons, detector.fixed_pattern(photons.shape, 3), 1, exposure, 4).astype(float)
    mean = float(detector.expected_dn(photons, exposure)[0, 0, 0])

    def in_variances(model: NoiseModel) -> float:
        variance = model.temporal_variance_dn2(mean, 1) + model.fixed_variance_dn2(mean)
        return float(np.sum((field - mean) ** 2) / variance)

    assert within_chance(in_variances(told), field.size)
    assert in_variances(silent) > 2 * field.size
    # spots: each with a detector of its own
    y, x = np.mgrid[0:side, 0:side]
    spot = 4e4 * np.exp(-((x - 11.3) ** 2 + (y - 11.8) ** 2) / (2 * 2.0**2))
    images = np.broadcast_to(spot, (count, side, side))
    shot = detector.expose(images, detector.fixed_pattern(images.shape, 5), frames, exposure, 6)
    scatter = {}
    for name, model in (("told", told), ("silent", silent)):
        found = gaussian_fit(mean_frames(shot), frames, model)
        off = found.position - found.position.mean(axis=0)
        scatter[name] = float(np.sum(off[:, 0] ** 2 / found.sigma_row**2 + off[:, 1] ** 2 / found.sigma_column**2))
    assert within_chance(scatter["told"], 2 * (count - 1))
    assert scatter["silent"] > 1.5 * 2 * (count - 1)


# --- estimator, target, report section, format of frames --------------------------------------------------------------

ESTIMATORS = "analysis.monitor.estimators.ESTIMATORS"
TARGETS = "optics.targets.target_shapes.TARGETS"
SECTIONS = "twin.framework.report.SECTIONS"
FRAMES = "twin.framework.data_files.FRAME_FORMATS"


def as_npy(frames: np.ndarray, facts: FrameFacts) -> bytes:
    out = io.BytesIO()
    np.save(out, frames)
    return out.getvalue()


@pytest.mark.second
@extends(ESTIMATORS)
def test_an_estimator(experiment: Callable[[str], MonitorExperiment], monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of what ``derived`` reads, with half of its noise, for every camera and for the angle between them."""
    cameras = experiment("gf7_pair").calibration.cameras
    shifts = {"start": np.full((5, 4, 2), 47.5), "covariance": np.broadcast_to(1e-6 * np.eye(8), (5, 8, 8))}
    shifts["end"] = shifts["start"] + np.random.default_rng(7).normal(0.0, 0.3, (5, 4, 2))
    without = recovery.estimates(**shifts, cameras=cameras).parameters
    add(monkeypatch, ESTIMATORS, "half", Half())
    found = recovery.estimates(**shifts, cameras=cameras)
    assert list(found.parameters["forward"]) == [*without["forward"], "half"]
    for camera, estimators in found.parameters.items():
        half, derived = estimators["half"], estimators["derived"]
        np.testing.assert_allclose(half.vector, 0.5 * derived.vector, rtol=1e-13)
        np.testing.assert_allclose(half.sigma, 0.5 * derived.sigma, rtol=1e-13)
        for name, other in without[camera].items():
            np.testing.assert_array_equal(estimators[name].vector, other.vector)
    angles = found.angle
    # to first order; the exact formula departs by products of angles of 1e-6, and of the turn of 1e-5
    np.testing.assert_allclose(angles["half"].change_rad, 0.5 * angles["derived"].change_rad, rtol=1e-3)


CENTROIDS = "analysis.spots.CENTROIDS"


@extends(CENTROIDS)
def test_a_centroid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs may name it; spots are measured by it, and the title of one is in a report below."""
    job = "{instrument: gf7_pair, analysis: {centroid: again}}"
    with pytest.raises(InputError, match=r"centroid: not one of the choices; .* Found 'again', allowed: ml, gaus"):
        validate(JobSpec, parse_yaml(job))
    add(monkeypatch, CENTROIDS, "again", AGAIN)
    assert validate(JobSpec, parse_yaml(job)).analysis.centroid == "again"
    assert json_schema("job")["$defs"]["AnalysisSpec"]["properties"]["centroid"]["enum"][-1] == "again"
    add(monkeypatch, CENTROIDS, "bare", Centroid("bare", lambda *_: SimpleNamespace(gain_maps=None, light_dn=None)))
    with pytest.raises(EntryPointError, match="the centroid 'bare' returns positions without gain_maps"):
        measure_spots(np.zeros((1, 8, 8)), 1, SimpleNamespace(noise=None, template=None), "bare")


READINGS = "analysis.monitor.parameters.CAMERA_PARAMETERS"
READ_JOB = """instrument: gf7_pair
disturbances: launch
perturb: {base/forward/M2: {shift: [0 um, 0 um, 3 um]}}
course: {times: [0 min, 10 min], temperature: {base/forward: {change: [0 K, 0.1 K]}}}
render: {frames: 2}
"""


@pytest.mark.second
@extends(READINGS)
def test_a_reading(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The change of the principal distance as a part of it: one entry, seen in every view of the table of readings."""
    toy, key, symbol = "a part of the principal distance", "d_f_relative_ppm", "Δf/f"
    relative: Callable[[CameraCalibration], Any] = lambda c: (0.0, 0.0, 0.0, 1.0 / c.geometry.principal_distance_m)  # noqa: E731
    add(monkeypatch, READINGS, key, Parameter(key, symbol, toy, 3, relative))
    (tmp_path / "job.yaml").write_text(READ_JOB, "utf-8")
    folder = tmp_path / "run"
    done = invoke(twin.render.app, tmp_path / "job.yaml", "--out", folder)
    assert done.exit_code == 0, done.output

    # JSON: what is read and what is true are the same part of the principal distance
    recovered, truth, course = (read(folder, name) for name in ("recovered", "truth", "course"))
    for camera, true in truth["cameras"].items():
        focal_length = 1e-3 * true["principal_distance_mm"]
        assert true[key] == pytest.approx(true["d_f_um"] / focal_length, rel=1e-6)
        for found in recovered["cameras"][camera].values():
            for end in ("", "_sigma", "_sigma_noise"):
                within = 1e-5 * found[f"{key}_sigma_noise"]
                assert found[f"{key}{end}"] == pytest.approx(found[f"d_f_um{end}"] / focal_length, rel=1e-6, abs=within)
        for who in ("true", "model", "posterior", "filtered", "smoothed"):
            assert len(course["cameras"][camera][who][key]) == 2
        assert key in read(folder, "crosstalk")[camera]["motions"][0]["model"]
    assert key in json.dumps(read(folder, "uncertainty"))

    assert f"{symbol} [ppm]" in done.stdout
    assert f'data-key="course.forward.{key}.model"' in page_text(folder)
    # the live page, and the instrument in a script
    bench = LiveBench(twin.load(tmp_path / "job.yaml"))
    assert bench.greeting()["parameters"][-1] == {"key": key, "symbol": symbol, "unit": "ppm", "meaning": toy}
    jacobian = bench.twin.jacobian(["base/forward/M2 shift z"])
    assert float(jacobian.true.sel(camera="forward", parameter=key)[0]) != 0.0
    # studies: what a script's study has
    vary = {"base/forward/M2": {"shift": "0 0 (-5 .. 5) um"}}
    assert key in scripted.config_text(bench.twin, vary, 2, 0, "sobol")


def bar_size(image: np.ndarray) -> tuple[float, float]:
    """Width and length of a bright bar on dark, pixels, by area over height, and see that it lies in the middle."""
    light = image - np.median(image)
    half = len(image) // 2
    rows, columns = light[:, half - 10 : half + 10].sum(axis=1), light[half - 35 : half + 35].sum(axis=0)
    for profile in (rows, columns):
        # the window follows the chief ray by whole pixels: half of one; aberrations move the light by as much again
        assert np.arange(len(image)) @ profile / profile.sum() == pytest.approx(0.5 * (len(image) - 1), abs=1.0)
    inside = np.median(rows[half - 20 : half + 20])
    return float(columns.sum() / columns.max()), float(rows.sum() / inside)


@pytest.mark.second
@extends(TARGETS)
def test_a_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """A job may name it, and a camera's image of it is as wide and long as it is."""
    job = "{instrument: gf7_pair, render: {images: [one_bar, star]}}"
    with pytest.raises(InputError, match="not one of the choices; found 'one_bar', allowed: spots, knife_edge, bars"):
        validate(JobSpec, parse_yaml(job))
    add(monkeypatch, TARGETS, "one_bar", one_bar)
    assert validate(JobSpec, parse_yaml(job)).render.target_images == ("star", "one_bar")
    assert json_schema("job")["$defs"]["RenderSpec"]["properties"]["images"]["items"]["enum"][-1] == "one_bar"
    ccd = line_ccd()
    pupil = BandPupils.achromatic(circular_pupil(F_NUMBER), ccd.band)
    view = View(ccd, pupil, identity(), np.zeros(2), 1000, np.zeros(2), REGION)
    image = view.image(registered(TARGETS)[2]["one_bar"](PITCH, REGION))
    # the optics take some light from the middle of the bar, and add nothing to its area
    assert bar_size(image) == (pytest.approx(BAR[0], rel=0.1), pytest.approx(BAR[1], rel=0.02))


def write_toy(folder: Path) -> Report:
    """What a test of the laboratory could give, as a run folder."""
    summary = Table("summary", "Found", "Nothing.", ("x",), ((21,),))
    frames = np.arange(2 * 5 * 7, dtype=np.uint16).reshape(2, 5, 7)
    result = Report("A test", "It is one.", (), (), summary, (Section("Own section"),), {"edge": frames})
    with RunFolder(folder, False) as made:
        write_test("focus", {"x": 21}, result, RunFacts("", "twin.lab", 0.0, 0.0, "llvm", 1, "focus"), made)
    return result


def read(folder: Path, name: str) -> Any:
    return json.loads((folder / f"{name}.json").read_text("utf-8"))


def page_text(folder: Path) -> str:
    return html.unescape((folder / "report.html").read_text("utf-8"))


def twice(numbers: Mapping[str, Any]) -> Section:
    value = 2 * numbers["x"]
    return Section(f"Twice is {value}", ("Nothing < all.",), (Table("twice", "Twice", "Of it.", ("2x",), ((value,),)),))


@extends(SECTIONS)
def test_a_report_section(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stands in the report of its test, and of no other, before how to reproduce it; its table is a file."""
    add(monkeypatch, SECTIONS, "focus twice", twice)
    add(monkeypatch, SECTIONS, "turntable toy", lambda numbers: Section("Of another test"))
    add(monkeypatch, SECTIONS, "focus silent", lambda numbers: None)
    write_toy(tmp_path / "run")
    page = page_text(tmp_path / "run")
    assert re.findall(r"<h2>(.*)</h2>", page) == ["Own section", "Twice is 42", "How to reproduce"]
    assert "<p>Nothing < all.</p>" in page
    assert (tmp_path / "run" / "artefacts" / "twice.csv").read_text("utf-8") == "2x\n42\n"
    assert "artefacts/twice.csv" in read(tmp_path / "run", "manifest")["sha256"]


@extends(FRAMES)
def test_an_output_format_of_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An NPY file with the same frames stands beside the TIFF file, and the manifest lists it."""
    add(monkeypatch, FRAMES, "npy", as_npy)
    result = write_toy(tmp_path / "run")
    frames = np.load(tmp_path / "run" / "images" / "edge.npy")
    np.testing.assert_array_equal(frames, result.images["edge"])
    np.testing.assert_array_equal(frames, tifffile.imread(tmp_path / "run" / "images" / "edge.tiff"))
    assert "images/edge.npy" in read(tmp_path / "run", "manifest")["sha256"]


# --- surfaces ---------------------------------------------------------------------------------------------------------

SAGS = "optics.geometry.sag_terms.SAG_TERMS"
PLACES = np.linspace(-0.2, 0.2, 9)
RADIUS, ACROSS = 2.5, 4.0
"""Of the sphere and of the cylinder on it, metres: 5 mm of sag at the edge."""


def astigmatic(x: np.ndarray, y: np.ndarray, size: float = 1.0) -> np.ndarray:
    """The same surface by its centres of curvature: a sphere that light of +z meets hollow, a cylinder, a slope."""
    sphere, cylinder = RADIUS * size, ACROSS * size
    return np.sqrt(sphere**2 - x**2 - y**2) - sphere + cylinder - np.sqrt(cylinder**2 - x**2) + 1e-3 * y


@extends(SAGS)
def test_a_surface(backend: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read from a file, met by the sequential trace, its derivatives and the path tracer; beside it in one scene a
    mirror without it, and a figure, heat and a term of another kind on top of it.
    """
    text = f"{{z: 0 m, radius: -{RADIUS} m, sag: {{cylinder: {{curvature: {1 / ACROSS} 1/m, step: 0.001}}}}}}"
    with pytest.raises(InputError, match=r"sag.cylinder: no such term of a sag; found 'cylinder', allowed: polynomial"):
        validate(MirrorSpec, parse_yaml(text))
    add(monkeypatch, SAGS, "cylinder", Cylinder)
    mirror = validate(MirrorSpec, parse_yaml(text))
    assert mirror.plain()["sag"] == {"cylinder": {"curvature": "0.25 1/m", "step": 0.001}}
    for wrong, said in (
        ("step: 1 m", "sag.cylinder.step: not a number; found '1 m', allowed: a plain number, without a unit"),
        ("curvature: 1 m", "sag.cylinder.curvature: 'm' is a unit of a length, not of an inverse length"),
        ("curvatur: 1 1/m", "unknown key; did you mean 'curvature'? Found 'curvatur', allowed: curvature, step"),
    ):
        with pytest.raises(InputError, match=re.escape(said)):
            validate(MirrorSpec, parse_yaml(f"{{z: 0 m, radius: 1 m, sag: {{cylinder: {{{wrong}}}}}}}"))
    schema = json_schema("camera")["$defs"]["MirrorSpec"]["properties"]["sag"]["anyOf"][0]["properties"]
    assert schema["cylinder"]["properties"]["step"] == {"type": "number"}

    # the sequential trace meets the surface of a mirror that has scaled_term; rounding of metres
    surface, state = surface_of(mirror), {"mirror": Motion(scale=2e-3)}
    np.testing.assert_allclose(surface.sag(0.1, PLACES), astigmatic(0.1, PLACES), rtol=0, atol=1e-15)
    systems = assemble(path_figure.bench(surface, Circle(0.2)), ["all"], [state])
    traced = trace(backend, systems, make_rays(backend, *path_figure.rays(500)), keep=[0])
    valid = traced.numpy()[3][0]
    x, y, z = traced.hit(0)[0][valid].T
    np.testing.assert_allclose(z, astigmatic(x, y, 1.002), rtol=0, atol=1e-14)
    # slopes, and by them directions, lengths and the path tracer
    check_term(Cylinder(curvature=0.1, step=0.02), backend)
    for case in ((surface, path_figure.ASTIGMATIC, state), (replace(surface, even=(1e-3,)), path_figure.WAVY, {})):
        monkeypatch.setitem(path_figure.CASES, "toy", case)
        path_figure.test_a_figured_mirror_as_the_sequential_trace_has_it(backend, "toy", "disk")


@dataclass(frozen=True)
class NumpyHeight:
    """A sag term whose ``height`` calls NumPy, which would end the process while a kernel is recorded."""

    POWERS: ClassVar = {"amount": 1}
    amount: Any = 0.0

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        return self.amount * np.cos(x), -self.amount * np.sin(x), 0.0 * y


@dataclass(frozen=True)
class NoSlopes(NumpyHeight):
    """A sag term that returns its height alone."""

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        return self.amount * x


@pytest.mark.parametrize("kind", [NumpyHeight, NoSlopes])
def test_a_height_that_is_no_kernel_is_refused(kind: Any, backend: Any) -> None:
    surface = replace(surface_of(validate(MirrorSpec, parse_yaml("{z: 0 m, radius: -4 m}"))), terms=(kind(1e-9),))
    systems = assemble(path_figure.bench(surface, Circle(0.2)), ["all"], [{}])
    with pytest.raises(EntryPointError, match=f"{kind.__name__} of .*: its height cannot become part of a kernel"):
        trace(backend, systems, make_rays(backend, *path_figure.rays(500)))
    with pytest.raises(ValueError, match="there are no rays to trace"):
        trace(backend, systems, make_rays(backend, np.empty((0, 3)), np.empty((0, 3))))


@pytest.mark.parametrize("name", sorted(SAG_TERMS))
def test_what_a_term_of_a_sag_has_to_keep_to(name: str, backend: Any) -> None:
    kind = SAG_TERMS[name]
    assert list(kind.POWERS) == [f.name for f in fields(kind)]
    generator = np.random.default_rng(3)
    # some 0.1 m of sag over half a metre: a term about a disk has one as large as that, and amplitudes
    ranges = {
        key: (1e-5, 1e-4) if key[0] == "Z" else (0.7, 0.8) if key == "radius" else (0.01, 0.1) for key in kind.POWERS
    }
    check_term(kind(**{key: generator.uniform(*ranges[key]) for key in kind.POWERS}), backend)


def check_term(term: Any, backend: Any) -> None:
    """What kernels compute is what NumPy computes, with its slopes; without numbers it adds nothing; and a length that
    grows takes all numbers along.
    """
    x, y = np.random.default_rng(4).uniform(-0.5, 0.5, (2, 100))
    h = 1e-4
    height, by_x, by_y = (np.array(a) for a in term.height(backend.Float(x), backend.Float(y)))
    np.testing.assert_allclose(height, term.sag(x, y), rtol=0, atol=1e-16)
    # of fourth order: exact for a polynomial but for rounding of 0.1 m over h
    for slope, (dx, dy) in ((by_x, (h, 0.0)), (by_y, (0.0, h))):
        far, near = (term.sag(x + n * dx, y + n * dy) - term.sag(x - n * dx, y - n * dy) for n in (2, 1))
        np.testing.assert_allclose(slope, (8.0 * near - far) / (12.0 * h), rtol=0, atol=1e-12)
    for nothing in type(term)().height(backend.Float(x), backend.Float(y)):
        assert np.all(np.array(nothing) == 0.0)
    # rounding, also of sums that cancel
    np.testing.assert_allclose(
        scaled_term(term, 3.0).sag(3.0 * x, 3.0 * y), 3.0 * term.sag(x, y), rtol=1e-13, atol=1e-16
    )


# --- reflectors of the monitor ----------------------------------------------------------------------------------------

REFLECTORS = "optics.raytrace.reflectors.REFLECTORS"
TURN = 2.0 * ARCSEC
PRISM_180 = "{material: fused silica, distance: 2.4 m, width: 60 mm, tilt: [3 arcmin, 3 arcmin]}"
PRISM_0 = "{material: fused silica, distance: 0.5 m, shift: 100 mm, width: 60 mm, tilt: [3 arcmin, 3 arcmin]}"


def with_mirrors(folder: Path, *changes: tuple[str, str]) -> Path:
    """The library's pair with mirrors in place of its prisms, as files, and a job for it."""
    text = (LIBRARY / "instruments" / "gf7_pair.yaml").read_text("utf-8")
    made = "{kind: corner, material: fused silica, distance: 2.4 m, width: 60 mm}"
    onward = "{kind: two_plates, material: fused silica, distance: 0.5 m, shift: 130 mm, width: 60 mm}"
    for old, new in (("name: gf7_pair", "name: mirrors"), (PRISM_180, made), (PRISM_0, onward), *changes):
        assert text.count(old) == 1
        text = text.replace(old, new)
    (folder / "mirrors.yaml").write_text(text, "utf-8")
    (folder / "job.yaml").write_text("instrument: mirrors.yaml\n", "utf-8")
    return folder / "job.yaml"


@extends(REFLECTORS)
@pytest.mark.second
def test_a_reflector(backend: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plane mirrors in place of both prisms: named by a file, traced, followed by the path tracer."""
    with pytest.raises(InputError, match=r"prism_180.kind: not one of the choices; found 'corner', allowed: lateral_"):
        resolve(with_mirrors(tmp_path))
    add(monkeypatch, REFLECTORS, "corner", CORNER)
    add(monkeypatch, REFLECTORS, "two_plates", TWO_PLATES)
    schema = json_schema("instrument")["$defs"]
    for prism, kinds in (("Prism180Spec", ["hollow_transfer", "corner"]), ("Prism0Spec", ["periscope", "two_plates"])):
        assert schema[prism]["properties"]["kind"]["anyOf"][0]["enum"][-2:] == kinds
    for change, said in (
        (("corner, ", "corner, angle_errors: {window: [0 rad, 0 rad]}, "), "no such face; found 'window', allowed: mi"),
        (("kind: two_plates", "kind: corner"), "prism_0.kind: not one of the choices; found 'corner', allowed: rhombo"),
        (("shift: 130 mm", "shift: 110 mm"), "monitor.prism_0.shift: base/forward/monitor/left/prism_0: the mirrors"),
    ):
        with pytest.raises(InputError, match=re.escape(said)):
            MonitorExperiment(resolve(with_mirrors(tmp_path, change)), backend)
    experiment = MonitorExperiment(resolve(with_mirrors(tmp_path)), backend)
    instrument = experiment.instrument
    assert not instrument.assembly.media
    # the plates that take the monitor's light out of the pupil stand in the cameras', nothing in the monitor's
    obstructions = find_obstructions(instrument, backend)
    assert {(o.body.rpartition("/")[2], o.beam.rpartition("/")[2]) for o in obstructions} == {("mirror", "imaging")}
    assert all(0.0 < o.used <= o.share < 0.03 for o in obstructions)

    # spots: as a whole they may turn; one mirror by an angle, about an axis square to the beams, is a facet by twice
    # that, and the spot moves by four times f; the focal length differs by 3 % across the line
    def turned(part: str, vector: tuple[float, float, float], pivot: str = "origin") -> State:
        return {f"base/{c.camera}/monitor/{c.name}/{part}": Motion(rotate=vector, pivot=pivot) for c in channels}

    channels = instrument.channels
    whole = [turned(prism, tuple(TURN * np.eye(3)[a]), "centre") for prism in PRISMS for a in range(3)]
    single = [turned(part, (0.0, TURN, 0.0)) for part in ("prism_0/first", "prism_0/second", "prism_180/mirror")]
    places = np.moveaxis(test_prism_images.spots(experiment.path, [{}, *whole, *single]), 0, 1)
    moved = places[1:] - places[:1]
    # coma, and that beams walk over the mirrors of the camera
    assert np.abs(places[0]).max() < 0.1
    assert np.abs(moved[: len(whole)]).max() < test_prism_images.STILL
    focal = np.array([instrument.cameras[c.camera].line_principal_distance for c in channels])
    for shift in moved[len(whole) :]:
        np.testing.assert_allclose(np.linalg.norm(shift, axis=-1), 4.0 * TURN * focal / 12e-6, rtol=0.07)
    # the path tracer, with a mirror turned
    state = turned("prism_0/first", (0.0, TURN, 0.0))
    scenery = build_scenery(instrument, state, IDEAL)
    tracer = PathTracer(backend, scenery, monitor_families(scenery, instrument))
    aimed, placed = experiment.path.nominal, instrument.assembly.place([state])
    for number, channel in enumerate(channels):
        direction = aimed.direction[number]
        position = np.broadcast_to(placed.pose(channel.reticle_body).translation, direction.shape)
        systems = assemble(instrument.assembly, [f"{channel.key}/monitor"], [state])
        traced = trace(backend, systems, make_rays(backend, position, direction))
        place, _, _, valid = (a[0] for a in traced.numpy())
        found = tracer.run(RaySource.even(position, direction), keep=True).detections
        ccd = [d.name for d in scenery.detectors].index(f"{channel.key}/area_ccd")
        own = (found.kind == NOMINAL) & (found.detector == ccd)
        path = found.path[own]
        np.testing.assert_array_equal(np.sort(path), np.nonzero(valid)[0])
        assert valid.sum() > 100
        np.testing.assert_allclose(found.place[own], place[path, :2], rtol=0, atol=1e-12)


# --- studies ----------------------------------------------------------------------------------------------------------

SAMPLERS = "scenes.specs.study.SAMPLERS"
FORMATS = "twin.study.study_files.FORMATS"
MIDDLE = Sampler("all in the middle", lambda runs, factors, generator: np.full((runs, factors), 0.5))


def study_folder(place: Path, kind: str, runs: int = 12) -> tuple[Plan, Path]:
    """A study's plan, and the folder of its files; what the runs gave is made up here."""
    path = write_study_file(place, ("kind: monte_carlo, runs: 100", f"kind: {kind}, runs: {runs}"))
    setup = resolve_study(path)
    plan = Plan.of(setup)
    values = np.stack([np.linspace(0.0, 1.0, runs), np.linspace(0.0, 1.0, runs)], axis=-1)
    result = BlockResult(values, *(np.full(values.shape, s) for s in (0.1, 0.01)), ("",) * runs, 1.0, ("",) * runs)
    with RunFolder(place / "run") as folder:
        numbers = write_data(plan, result, 1.0, runs, folder)
        write_report(numbers.data, plan, folder, numbers.files)
        write_manifest(
            folder, "twin.study", 0.0, 1.0, backend="llvm", seed=1, runs=runs, failed=0, workers=1, warnings=[]
        )
    return plan, place / "run"


@pytest.mark.second
@extends(SAMPLERS)
def test_a_sampler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every run gets the medians of its factors; the report names the design."""
    add(monkeypatch, SAMPLERS, "middle", MIDDLE)
    plan, folder = study_folder(tmp_path, "middle")
    values = {column.name: column.values for column in plan.columns}
    # of a normal distribution about 0 um, and of an even one from -1 um to 1 um; rounding of the quantile
    assert set(values) == {"m2z", "m2x"}
    for found in values.values():
        np.testing.assert_allclose(found, np.zeros(12), rtol=0, atol=1e-15)
    with xr.open_dataset(folder / "study.nc", engine="h5netcdf") as data:
        assert data.attrs["design"] == "middle"
        np.testing.assert_array_equal(data["m2x"].values, values["m2x"])
    assert "all in the middle" in page_text(folder)
    assert json_schema("study")["$defs"]["DesignSpec"]["properties"]["kind"]["enum"][-1] == "middle"


@extends("twin.framework.data_files.TABLE_FORMATS")
@pytest.mark.second
def test_an_output_format_of_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names and units of the columns alone: chosen by its name, written for every table and listed."""
    text = "; ".join
    form: Callable[[Any], bytes] = lambda table: text(f"{c.name} in {c.unit}" for c in table.columns).encode()  # noqa: E731
    add(monkeypatch, "twin.framework.data_files.TABLE_FORMATS", "heads", form)
    study_folder(tmp_path, "monte_carlo")
    done = invoke(twin.export.__main__.app, tmp_path / "run", "--tables", "heads", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "m2z in um; m2x in um" in (tmp_path / "out/tables/study.heads").read_text("utf-8")
    assert {"tables/study.heads", "tables/numbers.heads"} == {
        one["file"] for one in read(tmp_path / "out", "files")["files"]
    }


@pytest.mark.second
@extends(FORMATS)
def test_an_output_format_of_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The data set as JSON: whole, in the manifest and named in the report."""
    add(monkeypatch, FORMATS, "columns", lambda data: json.dumps(data.to_dict()).encode())
    add(monkeypatch, FORMATS, "missing", lambda data: None)
    _, folder = study_folder(tmp_path, "monte_carlo")
    with xr.open_dataset(folder / "study.nc", engine="h5netcdf") as data:
        found = xr.Dataset.from_dict(json.loads((folder / "study.columns").read_text("utf-8")))
        assert set(found.data_vars) == set(data.data_vars)
        np.testing.assert_array_equal(found["m2z"].values, data["m2z"].values)
    assert "study.columns" in read(folder, "manifest")["sha256"]
    assert not (folder / "study.missing").exists()
    page = page_text(folder)
    assert '<a href="study.columns">' in page
    assert "study.missing" not in page


# --- a whole test -----------------------------------------------------------------------------------------------------

PROCEDURES = "scenes.specs.procedures.PROCEDURES"
TOY_TEST = "tests.twin.test_procedure"
"""The toy's own modules, which the entry names and which are imported when they are used."""


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Makes anew what reads the list of tests once, when a program starts; and again when the test ends."""

    def start() -> None:
        for module in (scenes.schema, twin.lab):
            importlib.reload(module)

    yield start
    monkeypatch.undo()
    start()


@extends(PROCEDURES)
def test_a_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, started: Callable[[], None]) -> None:
    """One entry: command with its help, schema, messages about files, study and script know the toy."""
    toy = Procedure(
        "level",
        setup=f"{TOY_TEST}:LevelSetup",
        run=f"{TOY_TEST}:measure",
        numbers=f"{TOY_TEST}:numbers",
        report=f"{TOY_TEST}:report",
        files=(FileKind("level_test", f"{TOY_TEST}:LevelSpec", "a test of a level"),),
        varied=True,
        about="Read a level.",
        frames={"readings_arcsec": "about the level's own axis"},
    )
    add(monkeypatch, PROCEDURES, "lab level", toy)
    started()
    file, out = tmp_path / "level.yaml", tmp_path / "run"
    file.write_text("name: levels\nreadings: 5\nsigma_arcsec: 0.5\nseed: 3\n", "utf-8")
    assert re.search(r"level +Read a level\.", invoke(twin.lab.app, "--help").stdout)
    assert "Read a level." in invoke(twin.lab.app, "level", "--help").stdout
    done = invoke(twin.lab.app, "level", file, "--out", out)
    assert done.exit_code == 0, done.output
    found = read(out, "level")
    assert found["reference_frames"] == dict(toy.frames)
    assert json_schema("level_test")["properties"].keys() == {"name", "readings", "sigma_arcsec", "seed"}
    assert "lab level" in json_schema("study")["$defs"]["BaseSpec"]["properties"]["command"]["enum"]
    refused = invoke(twin.lab.app, "focus", file, "--out", tmp_path / "none")
    said = " ".join(refused.stderr.split())
    assert f"this is a test of a level, which twin.lab focus does not read; python -m twin.lab level {file}" in said
    result = twin.perform("lab level", file, seed=4)
    assert result.numbers["readings_arcsec"] == np.random.default_rng(4).normal(0.0, 0.5, 5).tolist()
    assert twin.perform("lab level", file).numbers["mean_arcsec"] == found["mean_arcsec"]


# --- orbits -----------------------------------------------------------------------------------------------------------

FORCES = "twin.orbit.flight.orbit.FORCES"
DRAG = 2e-13
"""Density times half of the drag coefficient times area over mass, 1/m: 1e-5 m/s^2 in a low orbit."""
EARTH_RATE = np.array([0.0, 0.0, 7.292115e-5])
SPAN = 600.0


def drag(seconds: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Of air of even density that turns with the Earth."""
    wind = velocity - np.cross(EARTH_RATE, position)
    return -DRAG * np.linalg.norm(wind) * wind


def flown() -> Orbit:
    passing = {"longitude": "116 deg", "latitude": "40 deg"}
    spec = {"epoch": "2011-03-05T03:05:00Z", "passing": passing, "before": "0 s", "after": f"{SPAN} s"}
    return propagate(OrbitSpec.model_validate(spec), Earth(0.0, (0.0, 0.0)))


@extends(FORCES)
def test_an_orbit_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drag, against Runge and Kutta's fourth order in steps of a second."""
    free = flown()
    add(monkeypatch, FORCES, "drag", drag)
    braked = flown()
    y = np.concatenate(free.equatorial(0.0))

    def derivative(y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], acceleration(y[:3]) + drag(0.0, y[:3], y[3:])])

    for _ in range(int(SPAN)):
        a = derivative(y)
        b = derivative(y + 0.5 * a)
        c = derivative(y + 0.5 * b)
        y = y + (a + 2.0 * b + 2.0 * c + derivative(y + c)) / 6.0
    end, there = braked.equatorial(SPAN)[0], free.equatorial(SPAN)[0]
    moved = float(np.linalg.norm(end - there))
    # 3/2 a t^2 along the track for short times
    assert 2.0 < moved < 10.0
    # a step's error is (n h)^5/120 of the radius, 1e-10 m; the orbit's own tolerance and rounding stay below 1e-5 m
    assert np.linalg.norm(end - y[:3]) < 1e-4


# --- checks of the papers ---------------------------------------------------------------------------------------------

GROUPS = "twin.validation.registry.GROUPS"
SUM = Check(
    id="001.toy.sum", equation="none", statement="One and one are two.", printed=2.0, tolerance=1e-12,
    because="rounding", tells=1.0, against="three",
)  # fmt: skip


@extends(GROUPS)
@pytest.mark.parametrize(("one", "verdict", "code"), [(1.0, "confirmed", 0), (1.5, "refuted", 1)])
def test_a_check_of_a_paper(
    one: float, verdict: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is listed, run and judged; a wrong sum is refuted and fails the command."""
    run = partial(invoke, twin.validate.app)

    def answer(context: Any) -> Iterator[Any]:
        yield context.check(SUM.id).evaluate(1.0 + one, None, "Added.")

    add(monkeypatch, GROUPS, None, CheckGroup("001.toy", "Sums", 1.0, (SUM,), answer))
    assert SUM.id in run("--list").stdout
    done = run("--only", "001.toy", "--out", tmp_path / "run")
    assert done.exit_code == code, done.output
    (found,) = read(tmp_path / "run", "validation")["checks"]
    assert (found["id"], found["measured"], found["verdict"]) == (SUM.id, 1.0 + one, verdict)
    assert "One and one are two." in html.unescape((tmp_path / "run" / "validation.html").read_text("utf-8"))


# --- other distributions ----------------------------------------------------------------------------------------------

INSTALLED = {
    "estimators": "half = toy_twin:Half",
    "noise_terms": "two_levels = toy_twin:TwoLevels",
    "centroids": "again = toy_twin:AGAIN",
    "targets": "one_bar = toy_twin:one_bar",
    "sag_terms": "cylinder = toy_twin:Cylinder",
}


def install(folder: Path, groups: Mapping[str, str], name: str = "toy-twin") -> Path:
    """Write a distribution as pip does into a folder of the path: its module, its name and its entry points."""
    about = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", "utf-8")
    text = "".join(f"[{PREFIX}{group}]\n{lines}\n" for group, lines in groups.items())
    (about / "entry_points.txt").write_text(text, "utf-8")
    shutil.copy(Path(__file__).with_name("toy_twin.py"), folder)
    return folder


def run_with(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run Python with a folder of distributions on its path."""
    path = os.pathsep.join((str(PAGE.parents[1]), str(folder)))
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "500"}
    return subprocess.run([sys.executable, *map(str, words)], env=environment, capture_output=True, text=True)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path], None]]:
    """Puts a folder of distributions on the path of this process until the test ends."""
    kept = (entries, provenance.sources, provenance.program_digest, calibration_cache._machine)

    def add_folder(folder: Path) -> None:
        monkeypatch.syspath_prepend(folder)
        # that of another test lies elsewhere
        sys.modules.pop("toy_twin", None)
        for function in kept:
            function.cache_clear()

    yield add_folder
    monkeypatch.undo()
    for function in kept:
        function.cache_clear()


def noisy_job(folder: Path) -> Path:
    """A job with small CCDs that have a noise of another distribution, and a study of it of two blocks."""
    one = "kind: monte_carlo, runs: 100, seed: 3}", "kind: monte_carlo, runs: 26, seed: 3}"
    path = write_study_file(folder, one, ("true_df: {key: [truth, cameras, forward, d_f_um]}", HALVED))
    sheet_file(folder, "{two_levels: 300.0}")
    small = (folder / "small.yaml").read_text("utf-8")
    (folder / "small.yaml").write_text(small.replace("detector: monitor_ccd", "detector: noisy.yaml"), "utf-8")
    (folder / "job.yaml").write_text(
        "instrument: small.yaml\nrender: {frames: 1, seed: 1}\nanalysis: {centroid: again}\n", "utf-8"
    )
    return path


HALVED = "half: {key: [recovered, cameras, forward, half, d_f_um]}"


def test_another_distribution(tmp_path: Path) -> None:
    """Estimator, noise and centroid of entry points count in a job of a process that knows nothing else of them."""
    path, folder = install(tmp_path / "path", INSTALLED), tmp_path / "run"
    noisy_job(tmp_path)
    code = (
        "from optics.targets.target_shapes import TARGETS; from optics.geometry.sag_terms import SAG_TERMS\n"
        "import twin.render; assert {'one_bar', 'cylinder'} < {*TARGETS, *SAG_TERMS}; twin.render.app()"
    )
    done = run_with(path, "-c", code, tmp_path / "job.yaml", "--out", folder, "--quiet")
    assert done.returncode == 0, done.stderr
    forward = read(folder, "recovered")["cameras"]["forward"]
    assert forward["half"]["d_f_um"] == pytest.approx(0.5 * forward["derived"]["d_f_um"], rel=1e-5)
    assert AGAIN.title in page_text(folder)
    # without light a pixel reads 100 + 0.16 (+-300) grey values
    frame = tifffile.imread(next((folder / "images").glob("*before*.tiff"))).astype(float)
    border = np.concatenate([frame[..., 0, :].ravel(), frame[..., -1, :].ravel()])
    assert np.std(border) == pytest.approx(0.16 * 300.0, rel=0.2)
    assert read(folder, "manifest")["versions"]["toy-twin"] == "1.0"


@pytest.mark.second
def test_the_command_of_the_page(tmp_path: Path) -> None:
    """docs/extending.md, file by file: a command with its help, its run folder, and what it says of a wrong key."""
    text = (PAGE.parent / "extending.md").read_text("utf-8")
    path = install(tmp_path / "path", {"procedures": "lab level = levelling.entry:LEVEL"})
    for name, content in re.findall(r"^`([\w/]+\.(?:py|yaml))`:\n```\w*\n(.*?)```", text, re.M | re.S):
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_text(content, "utf-8")
    done = run_with(path, "-m", "twin.lab", "level", path / "my_level.yaml", "--out", tmp_path / "run", "--seed", 4)
    assert done.returncode == 0, done.stderr
    level = read(tmp_path / "run", "level")
    # the seed gives 25 readings, of 0.5 arcsec: a false alarm in 1e5 seeds
    assert abs(level["tilt_arcsec"] - 3.0) < 0.45
    assert 0.04 < level["tilt_arcsec_sigma"] < 0.2
    assert "gf7 is tilted by" in done.stdout
    assert "tilt [arcsec]" in page_text(tmp_path / "run")
    (path / "my_level.yaml").write_text("name: x\ncamera: gf7\ntilts: 3 arcsec\n", "utf-8")
    done = run_with(path, "-m", "twin.lab", "level", path / "my_level.yaml", "--out", tmp_path / "none")
    assert (done.returncode, "tilts" in done.stderr, (tmp_path / "none").exists()) == (2, True, False)


@pytest.mark.second
def test_another_distribution_in_workers(tmp_path: Path) -> None:
    """A worker process sees its entries; a study does not go on with another version of it."""
    path, study, out = install(tmp_path / "path", INSTALLED), noisy_job(tmp_path), tmp_path / "run"
    done = run_with(path, "-m", "twin.study", study, "--out", out, "--workers", 1, "--quiet")
    assert done.returncode == 0, done.stderr
    with xr.open_dataset(out / "study.nc", engine="h5netcdf") as data:
        assert np.std(data["half"].values) > 0.0
    (path / "toy_twin.py").write_text((path / "toy_twin.py").read_text("utf-8").replace("0.5 *", "0.25 *"), "utf-8")
    done = run_with(path, "-m", "twin.study", study, "--out", out, "--workers", 1, "--quiet", "--resume")
    assert done.returncode != 0
    assert "changed: toy_twin.py" in done.stderr


def test_another_distribution_is_part_of_the_program(tmp_path: Path, installed: Callable[[Path], None]) -> None:
    """Its version and the content of its module count where those of the program do."""
    keys, entry = [], partial(calibration_cache.CacheEntry.of, load_backend(), ())
    keys.append((entry().key, provenance.source_digest(), provenance.program_digest()))
    folder = install(tmp_path, INSTALLED)
    for text in ("", "# another\n"):
        with (folder / "toy_twin.py").open("a", encoding="utf-8") as file:
            file.write(text)
        installed(folder)
        SAG_TERMS.__dict__.pop("data", None)
        keys.append((entry().key, provenance.source_digest(), provenance.program_digest()))
    SAG_TERMS.__dict__.pop("data", None)
    assert provenance.versions()["toy-twin"] == "1.0"
    for column in zip(*keys, strict=True):
        assert (None in column, len(set(column))) == (False, 3), column


def test_entries_that_cannot_be_used(tmp_path: Path, installed: Callable[[Path], None]) -> None:
    """What is wrong is said with distribution, group, name and remedy when that entry is used, and not before."""
    install(tmp_path, {"toys": "gone = no_such_module:Toy\nnumber = toy_twin:BAR\nown = toy_twin:Half"})
    installed(install(tmp_path, {"toys": "half = toy_twin:Half\ntwice = toy_twin:Half"}, "a-toy"))
    (tmp_path / "toy_twin-1.0.dist-info/entry_points.txt").open("a").write("twice = toy_twin:Half\n")
    own = Half()
    table = ExtensionTable("toys", {"own": own, "other": own}, Estimator)
    assert [*table] == ["own", "other", "half", "twice", "gone", "number"]
    assert (table["other"], table["half"].title) == (own, "half")
    for name, said in (
        ("gone", r"toy-twin 1.0: the entry gone = no_such_module:Toy of space_camera_twin.toys cannot be loaded \(Mod"),
        ("number", "number = toy_twin:BAR of space_camera_twin.toys is of type tuple, not Estimator; repair"),
        ("own", "own = .* has the name of an entry of the twin or .*; rename .* pip uninstall toy-twin"),
        ("twice", "toy-twin 1.0: .* has the name of an entry of a-toy; rename it there, or pip uninstall toy-twin"),
    ):
        with pytest.raises(EntryPointError, match=said):
            table[name]
    with pytest.raises(KeyError):
        table["none"]


def test_help_and_messages_with_an_entry_that_cannot_be_used(tmp_path: Path) -> None:
    path = install(tmp_path, {"procedures": "lab level = no_such_module:LEVEL"})
    (tmp_path / "bad.yaml").write_text("instrument: gf7_pair\nno_such_key: 1\n", "utf-8")
    shown = run_with(path, "-m", "twin.lab", "--help")
    assert shown.returncode == 0
    assert re.search(
        r"focus +Align .*\n(.*\n)*.*level +toy-twin 1.0: the entry lab level = no_such_module", shown.stdout
    )
    refused = run_with(path, "-m", "twin.lab", "level", "level.yaml", "--out", tmp_path / "run")
    assert refused.returncode == 1
    assert "(ModuleNotFoundError: No module named 'no_such_module'); repair or update it" in refused.stderr
    told = run_with(path, "-m", "twin.render", tmp_path / "bad.yaml")
    assert (told.returncode, "bad.yaml:2: no_such_key: unknown key" in told.stderr) == (2, True)
