"""Fixtures that every test may use. They last the session, so that kernels compile and cameras are derived once."""

import gc
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from matplotlib.figure import Figure

from optics.numerics.backend import Backend, cores, load_backend
from scenes.models import instrument_builder
from scenes.models.camera_model import CameraModel, derive_camera
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.specs.job import JobSpec
from scenes.specs.load import load_camera, load_instrument
from scenes.specs.resolved import resolve_job
from tests.tiers import longest_first, shuffled
from twin.monitor.calibration_cache import VARIABLE, recomputed
from twin.monitor.monitor_experiment import MonitorExperiment

# Properties are tried on the same examples every time, on every machine. Kernels compile with the first of them.
settings.register_profile(
    "twin", derandomize=True, deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("twin")

MOST_PROCESSES, GIBIBYTES_EACH = 4, 3
"""Of the default's test processes: how many at most, and what memory the machine has for each at least."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """How many processes run the tests: 0 for the one that was started, also when it is asked for one file only."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    most = min(cores(), MOST_PROCESSES, int(memory / GIBIBYTES_EACH))
    chosen = {config.invocation_params.dir / argument.split("::")[0] for argument in config.args}
    if all(place.is_file() for place in chosen):
        most = min(most, len(chosen))
    return most if most > 1 else 0


def pytest_configure(config: pytest.Config) -> None:
    """Leave linear algebra one thread in each of several processes, before they are started and load it.

    Several threads of OpenBLAS wait actively, for each other's processor. Dr.Jit's wait asleep and stay as they are.

    Under ``nohup`` every process starts deaf to SIGHUP, in the background of a shell script to SIGINT, and the programs
    respect it; the tests of these signals do not mean it.
    """
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # The tests start hundreds of Python processes, and each would compile the same sources.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if VARIABLE not in os.environ:
        # the processes of one run share what they calibrate, and start from nothing
        os.environ[VARIABLE] = tempfile.mkdtemp(prefix="calibrations-")
        config.add_cleanup(partial(shutil.rmtree, os.environ[VARIABLE], ignore_errors=True))
    if getattr(config.option, "numprocesses", None):
        for library in ("OPENBLAS", "OMP", "MKL"):
            os.environ.setdefault(f"{library}_NUM_THREADS", "1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--random-order", type=int, metavar="SEED", help="shuffle the files, and the tests in each")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Several processes begin with long files."""
    if (seed := config.getoption("--random-order")) is not None:
        items[:] = shuffled(items, seed)
    elif hasattr(config, "workerinput"):
        items[:] = longest_first(items)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Count the skipped tests of each reason."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = Counter(report.longrepr[2].removeprefix("Skipped: ") for report in skipped)
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} skipped: {reason}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[object]:
    """Put figures together without drawing them as SVG, which takes a tenth of all time, but for tests marked `drawn`.

    What is drawn is held by the golden runs of all commands, which are processes of their own.
    """
    save = Figure.savefig

    def savefig(figure: Figure, out: Any, **options: Any) -> None:
        if options.get("format") == "svg" and hasattr(out, "write") and not item.get_closest_marker("drawn"):
            out.write("<svg></svg>")
        else:
            save(figure, out, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        return (yield)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Leave thousands of collected tests and all imported modules out of each later collection of garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_heartbeat() -> Iterator[None]:
    """Commands inside this process tell no progress: whether a line comes before what a test reads is a matter of how
    loaded the machine is. What is told of it has tests of its own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.framework.cli.TICK_SECONDS", 3600.0)
        yield


@pytest.fixture(autouse=True)
def calibrations_of_patched_code(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compute instruments and calibrations of a test that patches the program, and keep none of them for others."""
    if "monkeypatch" not in request.fixturenames:
        yield
        return
    with pytest.MonkeyPatch.context() as patch, recomputed():
        patch.setattr(instrument_builder, "_built", cache(instrument_builder._built.__wrapped__))
        yield


@pytest.fixture(scope="session")
def backend() -> Backend:
    return load_backend("llvm")


@pytest.fixture(scope="session")
def camera(backend):
    """Function: name of a camera of the library -> its derived model."""

    @cache
    def derive(name: str) -> CameraModel:
        return derive_camera(load_camera(name), backend)

    return derive


@pytest.fixture(scope="session")
def instrument(backend):
    """Function: name of an instrument of the library -> its model."""

    @cache
    def build(name: str) -> Instrument:
        spec = load_instrument(name)
        stems = {site.camera for site in spec.cameras.values()}
        return build_instrument(spec, {stem: load_camera(stem) for stem in stems}, backend)

    return build


@pytest.fixture(scope="session")
def gf7(camera) -> CameraModel:
    return camera("gf7")


@pytest.fixture(scope="session")
def gf7_pair(instrument) -> Instrument:
    return instrument("gf7_pair")


@pytest.fixture(scope="session")
def experiment(backend):
    """Function: name of an instrument of the library -> the monitoring experiment on it, calibrated."""

    @cache
    def prepare(name: str) -> MonitorExperiment:
        return MonitorExperiment(resolve_job(JobSpec(instrument=name)), backend)

    return prepare


def pytest_report_header() -> str:
    """Say which random cases are run today."""
    from tests.daily import first_of_today

    return f"random cases begin with {first_of_today()} (RANDOM_CASES=NUMBER repeats those of another day)"
