"""Commands and readers in orbit refuse what they cannot use, and name it: cases in orbit_refusals.yaml, and functions
that no file leads to. The examples of docs/orbit_files.md are read.
"""

import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace as Ns
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from rasterio.transform import from_origin

import twin.orbit.__main__ as command
from analysis.orbit.forward_intersection import CalibratedLine, IntersectionError
from analysis.orbit.rational_polynomial import fit_rpc
from analysis.orbit.three_line_model import LineModel
from analysis.spots.spot_image import SpotError
from optics.numerics.array_math import UnphysicalError
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import EffectsSpec
from scenes.specs.orbit.measurements import (
    GroundFileSpec,
    OrbitCheckSpec,
    OrbitMatchSpec,
    PlatformFilesSpec,
    RasterFileSpec,
    with_absolute_files,
)
from scenes.specs.orbit.setup import (
    AngleSetup,
    CheckSetup,
    JitterSetup,
    MatchSetup,
    MeasuredAdjustSetup,
    MeasuredAngleSetup,
    SimulateSetup,
    load_three_line_camera,
)
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.tiers import quick
from tests.twin import dimap_bench, orbit_files
from tests.twin import orbit_file_bench as bench
from tests.twin.commands import edited_copy, invoke, refused
from tests.twin.orbit_files import REFUSALS
from tests.twin.pushbroom_bench import lost
from twin.framework.cli import InputErrorText
from twin.framework.cluster import ClusterError
from twin.framework.data_files import FrameFacts, tiff
from twin.framework.procedure import BenchError
from twin.laboratory.distortion_run import _check_angles
from twin.orbit.angle.angle_flight import angle_camera
from twin.orbit.angle.angle_run import SimulatedAngleRun
from twin.orbit.angle.measured_angle import angle_exported, run_measured_angle
from twin.orbit.block import block_run
from twin.orbit.block.block_run import PointWorkers, run_adjustment
from twin.orbit.calibration.campaign import light_shift
from twin.orbit.conventions.check_run import run_check
from twin.orbit.export.export_run import read_exportable, run_export
from twin.orbit.export.ground_accuracy import ground_rows
from twin.orbit.export.quality_run import read_polynomial_source
from twin.orbit.export.rational_polynomial import corrected_polynomial, read_rpc, sensor_polynomial
from twin.orbit.flight.earth import Earth
from twin.orbit.ground.grid import GroundFrame
from twin.orbit.images.image_points import PointsError, measure_points
from twin.orbit.images.line_optics import optics_of
from twin.orbit.images.patch import Patch, PatchError
from twin.orbit.images.simulate_run import run_simulation
from twin.orbit.jitter import jitter_run, sights
from twin.orbit.jitter.sights import SightsError, sights_of
from twin.orbit.matching import match_run
from twin.orbit.matching.match_run import run_match
from twin.orbit.measured.earth_orientation import read_earth_orientation
from twin.orbit.measured.ground_files import read_ground_points
from twin.orbit.measured.maps import UserMap
from twin.orbit.measured.pass_measurements import GroundPoints
from twin.orbit.measured.platform_files import platform_table, read_platform, read_scene
from twin.orbit.monitoring import closed_loop, monitoring_run
from twin.orbit.monitoring.monitor_series import MonitorSeries

ROOT = Path(__file__).resolve().parents[2]
JOBS = [one for job in REFUSALS["jobs"] for one in quick(job["quick"], [(job, *case) for case in job["cases"]])]


@pytest.mark.parametrize(("job", "old", "new", "key", "words"), JOBS)
def test_a_job_is_refused_by_line_and_key(
    job: dict[str, Any], old: str, new: str, key: str, words: list[str], tmp_path: Path
) -> None:
    source = ROOT / job["file"]
    base = [(a, b.replace("{folder}", str(source.parent))) for a, b in job.get("base", ())]
    path = edited_copy(source, tmp_path, *base, (old, new))
    refused(partial(invoke, command.app), job["command"], path, key, words)


# --- files --------------------------------------------------------------------------------------------------


def campaign_files(folder: Path) -> None:
    setup = orbit_files.small()
    fields = type(setup.test.fields)({"Beijing": setup.test.fields["Beijing"]})
    test = setup.test.model_copy(update={"fields": fields, "schemes": (("Beijing",),)})
    setup = setup.model_copy(update={"test": test})
    orbit_files.export(folder, setup, orbit_files.flown(setup))


def platform_files(folder: Path) -> None:
    bench.orbit_csv(folder / "orbit.csv")
    bench.attitude_csv(folder / "attitude.csv")
    bench.oem_xml(folder / "a.xml")
    for kind in (bench.oem, bench.aem, bench.sp3):
        kind(folder / f"a.{kind.__name__}")


def map_files(folder: Path) -> None:
    """Maps in UTM: a good one, and others by numbers, place and format."""
    how: dict[str, Any] = {"driver": "GTiff", "count": 1, "width": 150, "height": 120}
    near = (499_000.0, 4_429_000.0)
    for name, dtype, corner, value in (
        ("utm.tif", "float32", near, 100.0),
        ("complex.tif", "complex64", near, 1.0),
        ("high.tif", "float32", near, -32768.0),
        ("tall.tif", "float32", near, 15_000.0),
        ("empty.tif", "float32", near, np.nan),
        ("far.tif", "float32", (299_000.0, 4_429_000.0), 1.0),
        ("nosystem.tif", "float32", near, 1.0),
        ("geoid.tif", "float32", None, 1.0),
        ("hollow.tif", "float32", None, -99.0),
        ("wild.tif", "float32", None, 151.0),
    ):
        place = from_origin(*corner, 20.0, 20.0) if corner else from_origin(0.0, 1.0, 0.01, 0.01)
        crs = None if name == "nosystem.tif" else "EPSG:32650" if corner else "EPSG:4326"
        more = {"dtype": dtype, "crs": crs, "transform": place, "nodata": None if corner else -99.0}
        with rasterio.open(folder / name, "w", **how, **more) as file:
            file.write(np.full((120, 150), value, dtype), 1)
    fine = {"dtype": "uint8", "crs": "EPSG:32650", "transform": from_origin(498_000.0, 4_430_000.0, 0.05, 0.05)}
    rasterio.open(folder / "large.tif", "w", **how | fine | {"width": 60_000, "height": 60_000}, SPARSE_OK=True).close()
    with rasterio.open(folder / "image.png", "w", driver="PNG", width=4, height=4, count=1, dtype="uint8") as file:
        file.write(np.zeros((4, 4), "u1"), 1)
    (folder / "text.tif").write_text("no TIFF")
    (folder / "cut.tif").write_bytes((folder / "utm.tif").read_bytes()[:3000])
    (folder / "plain.tif").write_bytes(tiff(np.zeros((1, 40, 40), "f4"), FrameFacts()))


def scene_files(folder: Path) -> None:
    dimap_bench.write(folder, dimap_bench.Scene())
    dimap_bench.write(folder, dimap_bench.Scene(attitude="samples"), "DIM_SAMPLES.XML")


def rpc_files(folder: Path) -> None:
    scene = dimap_bench.Scene()
    sensor = read_scene(dimap_bench.write(folder, scene)).sensor
    model = sensor_polynomial(sensor, 0, scene.pixels, (0.0, 2000.0))
    (folder / "a_RPC.TXT").write_text(model.text())
    (folder / "RPC.XML").write_text(dimap_bench.rpc(model))
    (folder / "plain.tif").write_bytes(tiff(np.zeros((1, 32, 32), np.uint16), FrameFacts()))


def match_files(folder: Path) -> dict[str, Any]:
    setup = SimulateSetup.read(SCENES / ORBIT / "simulate.yaml")
    patch = setup.test.patch.model_copy(update={"lines": 320, "pixels": 320})
    test = setup.test.model_copy(update={"patch": patch, "points": None, "oversampling": 2})
    for name, value in (("nan", np.full((40, 40), np.nan, "f4")), ("complex", np.zeros((40, 40), "c8"))):
        tifffile.imwrite(folder / f"{name}.tiff", value)
    size = {"width": 20_000, "height": 20_000, "count": 1, "dtype": "uint8"}
    rasterio.open(folder / "large.tiff", "w", driver="GTiff", SPARSE_OK=True, **size).close()
    return bench.match_files(folder, run_simulation(setup.model_copy(update={"test": test}), None, 3))


def map_used(folder: Path, spec: dict[str, Any]) -> None:
    user = UserMap.open(RasterFileSpec.model_validate(spec), folder, heights=True)
    user.limits()
    user.part(GroundFrame(np.radians(117.0), np.radians(40.0)), (-400.0, 500.0, -300.0, 600.0), heights=True)


def angle_used(folder: Path, spec: dict[str, Any]) -> None:
    (folder / "angle.yaml").write_text(dump_yaml(spec))
    run_measured_angle(MeasuredAngleSetup.read(folder / "angle.yaml"))


def used(kind: type, setup: type, run: Callable[..., object], folder: Path, spec: dict[str, Any]) -> None:
    test = with_absolute_files(kind.model_validate(spec), folder)
    run(setup.model_construct(test=test, camera=load_three_line_camera("th1")), None, 0)


def block_files(folder: Path) -> None:
    shutil.copytree(SCENES / ORBIT / "measured", folder, dirs_exist_ok=True)


READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Path, dict[str, Any]], object]]] = {
    "campaign": (campaign_files, lambda folder, _: orbit_files.read_back(folder / "calibrate.yaml")),
    "angle": (campaign_files, angle_used),
    "block": (block_files, lambda folder, _: run_adjustment(MeasuredAdjustSetup.read(folder / "adjust.yaml"), None, 0)),
    "platform": (
        platform_files,
        lambda folder, spec: platform_table(
            *read_platform(PlatformFilesSpec.model_validate(spec), folder), bench.EPOCH
        ),
    ),
    "earth": (lambda _: None, lambda folder, _: read_earth_orientation(folder / "eop.txt")),
    "ground": (map_files, lambda folder, spec: read_ground_points(GroundFileSpec.model_validate(spec), folder)),
    "map": (map_files, map_used),
    "scene": (scene_files, lambda folder, spec: read_scene(folder / spec.get("file", "DIM_SCENE.XML"))),
    "rpc": (rpc_files, lambda folder, spec: read_rpc(folder / spec["file"])),
    "check": (partial(bench.check_files, count=8), partial(used, OrbitCheckSpec, CheckSetup, run_check)),
    "match": (match_files, partial(used, OrbitMatchSpec, MatchSetup, run_match)),
}
"""What writes the good files of a kind into a folder and returns their specification, and what reads them."""
FILES = [
    pytest.param(part, row, marks=[pytest.mark.second] if part.get("second") else [], id=f"{name}-{k}")
    for name, part in REFUSALS["files"].items()
    for k, row in enumerate(part["cases"])
]


def edited(text: str, edit: Any) -> str:
    """Return a text after one edit of the table; rows count from 1 as messages do."""
    rows = text.split("\n")
    match edit:
        case [int(row), int(cell), new]:
            cells = rows[row - 1].split(",")
            rows[row - 1] = ",".join([*cells[:cell], new, *cells[cell + 1 :]])
        case {"text": new}:
            return str(new)
        case {"kept": numbers}:
            rows = [rows[0], *(rows[k - 1] for k in numbers), ""]
        case {"first": count}:
            rows = [*rows[:count], ""]
        case {"without": row}:
            del rows[row - 1]
        case {"again": row}:
            rows.insert(row, rows[row - 1])
        case {"column": [head, value]}:
            rows = [f"{row}{f',{value}' if k else f', {head}'}" for k, row in enumerate(rows) if row]
        case {"sub": [old, new]}:
            return re.sub(old, new, text, flags=re.M)
        case [old, new]:
            return text.replace(old, new)
    return "\n".join(rows)


def merged(spec: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Return a specification with other values; None takes a key away."""
    found = spec | {k: merged(spec.get(k, {}), v) if isinstance(v, dict) else v for k, v in change.items()}
    return {k: v for k, v in found.items() if v is not None}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, dict[str, Any]]]:
    @cache
    def made(reader: str) -> tuple[Path, dict[str, Any]]:
        folder = tmp_path_factory.mktemp(reader)
        return folder, READERS[reader][0](folder) or {}

    return made


def test_the_command_ends_with_2_and_writes_nothing(good, tmp_path: Path) -> None:
    shutil.copytree(good("campaign")[0], tmp_path, dirs_exist_ok=True)
    (tmp_path / "Beijing/ground.csv").write_text("point\n")
    out, data = tmp_path / "run", tmp_path / "again"
    result = invoke(command.app, "calibrate", tmp_path / "calibrate.yaml", "--out", out, "--export", data)
    assert (result.exit_code, out.exists(), data.exists()) == (2, False, False)
    assert "ground.csv:1" in result.stderr


def test_a_scene_of_which_a_part_looks_past_the_earth_is_not_exported(tmp_path: Path) -> None:
    """The look turns by ten degrees over the image, whose middle sees the ground near the limb."""
    scene = dimap_bench.write(tmp_path, dimap_bench.Scene(pitch=1.0, rate=(0.2, 0.0)))
    result = invoke(command.app, "export", scene, "--out", tmp_path / "run")
    assert (result.exit_code, (tmp_path / "run").exists()) == (2, False)
    told = " ".join(result.stderr.split())
    assert "a line of sight misses the Earth; allowed: an orbit over ground that every line sees" in told


@pytest.mark.parametrize(("part", "row"), FILES)
def test_a_file_is_refused_by_words(part: dict[str, Any], row: list[Any], good, tmp_path: Path) -> None:
    folder, spec = good(part["reader"])
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    spec = merged(spec, part.get("spec", {}))
    for name, text in part.get("files", {}).items():
        (tmp_path / name).write_text(text)
    words, *items = row
    file = tmp_path
    for item in items:
        if isinstance(item, str):
            file = tmp_path / item
        elif "said" in item:
            spec = merged(spec, item["said"])
        else:
            before = file.read_bytes().decode("latin-1") if file.exists() else None
            after = edited(before or "", item)
            assert after != before
            file.write_bytes(after.replace("␀", "\0").encode("latin-1"))
    with pytest.raises((InputError, BenchError, UnphysicalError)) as caught:
        READERS[part["reader"]][1](tmp_path, spec)
    for word in [words] if isinstance(words, str) else words:
        assert word in str(caught.value)


# --- functions ----------------------------------------------------------------------------------------------


def calibrated() -> CalibratedLine:
    camera = lost().camera
    return CalibratedLine(camera.pixels, camera.directions, camera.origins, np.eye(3), 0.65)


GONE: Any = Ns(submit=lambda *_: Ns(status="lost"), next_finished=lambda look: look())
FILE = Path("scene.ntf")
TRACED = SimulatedAngleRun.__new__(SimulatedAngleRun)
object.__setattr__(TRACED, "setup", AngleSetup.read(SCENES / ORBIT / "angle_gf7.yaml"))
MEASURED: Any = Ns(setup=MeasuredAngleSetup.read(SCENES / ORBIT / "measured/angle.yaml"))
PLACES = np.column_stack([np.zeros((2, 3)), [-179.9, 179.9], np.zeros(2)])
SPOT = Ns(reading=np.ones((1, 1)), lines=np.full((1, 1), 3), file=Ns(file="spots.csv"), head="reading [deg]")
UNMADE: Any = Ns(setup=None, test=None, camera=None, instrument=None, images={"nadir": 1}, kind="other", name="th1")
MODEL = LineModel(np.eye(3), np.ones(3), np.zeros(3))
NOWHERE: Any = Ns(offset=np.zeros(5), scale=np.ones(5), ground=lambda line, *_: np.full((2, len(line)), np.nan))
TIES = GroundPoints.of(["a"], np.full((1, 3), np.nan), np.zeros((3, 3)), "tie")
OFF = Ns(sensor=lost(), image=np.ones((1, 2)), point=np.zeros(1, int))
STEEP: Any = Ns(
    images={"nadir": Ns(image_point=lambda *at: at, sensor=Ns(ground=lambda line, pixel, height: height))},
    terrain=Ns(limits=(0.0, 2.0), height=lambda east, north: 1.5 * east),
    frame=Ns(local=lambda height: (height, height, height)),
)
"""Ground that rises by 1.5 m where the look, followed up by 1 m, leads."""
CASES: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: measure_points(UNMADE, Ns(tie=1)), PointsError, "tie points need two lines"),
    (
        lambda: optics_of(Ns(name="th1", image_of={}.get), ["nadir"], 1e-3, {}),
        ValueError,
        "no image section for its line nadir",
    ),
    (lambda: angle_exported(TRACED), InputError, "camera: the lines of an instrument are traced"),
    (lambda: angle_exported(MEASURED), InputError, "data: measurements are files already"),
    (lambda: command._ground("1 m", None), InputErrorText, "give both"),
    (lambda: command._ground("1 s", "2 m"), InputErrorText, "--lowest, --highest: .*'0 m' and '2000 m'"),
    (lambda: command._ground("5 m", "1 m"), InputErrorText, "--lowest must be below --highest"),
    (lambda: run_export(UNMADE, UNMADE, None, changes={}), ValueError, "only the cameras of an instrument"),
    (lambda: PointWorkers(GONE, 1).results(abs, [(1,)]), ClusterError, "a worker was lost"),
    (lambda: ground_rows(lost(), calibrated(), np.zeros(4), 0.0), ValueError, "a line of sight misses the Earth"),
    (
        lambda: light_shift(lost(), LineModel(np.eye(3), np.ones(3), np.zeros(3)), *np.ones((3, 1))),
        UnphysicalError,
        "a line of sight misses",
    ),
    (
        lambda: corrected_polynomial(NOWHERE, Ns(at=lambda line, sample: np.zeros((len(line), 2)))),
        ValueError,
        "cannot be inverted to the",
    ),
    (lambda: Patch.true_point(STEEP, "nadir", np.ones(1), np.ones(1)), PatchError, "as steep as the look"),
    (
        lambda: sights._prior_of(Ns(ground=TIES), {"blue": OFF}, np.arange(1), Ns(height=0.0)),
        SightsError,
        "lines of sight miss",
    ),
    (lambda: angle_camera(UNMADE, None), ValueError, "an instrument's lines need a backend"),
    (lambda: fit_rpc(PLACES[:, :2], PLACES[:, 2:]), ValueError, "the 180th meridian or a pole"),
    (lambda: sights_of(UNMADE, {}, ("blue",), None, None), SightsError, "no image points of blue"),
    (
        lambda: MonitorSeries.smoothed(Ns(experiment=Ns(disturbances=None)), Ns(noise=1), 1.0),
        ValueError,
        "needs stated",
    ),
    (lambda: _check_angles(None, SPOT, 0.0), InputError, "spots.csv:3: reading.*an angle beyond any field"),
    (lambda: read_exportable(FILE, 1, None), InputError, "a NITF file, which is not read"),
    (
        lambda: read_exportable(FILE.with_suffix(".yaml"), 1, "B0"),
        InputError,
        "only the scene of a DIMAP file has bands",
    ),
    (lambda: read_polynomial_source(Path("a_RPC.TXT"), "B0"), InputError, "only the scene of a DIMAP file has bands"),
]


@pytest.mark.parametrize("case", CASES, ids=[words for _, _, words in CASES])
def test_what_is_refused(case: tuple[Any, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    FILE.write_text("NITF")
    (tmp_path / "a_RPC.TXT").write_text("LINE_OFF: 1")
    call, error, words = case
    with pytest.raises(error, match=words):
        call()


# --- workers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("warnings", [[], ["another version of NumPy"]])
def test_what_is_to_be_known_of_a_cluster_is_told(warnings: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.framework.cluster.remote_workers", lambda *_: nullcontext(Ns(warnings=warnings, count=1)))
    told: list[str] = []
    with block_run.point_workers(None, "tcp://localhost:1", told.append):
        assert told == warnings


# --- errors of a part ---------------------------------------------------------------------------------------


def fails(error: Exception) -> Callable[..., Any]:
    def part(*_: object, **__: object) -> None:
        raise error

    return part


MONITOR: Any = Ns(analysis=Ns(centroid=None), errors=Ns(switched_on=False), frames=1, mechanisms=None, times=[60.0])
MONITOR.times_key = ("mechanisms", "readings")
EXPERIMENT: Any = Ns(expected_frames=abs, nominal_photons=1, calibration=Ns(spots=2), instrument=None)
SERIES: Any = Ns(experiment=EXPERIMENT, spec=MONITOR)
EXPERIMENT.path = Ns(channels=[Ns(key="left"), Ns(key="right")])
STRIP: Any = JitterSetup.__new__(JitterSetup)
object.__setattr__(STRIP, "test", Ns(effects=EffectsSpec(), lines=("blue", "red"), search=None))
object.__setattr__(STRIP, "camera", load_three_line_camera("ms4"))


def spots_lost() -> None:
    with MonitorSeries._reporting_spot_errors(SERIES, [0]):
        raise SpotError({1: "too faint"})


PARTS: dict[str, tuple[Any, dict[str, Any], Callable[[], object], tuple[str, ...], str, str]] = {
    "monitor": (
        monitoring_run,
        {"simulate_monitoring": fails(IntersectionError("looks are parallel"))},
        lambda: monitoring_run.run_monitor(Ns(test=MONITOR), UNMADE, 1),
        ("cameras",),
        "looks are parallel",
        "cameras with different look angles",
    ),
    "spots of a loop": (
        closed_loop,
        {"observe": fails(SpotError({0: "too faint"})), "judged_spots": lambda *_: None},
        lambda: closed_loop.reader(Ns(experiment=EXPERIMENT), MONITOR, 1)({}, 0),
        MONITOR.times_key,
        "the spots cannot be read at 1 min: spot 0: too faint",
        "a smaller range of the mechanisms",
    ),
    "spots of a course": (
        closed_loop,
        {},
        spots_lost,
        ("course",),
        "the spot right cannot be measured at 1 min (too faint)",
        "the spots on their CCDs",
    ),
    "jitter": (
        jitter_run,
        {"fly_strip": lambda *_: (Ns(name="strip", line_times={}), None), "sights_of": fails(SightsError("blind"))},
        lambda: jitter_run.run_jitter(STRIP, None, 1),
        ("points",),
        "strip: blind",
        jitter_run._REMEDY,
    ),
}


@pytest.mark.parametrize("name", PARTS)
def test_an_error_of_a_part_is_told_with_its_key_and_remedy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, parts, call, key, words, remedy = PARTS[name]
    for part, made in parts.items():
        monkeypatch.setattr(module, part, made)
    with pytest.raises(BenchError) as caught:
        call()
    assert (str(caught.value), caught.value.key) == (words, key)
    assert remedy in caught.value.remedy


@pytest.mark.second
def test_images_that_matching_cannot_use_are_told(good, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, spec = good("match")
    monkeypatch.setattr(match_run, "measure_points", fails(ValueError("no spline")))
    with pytest.raises(BenchError, match=r"^the images cannot be matched: no spline$") as caught:
        READERS["match"][1](folder, spec)
    assert (caught.value.key, caught.value.remedy) == (("images",), "images of the map's ground")


# --- the ten-line examples of docs/orbit_files.md, which can be read --------------------------------------------------


PAGE = Path(__file__).resolve().parents[2] / "docs/orbit_files.md"
BLOCKS = re.findall(r"^```csv\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
assert len(BLOCKS) == 8  # and all are read here
GPS = {"frame": "ITRS", "time_scale": "GPS"}
TURN = {"scalar": "last", "direction": "body_to_frame", "body_axes": ["forward", "right", "down"]}
ANGLES = {"sequence": "xyz", "nadir": "geodetic", "steering": "yaw", "body_axes": ["forward", "right", "down"]}


def block(start: str) -> str:
    (found,) = [text for text in BLOCKS if text.startswith(start)]
    return found


@pytest.mark.parametrize("orbit", ["CCSDS_OEM", "date_time,x"])
@pytest.mark.parametrize("attitude", ["date_time,q1", "date_time,roll"])
def test_orbits_and_attitudes(tmp_path: Path, orbit: str, attitude: str) -> None:
    """The same pass at 500 km in an inertial and in the Earth-fixed frame; the attitude has a second of it."""
    (tmp_path / "orbit").write_text(block(orbit))
    (tmp_path / "attitude").write_text(block(attitude))
    flown = {"file": "orbit"} if orbit == "CCSDS_OEM" else {"file": "orbit", **GPS, "offset": "15 s"}
    turned = {"file": "attitude", "time_scale": "UTC", **(TURN if "q1" in attitude else ANGLES)}
    turned["frame"] = "ITRS" if "q1" in attitude else "orbital"
    earth = {"ut1_utc": "-0.1523 s"}
    spec = PlatformFilesSpec.model_validate({"orbit": flown, "attitude": turned, "earth": earth})
    table = platform_table(*read_platform(spec, tmp_path))
    height = Earth().geodetic(table.position)[2]
    assert np.all(np.abs(height - 505e3) < 5e3)
    assert np.all(np.abs(np.linalg.norm(table.velocity, axis=1) - 7650.0) < 200.0)
    np.testing.assert_allclose(np.diff(table.orbit_time), 1.0, rtol=0, atol=1e-9)


def test_earth_orientation(tmp_path: Path) -> None:
    (tmp_path / "eop.csv").write_text(block("mjd"))
    assert len(read_earth_orientation(tmp_path / "eop.csv").mjd) == 4


def test_ground_points(tmp_path: Path) -> None:
    for name, start in (("g.csv", "point,lat"), ("g.gcp", "1 40"), ("g.geojson", '{"type"')):
        (tmp_path / name).write_text(block(start))
        crs = {} if name == "g.geojson" else {"crs": "EPSG:4979"}
        found = read_ground_points(GroundFileSpec.model_validate({"file": name, **crs}), tmp_path)
        lon, lat, height = Earth().geodetic(found.points.itrs[0])
        np.testing.assert_allclose(np.degrees([lon, lat]), [116.0123456, 40.0123456], rtol=0, atol=1e-10)
        assert float(height) == pytest.approx(512.34, abs=1e-6)
