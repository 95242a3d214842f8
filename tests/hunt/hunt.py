"""One case after another: run as the command runs it, and judged by the truth: right, warned, refused, or a defect.

A reading may be wrong only where a warning names what is wrong, and warnings that compare with the truth do not count:
a user's frames have none.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optics.numerics.backend import Backend
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml
from tests.hunt.dense_images import DenseImages
from tests.hunt.legal_jobs import legal_instrument, legal_job, legal_statement
from twin.main_job.render_job import render_job
from twin.main_job.render_results import RenderRun
from twin.main_job.verdict import judge, readings
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.reading_table import Reading

FAR = 5.0
"""Sigmas from which on a reading is wrong: of ten thousand honest ones in a thousand cases none comes so far (6e-3)."""

PROMISED = 1e-3
"""Error of an image, of its peak, beyond which the twin promises to refuse it."""

JOBS = 6
"""For each instrument."""

DENSEST = 150.0
"""Phase of images that are worked out once more, radians; more would take minutes."""

RIGHT, WARNED, REFUSED = "right", "warned", "refused"
WRONG_READING, WRONG_IMAGE, BAD_REFUSAL, TRACEBACK = "wrong reading", "wrong image", "bad refusal", "traceback"
WRONG_NUMBER = "wrong number"
DEFECTS = (WRONG_READING, WRONG_IMAGE, WRONG_NUMBER, BAD_REFUSAL, TRACEBACK)


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        case: instrument and job by number.
        kind: RIGHT, WARNED, REFUSED or one of DEFECTS.
        text: what was edited and moved, and what was wrong.
        checked: whether images were worked out once more.
    """

    case: str
    kind: str
    text: str
    checked: bool = False

    @property
    def end(self) -> str:
        """What became of it."""
        return self.kind

    @property
    def wrong(self) -> str:
        """What misled the user, if anything did."""
        return self.text if self.kind in DEFECTS else ""

    def __str__(self) -> str:
        return f"{self.case}: {self.kind}: {self.text}"


def hunt(first: int, cases: int, folder: Path, backend: Backend, dense: int) -> Iterator[Outcome]:
    """Outcomes of at least so many cases.

    Args:
        first: number of the first instrument.
        cases: how many jobs; an instrument that is refused counts as one.
        folder: where to write their files.
        backend: where to trace.
        dense: images of every so many cases are worked out once more.
    """
    done, number = 0, first
    while done < cases:
        for outcome in _of_instrument(number, min(JOBS, cases - done), folder / str(number), backend, dense):
            yield outcome
            done += 1
        number += 1


def _of_instrument(number: int, jobs: int, folder: Path, backend: Backend, dense: int) -> Iterator[Outcome]:
    folder.mkdir(parents=True, exist_ok=True)
    made = legal_instrument(number)
    made.write(folder)
    name, stated = legal_statement(number)
    if stated is not None:
        (folder / "stated.yaml").write_text(dump_yaml(stated), "utf-8")
    path = folder / "job.yaml"
    path.write_text(dump_yaml({"instrument": "./instrument.yaml", "disturbances": name}), "utf-8")
    try:
        experiment = MonitorExperiment(resolve(path), backend)
    except Exception as error:
        yield failed(f"{number}", error, made.text)
        return
    for k in range(jobs):
        case = f"{number}.{k}"
        job = legal_job(number, k, experiment.instrument.nodes)
        text = f"{made.text}; {job['perturb']}, disturbances {name}, {job['render']}"
        path.write_text(dump_yaml(job), "utf-8")
        try:
            run = render_job(resolve(path), backend, experiment=experiment)
        except Exception as error:
            yield failed(case, error, text)
            if isinstance(error, InputError) and "even as designed" in str(error):
                return
            continue
        yield _judged(case, run, text, (number * JOBS + k) % dense == 0)


def failed(case: str, error: Exception, text: str) -> Outcome:
    """Return what an exception makes of a case: a refusal with key and remedy, or a defect."""
    if not isinstance(error, InputError):
        last = traceback.format_exception(error)[-3:]
        return Outcome(case, TRACEBACK, f"{text}\n  " + "".join(last).strip())
    issue = error.issues[0]
    good = bool(issue.key) and issue.allowed is not None
    return Outcome(case, REFUSED if good else BAD_REFUSAL, f"{text}\n  {error}")


def _judged(case: str, run: RenderRun, text: str, dense: bool) -> Outcome:
    checked, difference = _image_error(run) if dense else (False, "")
    if difference:
        return Outcome(case, WRONG_IMAGE, f"{text}\n  {difference}", True)
    warnings = blind_warnings(run)
    off = [r for r in readings(run, run.judged) if abs(r.ratio) > FAR]
    unsaid = [r for r in off if not any(_names(warning, r, run) for warning in warnings)]
    said = "".join(f"\n  ({warning})" for warning in warnings)
    if unsaid:
        worst = max(unsaid, key=lambda r: abs(r.ratio))
        return Outcome(
            case,
            WRONG_READING,
            f"{text}\n  {worst.name} {worst.read}, is {worst.true:.6g}: {worst.ratio:+.3g} sigma{said}",
            checked,
        )
    return Outcome(case, WARNED if off else RIGHT, f"{text}{said}", checked)


def blind_warnings(run: RenderRun) -> tuple[str, ...]:
    """What a user is told who does not know the truth."""
    return tuple(text for text in judge(run).warnings if " is misread by more than the change itself" not in text)


def _names(warning: str, reading: Reading, run: RenderRun) -> bool:
    """Whether a warning is about a reading: its camera or a part of it; for angle and ground any camera or the base."""
    names = (reading.camera,) if reading.camera else tuple(run.experiment.instrument.cameras)
    files = {run.experiment.instrument.cameras[name].spec.name for name in names}
    return any(name in warning for name in (*names, *files, "base", "every reading"))


def _image_error(run: RenderRun) -> tuple[bool, str]:
    """Whether images were worked out once more, and what is wrong with them."""
    path = run.experiment.path
    dense = DenseImages(path, run.state)
    if dense.phase > DENSEST:
        return False, ""
    dense.trace()
    for channel, image in enumerate(run.photons_after):
        row, column = np.unravel_index(np.argmax(image), image.shape)
        rows = np.clip(row + np.array([0, 1, -3, 9, -21]), 0, image.shape[0] - 1)
        columns = np.clip(column + np.array([0, -2, 3, 8, 17]), 0, image.shape[1] - 1)
        want = dense.photons(channel, rows, columns)
        worst = float(np.max(np.abs(want - image[rows, columns])) / image.max())
        if worst > PROMISED:
            return True, f"image of {path.channels[channel].key} is wrong by {worst:.3g} of its peak"
    return True, ""
