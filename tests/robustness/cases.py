"""What is fuzzed: every command that reads YAML, with every file of the library that it can read as one's own.

A case is a folder of files of which one is changed, and the command that reads it. Commands run as they are up to where
they have read, checked, resolved and built everything; there the long computation is replaced by `Reached`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from unittest.mock import patch

import typer
from rich.console import Console

from scenes.specs.load import SCENES, load_autocollimator_test, load_error_budget
from twin.design.__main__ import app as design
from twin.lab import app as lab
from twin.orbit.__main__ import app as orbit
from twin.recover.__main__ import app as recover
from twin.render import app as render
from twin.run.cli import explained
from twin.study.__main__ import app as study

CUTS = (
    "twin.monitor.truth.LineSight.truth",
    "twin.laboratory.focus_alignment.align",
    "twin.laboratory.distortion_bench.DistortionBench.record",
    "twin.laboratory.turntable_run.choose",
    "twin.orbit.angle.angle_run.estimated",
    "twin.orbit.angle.measured_angle.estimated",
    "twin.orbit.calibration.flown_campaign._simulated_points",
    "twin.orbit.calibration.calibration_run.campaign_of",
    "twin.orbit.calibration.field_images.Imager.measured",
    "twin.orbit.monitoring.monitoring_flight._changes",
    "twin.orbit.images.simulate_run.fly_patch",
    "twin.study.study_command.local_workers",
    "twin.study.gradient.study_gradient._Traced",
    "twin.study.gradient.study_gradient._whole",
    "twin.design.design_run.optimise",
    "twin.recover.recover_run._modelled",
    "twin.recover.recover_run._measured",
)
"""Functions that begin the long computations."""
SOONER = (
    "scenes.models.thermal_model.ThermalModel._solid_response",
    "optics.waves.transfer._correlate",
)
"""Parts of building that take seconds, finite elements and transfer functions: most mutants stop before them."""


class Reached(BaseException):
    """A command has read and built everything and would now compute."""


def _reach(*_: object, **__: object) -> None:
    raise Reached


@contextmanager
def cut(soon: bool) -> Iterator[None]:
    """Let no command compute, and not even build what takes seconds if ``soon``."""
    with ExitStack() as stack:
        for name in (*CUTS, *SOONER) if soon else CUTS:
            stack.enter_context(patch(name, _reach))
        yield


bench = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
"""Two sorts of files have no command of their own; the validation reads them from the library."""


@bench.command()
def principle(file: Path, out: Annotated[Path | None, typer.Option()] = None) -> None:
    with explained(Console(stderr=True)):
        load_autocollimator_test(file)
    raise Reached


@bench.command()
def budget(file: Path, out: Annotated[Path | None, typer.Option()] = None) -> None:
    with explained(Console(stderr=True)):
        load_error_budget(file)
    raise Reached


@dataclass(frozen=True)
class Case:
    """A command and its files.

    Attributes:
        name: of the case.
        app: of the command.
        words: before the file, such as the subcommand.
        files: name in the case's folder -> text; the first is given to the command.
        target: the file that is changed.
        options: after the file.
        weight: share of the mutants; slow commands get fewer.
    """

    name: str
    app: typer.Typer
    words: tuple[str, ...]
    files: Mapping[str, str]
    target: str
    options: tuple[str, ...] = ()
    weight: float = 1.0


def _text(name: str) -> str:
    return (SCENES / name).read_text("utf-8")


def _with(text: str, *changes: tuple[str, str]) -> str:
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text


def _of_one(name: str, app: typer.Typer, words: str, file: str, **more: object) -> Case:
    """A case with one file of the library, unchanged."""
    own = Path(file).name
    return Case(name, app, tuple(words.split()), {own: _text(file)}, own, **more)  # type: ignore[arg-type]


def _config(name: str, app: typer.Typer, words: str, resolve: Callable, file: str, **more: object) -> Case:
    """A case with the config.yaml of a run."""
    text = resolve(SCENES / file).to_yaml()
    return Case(name, app, tuple(words.split()), {"config.yaml": text}, "config.yaml", **more)  # type: ignore[arg-type]


def cases() -> dict[str, Case]:
    """All cases by name."""
    measured = (*_measured(), *_frames())
    return {case.name: case for case in (*_renders(), *_labs(), *_orbits(), *measured, *_studies(), *_rest())}


def _renders() -> Iterator[Case]:
    from scenes.specs.resolved import resolve

    quick = ("--frames", "1")
    for stem in ("perturb", "aligned", "steady", "image_quality", "targets"):
        yield _of_one(f"render-{stem}", render, "", f"examples/{stem}.yaml", options=quick)
    for stem, weight in (("orbit", 0.5), ("launch", 0.3), ("heat_soak", 0.2)):
        yield _of_one(f"render-{stem}", render, "", f"examples/{stem}.yaml", options=quick, weight=weight)
    stray = _with(_text("examples/aligned.yaml"), ("frames: 9", "stray: {paths: 10000}, frames: 9"))
    yield Case("render-stray", render, (), {"stray.yaml": stray}, "stray.yaml", quick)
    own = {
        "job.yaml": _with(_text("examples/targets.yaml"), ("instrument: gf7_pair", "instrument: ./pair.yaml")),
        "pair.yaml": _with(
            _text("library/instruments/gf7_pair.yaml"),
            ("{camera: gf7, look: 26", "{camera: ./gf7.yaml, look: 26"),
            ("{camera: gf7, look: -5", "{camera: short.yaml, look: -5"),
            ("monitor_ccd", "sub/ccd.yaml"),
        ),
        "gf7.yaml": _with(_text("library/cameras/gf7.yaml"), ("detector: gf7_pan", "detector: ./pan.yaml")),
        "short.yaml": _text("library/cameras/gf7_short.yaml"),
        "sub/ccd.yaml": _text("library/detectors/monitor_ccd.yaml"),
        "pan.yaml": _text("library/detectors/gf7_pan.yaml"),
    }
    for target in own:
        stem = Path(target).stem
        yield Case(f"render-own-{stem}", render, (), own, target, quick)
    changes = """disturbances:
  file: ./own.yaml
  without: [CAUSE]
  causes:
    added: {bodies: base/*/M?, shift: [1 um, 0 um, 2 um], figure: {Z5: 2 nm}, together: 0.2, time: {drift: 6 h},
      correlations: [{between: [base/forward/M1 shift x, base/forward/M1 shift z], correlation: -0.5}], reason: added}
"""
    for stem in ("orbit", "launch", "paper_001"):
        text = _text(f"library/disturbances/{stem}.yaml")
        cause = text.partition("causes:")[2].split(":")[0].strip().splitlines()[-1].strip()
        job = _text("examples/aligned.yaml") + changes.replace("CAUSE", cause)
        own = {"job.yaml": job, "own.yaml": text}
        yield Case(f"render-disturbances-{stem}", render, (), own, "own.yaml", quick)
    yield Case("render-disturbances-job", render, (), own, "job.yaml", quick)
    yield _config("render-config", render, "", resolve, "examples/targets.yaml", options=quick, weight=0.5)


def _labs() -> Iterator[Case]:
    from scenes.specs.lab_setup import resolve_distortion, resolve_focus, resolve_turntable

    resolvers = {"focus": resolve_focus, "distortion": resolve_distortion, "turntable": resolve_turntable}
    for stem, resolve in resolvers.items():
        yield _of_one(f"lab-{stem}", lab, stem, f"lab/{stem}.yaml")
        yield _config(f"lab-{stem}-config", lab, stem, resolve, f"lab/{stem}.yaml", weight=0.5)
    own = {
        "test.yaml": _with(
            _text("lab/distortion.yaml"),
            ("camera: gf7", "camera: ./gf7.yaml"),
            ("turntable: turntable", "turntable: ./table.yaml"),
        ),
        "table.yaml": _text("lab/turntable.yaml"),
        "gf7.yaml": _text("library/cameras/gf7.yaml"),
    }
    for target in ("table.yaml", "gf7.yaml"):
        yield Case(f"lab-distortion-own-{Path(target).stem}", lab, ("distortion",), own, target)


def _orbits() -> Iterator[Case]:
    from scenes.specs.orbit.setup import resolve_angle, resolve_calibration, resolve_monitor, resolve_simulate

    for stem in ("angle", "angle_gf7", "angle_off_axis"):
        yield _of_one(f"orbit-{stem}", orbit, "angle", f"orbit/{stem}.yaml")
    for stem in ("calibrate", "calibrate_images", "calibrate_monitor", "calibrate_strip"):
        yield _of_one(f"orbit-{stem}", orbit, "calibrate", f"orbit/{stem}.yaml")
    yield _of_one("orbit-monitor", orbit, "monitor", "orbit/monitor.yaml", weight=0.5)
    yield _of_one("orbit-simulate", orbit, "simulate", "orbit/simulate.yaml")
    configs = {
        "angle": resolve_angle,
        "calibrate": resolve_calibration,
        "monitor": resolve_monitor,
        "simulate": resolve_simulate,
    }
    for stem, resolve in configs.items():
        yield _config(f"orbit-{stem}-config", orbit, stem, resolve, f"orbit/{stem}.yaml", weight=0.5)
    payload = _with(_text("library/payloads/th1.yaml"), ("detector: th1_line", "detector: ./line.yaml"))
    own = {"th1.yaml": payload, "line.yaml": _text("library/detectors/th1_line.yaml")}
    for command in ("angle", "simulate"):
        test = {"test.yaml": _with(_text(f"orbit/{command}.yaml"), ("camera: th1", "camera: ./th1.yaml"))}
        for target in own if command == "simulate" else ("th1.yaml",):
            yield Case(f"orbit-{command}-own-{Path(target).stem}", orbit, (command,), {**test, **own}, target)


def _measured() -> Iterator[Case]:
    """Tests on measurements, their tables and what says how to read these; one pass."""
    folder = "orbit/measured"
    data = _text(f"{folder}/data.yaml")
    data = data[: data.index("  Anhui:")].replace("Beijing/", "")
    tables = {f"{k}.csv": _text(f"{folder}/Beijing/{k}.csv") for k in ("orbit", "attitude", "lines", "ground")}
    tables["image_points.csv"] = _text(f"{folder}/Beijing/image_points.csv")
    calibrate = _with(_text(f"{folder}/calibrate.yaml"), ("  - [Beijing, Anhui]\n", ""))
    for command, text in (("calibrate", calibrate), ("angle", _text(f"{folder}/angle.yaml"))):
        own = {"test.yaml": text, "data.yaml": data, **tables}
        for target in own if command == "calibrate" else ("test.yaml",):
            yield Case(f"measured-{command}-{Path(target).stem}", orbit, (command,), own, target, weight=0.5)


def _fits(frames: int, light: int) -> str:
    """A FITS file of small frames that is text, as the files of a case are: all its bytes are below 128."""
    cards = {"SIMPLE": "T", "BITPIX": 16, "NAXIS": 3, "NAXIS1": 32, "NAXIS2": 32, "NAXIS3": frames}
    lines = [f"{key:8s}= {value:>20}".ljust(80) for key, value in cards.items()]
    head = "".join([*lines, "END".ljust(80)]).ljust(2880)
    pixels = [(light if 12 < row < 20 and 12 < column < 20 else 0, 100) for row in range(32) for column in range(32)]
    data = "".join(chr(high) + chr(low) for high, low in pixels) * frames
    return head + data.ljust(-(-len(data) // 2880) * 2880, "\0")


def _frames() -> Iterator[Case]:
    """Measured frames of a monitor, and their files."""
    folder = {
        f"images/{camera}_{side}_{when}.fits": _fits(1, 8)
        for camera in ("forward", "backward")
        for side in ("left", "right")
        for when in ("before", "after")
    }
    text = _with(_text("examples/measured_frames.yaml"), ("../../runs/first/images", "./images"))
    yield Case("frames-model", recover, (), {"frames.yaml": text, **folder}, "frames.yaml")
    geometry = """template: measured
detector: ./ccd.yaml
exposure: 10 ms
geometry:
  one: {focal_length: 5.5 m, separation: 235 mm, pixel: 12 um, look: 26 deg, field: 1.2 deg, focal_length_across: 5.6 m}
bad_pixels: {one/left: bad.fits, one/right: [bad.fits]}
dark: dark.fits
flat: {all: [flat.fits]}
photon_transfer: measured
corrections: automatic
vibration: fitted
analysis: {centroid: ml}
"""
    listed = """times: [0 min, 0.5 h]
frames:
  one/left: {before: [a.fits, b.fits], after: [a.fits, [a.fits, b.fits]], offset: [4, 2], offset_after: [0, 0]}
  one/right: {before: b.fits, after: [b.fits, b.fits]}
"""
    # dark and flat frames need noise: two grey values in turns
    noisy = {"dark.fits": _fits(2, 0), "flat.fits": _fits(2, 0)}
    for name, values in (("dark.fits", "de"), ("flat.fits", "AZ")):
        head, data = noisy[name][:2880], list(noisy[name][2880:])
        for k in range(2 * 32 * 32):
            data[2 * k + (name == "dark.fits")] = values[(k * k // 7 + k // 1024) % 2]
        noisy[name] = head + "".join(data)
    files = {"a.fits": _fits(3, 8), "b.fits": _fits(1, 9), "bad.fits": _fits(1, 0).replace("d", "\0"), **noisy}
    own = {"frames.yaml": geometry + listed, "ccd.yaml": _text("library/detectors/monitor_ccd.yaml"), **files}
    for target in ("frames.yaml", "ccd.yaml", "a.fits", "flat.fits"):
        yield Case(f"frames-{Path(target).stem}", recover, (), own, target)
    table = "channel,time [min],file,row,column\n" + "".join(
        f"one/{side},{when},{name}.fits,4,2\n"
        for side in ("left", "right")
        for when, name in (("before", "a"), ("before", "b"), ("0", "a"), ("30.5", "b"), ("30.5", "a"))
    )
    own = {"frames.yaml": geometry + "frames: frames.csv\n", **{k: v for k, v in own.items() if k != "frames.yaml"}}
    yield Case("frames-table", recover, (), {**own, "frames.csv": table}, "frames.csv")


def _studies() -> Iterator[Case]:
    from twin.study.runs.setup import resolve_study

    workers = ("--workers", "1")
    for stem in ("smoke", "alignment", "aperture", "interval", "prism_heat"):
        yield _of_one(f"study-{stem}", study, "", f"examples/study_{stem}.yaml", options=workers, weight=0.7)
    smoke = "examples/study_smoke.yaml"
    yield _config("study-config", study, "", resolve_study, smoke, options=workers, weight=0.5)
    yield _of_one("study-gradient", study, "", smoke, options=("--gradient",), weight=0.7)
    text = _with(
        _text(smoke),
        ("file: perturb}", "file: ./base.yaml}"),
        ("uniform: [-10 arcsec, 10 arcsec]", "table: {file: values.csv, column: turn}"),
        ("normal: {mean: 0 um, sigma: 2 um}", "table: {file: values.csv, column: despace}"),
        ("  warmth:", "  # warmth:"),
        ("kind: latin_hypercube, runs: 100, seed: 1", "kind: grid"),
    )
    table = io.StringIO()
    table.write("turn,despace\n")
    for k in range(12):
        table.write(f"{k - 5} arcsec,{0.5 * k} um\n")
    own = {"study.yaml": text, "base.yaml": _text("examples/perturb.yaml"), "values.csv": table.getvalue()}
    for target in own:
        yield Case(f"study-own-{Path(target).stem}", study, (), own, target, workers, 0.7)


def _rest() -> Iterator[Case]:
    file = "examples/design_gf7_short.yaml"
    yield _of_one("design", design, "", file)
    own = {
        "design.yaml": _with(_text(file), ("camera: gf7\n", "camera: ./gf7.yaml\n")),
        "gf7.yaml": _text("library/cameras/gf7.yaml"),
    }
    yield Case("design-own-camera", design, (), own, "gf7.yaml")
    yield _of_one("principle", bench, "principle", "lab/principle_experiment.yaml")
    yield _of_one("budget", bench, "budget", "library/budgets/monitor_pair.yaml")


__all__ = ["Case", "Reached", "cases", "cut"]
