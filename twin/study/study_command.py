"""What ``python -m twin.study`` does between its options and its files."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.numerics.backend import cores, load_backend
from scenes.kinds.file_kinds import read_for
from scenes.yaml.errors import InputError
from twin.run import cli, cluster, durable, memory, provenance, run_folder
from twin.study.runs import sampling
from twin.study.runs.chunk_store import ChunkStore
from twin.study.runs.engine import Engine, Progress, fit_workers
from twin.study.runs.plan import Plan, require_study_memory
from twin.study.runs.setup import StudySetup, base_of, resolve_study
from twin.study.runs.study_folder import PROGRAM, StudyFolder


@dataclass(frozen=True)
class StudyOptions:
    """What the user chose.

    Attributes:
        out: folder of the study, None for the next free one.
        workers: number of local processes, None for one per core.
        scheduler: address of a running cluster, None for local processes.
        resume: go on with what is there.
        force: replace what is there.
        confirmed: run more than the study's limit.
        backend: where to trace.
    """

    out: Path | None = None
    workers: int | None = None
    scheduler: str | None = None
    resume: bool = False
    force: bool = False
    confirmed: bool = False
    backend: str = "llvm"


class Broken(Exception):
    """The study was broken off by a signal; what is done stays.

    Attributes:
        code: exit code.
    """

    def __init__(self, number: int) -> None:
        super().__init__("interrupted" if number == signal.SIGINT else "terminated")
        self.code = 128 + number


@dataclass(frozen=True, eq=False)
class StudyRun:
    """A finished study.

    Attributes:
        numbers: contents of study.json, with the verdict and the warnings.
        verdict: what was found, in two sentences at most.
        folder: where it is.
        fault: what the study's file says of its responses and the runs contradict; None where they do not.
        missing: figures and files that could not be made, a sentence each; all else is there.
    """

    numbers: dict[str, Any]
    verdict: str
    folder: Path
    fault: InputError | None = None
    missing: tuple[str, ...] = ()


def run_study(
    file: Path, options: StudyOptions, progress: Progress, opened: Callable[[StudyFolder], None] = lambda folder: None
) -> StudyRun:
    """Read a study, run what is missing of it, write its results.

    Args:
        file: of the study, or a config.yaml.
        options: what the user chose.
        progress: what is told meanwhile.
        opened: told the folder.

    Raises:
        InputError, InputErrorText, RunFolderError: bad input; nothing that was there is lost.
        IncompleteError, ProgramFault, ClusterError: not all runs could be done; the others stay for --resume.
        Broken: SIGINT, SIGTERM or SIGHUP; what is done stays.
    """
    cli.check_backend(options.backend)
    cluster.refuse_both(options.workers, options.scheduler)
    if options.resume and options.force:
        raise cli.InputErrorText("--resume goes on with a folder, --force replaces it; choose one of them")
    if options.resume and options.out is None:
        raise cli.InputErrorText("--resume needs the folder to go on with: --out DIR")
    setup = read_for(PROGRAM, file, resolve_study)
    _check_size(setup, options.confirmed)
    base = base_of(setup)
    plan = Plan.of(setup)
    warnings: list[str] = []
    warn = progress.warn

    def remember(*texts: str) -> None:
        for text in texts:
            warnings.append(text)
            warn(text)

    progress.warn = remember
    started = time.time()
    provenance.program_digest()  # of the files that compute, which may be others when the study ends
    with broken_by_signals():
        # a scheduler that cannot be reached is told before anything is written
        with (
            _workers(options, setup, remember) as start,
            StudyFolder(run_folder.chosen(options.out, file.stem), setup, options.resume, options.force) as folder,
        ):
            opened(folder)
            store = ChunkStore(folder.path, plan)
            store.open()
            remember(*store.corrupt)
            # nor is what judges cameras, before the study's file is known to be good
            from scenes.models.camera_sharpness import blur_warnings, cameras_of
            from twin.sensors.area_detector import coarse_warnings

            given = blur_warnings(base, load_backend(options.backend)) if cameras_of(base) else ()
            given = (*given, *coarse_warnings(base))
            remember(*given)
            engine = Engine(plan, store, options.backend, progress)
            count = 0
            if store.missing:
                with start() as workers:
                    remember(*workers.warnings)
                    engine.run(workers, memory.largest_memory())
                    count = workers.count
            else:
                progress.done(store.runs, plan.runs)
            # drawing libraries and the like are not needed before
            from twin.study.report.study_report import write_report
            from twin.study.report.study_statistics import StudyRuns, impossible
            from twin.study.study_files import write_data

            result = store.result()
            numbers = write_data(plan, result, engine.seconds, engine.computed, folder)
            report = write_report(numbers.data, plan, folder, numbers.files, (*given, *numbers.unwritten))
            missing = (*numbers.unwritten, *report.undrawn)
            remember(*(text for text in report.warnings if text not in warnings))
            fault = impossible(StudyRuns.of(numbers.data, setup.study))
            entries: dict[str, Any] = {"backend": options.backend, "seed": setup.study.design.seed, "workers": count}
            entries |= {"runs": plan.runs, "failed": int(result.failed.sum())}
            entries["warnings"] = warnings
            entries["inputs"] = provenance.inputs_in(setup.tree)
            entries["again"] = [PROGRAM, "config.yaml", "--backend", options.backend, "--yes"]
            run_folder.write_manifest(folder, PROGRAM, started, engine.seconds, **entries)
    told = {**numbers.summary, "verdict": report.verdict, "warnings": warnings}
    return StudyRun(told, report.verdict, folder.target, fault, missing)


def _check_size(setup: StudySetup, confirmed: bool) -> None:
    limit = setup.study.limits.runs
    runs = sampling.run_count(setup.study)
    if runs > limit and not confirmed:
        raise setup.error(
            f"the study has {runs} runs, more than its limit of {limit}",
            ("limits", "runs"),
            allowed="a larger limit, or the option --yes",
        )
    require_study_memory(setup)


@contextmanager
def _workers(
    options: StudyOptions, setup: StudySetup, warn: Callable[[str], None]
) -> Iterator[Callable[[], AbstractContextManager[cluster.Workers]]]:
    """What starts the workers. Those of others are reached at once, own ones only when there is something to do."""
    if options.scheduler is not None:
        with cluster.remote_workers(options.scheduler, warn) as workers:

            @contextmanager
            def given() -> Iterator[cluster.Workers]:
                yield workers

            yield given
        return
    wanted = options.workers if options.workers is not None else cores()
    count = fit_workers(wanted, setup.study.limits.bytes, cluster.LEAST_MEMORY)
    if count < wanted:
        warn(f"{count} workers instead of {wanted}: no more fit into the study's {setup.study.limits.memory}")
    yield lambda: cluster.local_workers(count)


@contextmanager
def broken_by_signals() -> Iterator[None]:
    """Let SIGTERM, SIGHUP and Ctrl-C end the block as Broken, whatever the libraries in between make of them."""
    got: list[int] = []

    def leave(number: int, frame: object) -> None:
        if not got:  # a second one while the workers are being stopped must not leave them behind
            got.append(number)
            raise KeyboardInterrupt

    before = {number: signal.signal(number, leave) for number in (*durable.ending_signals(), signal.SIGINT)}
    try:
        yield
    except BaseException:
        if not got:
            raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if got:
        raise Broken(got[0])
