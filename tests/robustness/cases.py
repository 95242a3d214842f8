"""What is fuzzed: every command that reads YAML, with every file of the library and of the golden runs' small jobs
that it can read as one's own. Tables, images and files of other programs are in `file_cases`, run folders in
`run_cases`.

Commands run as they are up to where they have read, checked, resolved and built everything; there most of them end, by
`Reached`, and some go on to their reports.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from optics.numerics.frozen_map import FrozenMap
from scenes.models.monitor_layout import Beam
from scenes.specs.load import SCENES, load_autocollimator_test, load_error_budget
from tests.robustness.case import JOBS, Case, Reached, edited, job_of, text_of
from twin.camera.__main__ import app as camera
from twin.design.__main__ import app as design
from twin.design.layout_refinement import LayoutNumber, Slope
from twin.design.search_workers import Journal
from twin.lab import app as lab
from twin.live.__main__ import app as live
from twin.orbit.__main__ import app as orbit
from twin.render import app as render
from twin.run.cli import explained
from twin.study.__main__ import app as study
from twin.uncertainty.__main__ import app as uncertainty

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


@bench.command()
def journal(file: Path, out: Annotated[Path | None, typer.Option()] = None) -> None:
    """What a search for a layout that was broken off has kept."""
    with explained(Console(stderr=True)), Journal(file, "fuzzed"):
        raise Reached


def cases(bases: Path | None = None) -> dict[str, Case]:
    """All cases by name.

    Args:
        bases: folder with the run folders that commands read, which are made there if they are not; None leaves out
            their cases.
    """
    from tests.robustness.file_cases import file_cases
    from tests.robustness.run_cases import run_cases

    runs = run_cases(bases) if bases is not None else ()
    every = (*_listed(), *_renders(), *_labs(), *_orbits(), *_studies(), *_designs(), *file_cases(), *runs)
    return {case.name: case for case in every}


APPS = {
    **{"render": render, "camera": camera, "lab": lab, "orbit": orbit, "study": study, "design": design, "live": live},
    **{"uncertainty": uncertainty, "bench": bench},
}


def _listed() -> Iterator[Case]:
    """Cases of one file, which cases.txt lists."""
    for line in Path(__file__).with_name("cases.txt").read_text("utf-8").splitlines():
        if line.startswith("#"):
            continue
        name, kind, command, named, *rest = (part.strip() for part in line.split("|"))
        numbers, options = (*rest, "", "")[:2]
        files = {Path(one).name: (text_of if "/" in one else job_of)(one) for one in named.split()}
        app, *words = command.split()
        more: dict[str, Any] = {"options": tuple(options.split())}
        for number in numbers.split():
            key, _, value = number.partition("=")
            more[key] = {"out": str, "weight": float}.get(key, int)(value)
        yield Case(name, kind, APPS[app], tuple(words), files, next(iter(files)), **more)


def _config(name: str, app: typer.Typer, words: str, resolve: Callable, file: str, **more: Any) -> Case:
    """A case with the config.yaml of a run."""
    text = resolve((SCENES if "/" in file else JOBS) / file).to_yaml().encode()
    return Case(name, f"config of {name}", app, tuple(words.split()), {"config.yaml": text}, "config.yaml", **more)


def _own(kinds: Mapping[str, str], prefix: str, app: typer.Typer, words: str, files: Mapping[str, bytes], **more: Any):
    """Cases with the same files, of which one after the other is spoilt: target -> its kind."""
    for target, kind in kinds.items():
        yield Case(f"{prefix}-{Path(target).stem}", kind, app, tuple(words.split()), files, target, **more)


def _renders() -> Iterator[Case]:
    from scenes.specs.resolved import resolve

    quick: dict[str, Any] = {"options": ("--frames", "1")}
    own = {
        "job.yaml": edited(text_of("examples/targets.yaml"), ("instrument: gf7_pair", "instrument: ./pair.yaml")),
        "pair.yaml": edited(
            text_of("library/instruments/gf7_pair.yaml"),
            ("{camera: gf7, look: 26", "{camera: ./gf7.yaml, look: 26"),
            ("{camera: gf7, look: -5", "{camera: short.yaml, look: -5"),
            ("monitor_ccd", "sub/ccd.yaml"),
        ),
        "gf7.yaml": edited(text_of("library/cameras/gf7.yaml"), ("detector: gf7_pan", "detector: ./pan.yaml")),
        "short.yaml": text_of("library/cameras/gf7_short.yaml"),
        "sub/ccd.yaml": text_of("library/detectors/monitor_ccd.yaml"),
        "pan.yaml": text_of("library/detectors/gf7_pan.yaml"),
    }
    kinds = {
        **{"pair.yaml": "instrument", "gf7.yaml": "camera", "short.yaml": "camera"},
        **{"sub/ccd.yaml": "detector", "pan.yaml": "detector"},
    }
    yield from _own(kinds, "render-own", render, "", {**own, "job.yaml": SPOTS}, **quick, whole=40)
    changes = b"""disturbances:
  file: ./own.yaml
  without: [CAUSE]
  causes:
    added: {bodies: base/*/M?, shift: [1 um, 0 um, 2 um], figure: {Z5: 2 nm}, together: 0.2, time: {drift: 6 h},
      correlations: [{between: [base/forward/M1 shift x, base/forward/M1 shift z], correlation: -0.5}], reason: added}
"""
    text = text_of("library/disturbances/orbit.yaml")
    cause = text.partition(b"causes:")[2].split(b":")[0].strip().splitlines()[-1].strip()
    own = {"job.yaml": text_of("examples/aligned.yaml") + changes.replace(b"CAUSE", cause), "own.yaml": text}
    yield Case("render-disturbances", "disturbances", render, (), own, "own.yaml", **quick, whole=50)
    yield Case("render-disturbances-job", "job with disturbances", render, (), own, "job.yaml", **quick)
    own = {"job.yaml": AS_BUILT, "own.yaml": text_of("examples/as_built_pair.yaml")}
    yield Case("render-as-built", "instrument as built", render, (), own, "own.yaml", **quick, whole=40)
    own = {
        "job.yaml": text_of("examples/aligned.yaml") + b"disturbances: ./own.yaml\n",
        "own.yaml": JOINT,
        "own.csv": TABLE,
    }
    yield Case("render-joint", "disturbances", render, (), own, "own.yaml", **quick, whole=50)
    yield Case("render-joint-table", "table of correlations", render, (), own, "own.csv", **quick, whole=50)
    yield _config("render", render, "", resolve, "examples/targets.yaml", **quick, weight=0.5)


AS_BUILT = b"instrument: ./own.yaml\nperturb:\n  forward/M2: {shift: 0 0 1 um}\nrender: {frames: 1, seed: 1}\n"
JOINT = b"""name: own
joint:
  components:
    base/forward/M2 shift z: 3.1 um
    forward/M2 rotate x about origin: 0.4 arcsec
    base/forward/M1 conic: 2.0e-5
  correlation_file: own.csv
  time: constant
  reason: an estimate
"""
TABLE = b"""base/forward/M2 shift z,forward/M2 rotate x about origin,base/forward/M1 conic
1.0,0.8,0.0
0.8,1.0,-0.3
0.0,-0.3,1.0
"""
SPOTS = (
    b"instrument: ./pair.yaml\nperturb:\n  base/forward/M2: {shift: [0 um, 0 um, 3 um]}\nrender: {frames: 1, seed: 1}\n"
)


def _labs() -> Iterator[Case]:
    from scenes.specs.resolved import resolve_distortion, resolve_focus, resolve_turntable

    resolvers = {"focus": resolve_focus, "distortion": resolve_distortion, "turntable": resolve_turntable}
    for stem, resolve in resolvers.items():
        yield _config(f"lab-{stem}", lab, stem, resolve, f"{stem}.yaml", weight=0.5)
    own = {
        "test.yaml": edited(
            job_of("distortion.yaml"),
            ("camera: gf7", "camera: ./gf7.yaml"),
            ("turntable: turntable", "turntable: ./t.yaml"),
        ),
        "t.yaml": job_of("turntable.yaml"),
        "gf7.yaml": text_of("library/cameras/gf7.yaml"),
    }
    yield from _own({"t.yaml": "turntable test", "gf7.yaml": "camera"}, "lab-distortion-own", lab, "distortion", own)


def _orbits() -> Iterator[Case]:
    from scenes.specs.orbit.setup import resolve_angle, resolve_calibration, resolve_monitor, resolve_simulate

    configs = {
        "angle": resolve_angle,
        "calibrate": resolve_calibration,
        "monitor": resolve_monitor,
        "simulate": resolve_simulate,
    }
    for stem, resolve in configs.items():
        yield _config(f"orbit-{stem}", orbit, stem, resolve, f"{stem}.yaml", weight=0.5)
    payload = edited(text_of("library/payloads/th1.yaml"), ("detector: th1_line", "detector: ./line.yaml"))
    own = {"th1.yaml": payload, "line.yaml": text_of("library/detectors/th1_line.yaml")}
    for command, whole in (("angle", 5), ("simulate", 20)):
        test = {"test.yaml": edited(job_of(f"{command}.yaml"), ("camera: th1", "camera: ./th1.yaml"))}
        kinds = {"th1.yaml": "payload", "line.yaml": "detector"} if command == "simulate" else {"th1.yaml": "payload"}
        yield from _own(kinds, f"orbit-{command}-own", orbit, command, {**test, **own}, whole=whole)


def _studies() -> Iterator[Case]:
    from twin.study.runs.setup import resolve_study

    one: dict[str, Any] = {"options": ("--workers", "1"), "starts": True}
    smoke = "examples/study_smoke.yaml"
    yield _config("study", study, "", resolve_study, smoke, **one, weight=0.5)
    text = edited(
        text_of(smoke),
        ("file: perturb}", "file: ./base.yaml}"),
        ("uniform: [-10 arcsec, 10 arcsec]", "table: {file: values.csv, column: turn}"),
        ("normal: {mean: 0 um, sigma: 2 um}", "table: {file: values.csv, column: despace}"),
        ("  warmth:", "  # warmth:"),
        ("kind: latin_hypercube, runs: 100, seed: 1", "kind: grid"),
    )
    table = "turn,despace\n" + "".join(f"{k - 5} arcsec,{0.5 * k} um\n" for k in range(12))
    own = {"study.yaml": text, "base.yaml": text_of("examples/perturb.yaml"), "values.csv": table.encode()}
    kinds = {"study.yaml": "study", "base.yaml": "job", "values.csv": "table of a study"}
    yield from _own(kinds, "study-own", study, "", own, **one, weight=0.7)


def _designs() -> Iterator[Case]:
    own = {
        "design.yaml": edited(job_of("design.yaml"), ("camera: gf7\n", "camera: ./gf7.yaml\n")),
        "gf7.yaml": text_of("library/cameras/gf7.yaml"),
    }
    yield from _own({"gf7.yaml": "camera"}, "design-own", design, "", own, whole=40)
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "kept.search"
        with suppress(KeyboardInterrupt), Journal(kept, "fuzzed") as journal_:
            beam = Beam(0.1, 0.0, 0.03, 0.01, 2.6, 0.2, 0.0, 0.1, 0.1)
            number = LayoutNumber((beam, beam), 0, "pupil_x")
            journal_.keep(
                number, Slope(number, values=FrozenMap({"orbit": FrozenMap({"angle": 1e-7})}), brightest=np.ones(4))
            )
            raise KeyboardInterrupt
        files = {"kept.search": kept.read_bytes()}
    yield Case(
        "layouts-journal", "journal of a search", bench, ("journal",), files, "kept.search", changes=("kept.search",)
    )


__all__ = ["cases"]
