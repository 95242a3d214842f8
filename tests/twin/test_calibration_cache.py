"""Calibrations on disk: read back they are what is computed, and none is read that was made of anything else."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, MutableMapping
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.sag_terms import SAG_TERMS
from optics.geometry.tree import Motion
from optics.materials.material import MATERIALS
from optics.numerics.backend import load_backend
from optics.raytrace.assembly import Interaction
from optics.raytrace.reflectors import REFLECTORS
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob, resolve_job
from scenes.yaml.spec import Spec
from twin.framework import provenance
from twin.monitor import calibration_cache
from twin.monitor.calibration_cache import ENDING, OFF, VARIABLE, CacheEntry, cache_folder
from twin.monitor.monitor_experiment import MonitorExperiment

PIECES = """
import sys
from tests.twin.test_calibration_cache import calibrated, job, numbers
import hashlib
experiment, kept = calibrated(job())
print(kept, hashlib.sha256(repr([(n.shape, n.tobytes()) for n in numbers(experiment)]).encode()).hexdigest())
"""


def job(disturbances: str = "launch") -> ResolvedJob:
    return resolve_job(JobSpec.model_validate({"instrument": "monitor_pair", "disturbances": disturbances}))


def calibrated(resolved: ResolvedJob) -> tuple[MonitorExperiment, bool]:
    """A calibrated experiment, and whether its calibration was there before."""
    experiment = MonitorExperiment(resolved, load_backend())
    return experiment, "calibration" in vars(experiment)


def arrays(thing: Any) -> Iterator[np.ndarray]:
    """All arrays and numbers in a nested value, in order."""
    if isinstance(thing, np.ndarray | float | int):
        yield np.asarray(thing)
    elif isinstance(thing, dict):
        yield from arrays(list(thing.values()))
    elif isinstance(thing, list | tuple):
        for one in thing:
            yield from arrays(one)
    elif hasattr(thing, "__dataclass_fields__"):
        yield from arrays([getattr(thing, name) for name in thing.__dataclass_fields__])


def numbers(experiment: MonitorExperiment) -> list[np.ndarray]:
    """What an experiment is calibrated to, and what follows from it in a state."""
    focus, calibration = experiment.nominal_focus, experiment.calibration
    moved = experiment.path.expected_photons([{"base/forward/M2": Motion(shift=(0.0, 0.0, 3e-6))}])
    checks = vars(experiment.path.checked)
    both = experiment.nominal_truth, experiment.disturbances, experiment.instrument.cameras
    return list(arrays([focus, calibration, moved, checks, experiment.wide_photons, *both]))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of this test, to which this process has written nothing."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(calibration_cache, "_written", 0)
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def entry() -> CacheEntry:
    # the process may have asked before under other settings of linear algebra
    calibration_cache._machine.cache_clear()
    return CacheEntry.of(load_backend(), (), "some input")


@pytest.mark.second
def test_a_calibration_read_back_is_the_computed_one_bit_for_bit(folder: Path) -> None:
    os.environ[VARIABLE] = OFF
    computed = numbers(MonitorExperiment(job(), load_backend()))
    os.environ[VARIABLE] = str(folder)
    first, kept = calibrated(job())
    assert not kept
    assert [a.tobytes() for a in numbers(first)] == [a.tobytes() for a in computed]
    again, kept = calibrated(job())
    assert kept
    assert "disturbances" not in vars(again)
    assert len(computed) > 100
    assert [a.tobytes() for a in numbers(again)] == [a.tobytes() for a in computed]
    # what is read refers to the files of this job, not of the one that was kept
    assert again.instrument.spec is again.resolved.instrument
    assert again.instrument is not first.instrument


def test_members_of_enumerations_are_kept_by_every_python(folder: Path, entry: CacheEntry, monkeypatch) -> None:
    """Debian 12's Python 3.11.2 writes a call of a function, which the reader refuses."""
    monkeypatch.setattr(Enum, "__reduce_ex__", lambda self, protocol: (getattr, (type(self), self.name)))
    entry.write([Interaction.REFLECT])
    assert entry.read() == [Interaction.REFLECT]


@pytest.mark.second
def test_two_processes_at_once_make_one_whole_entry(folder: Path) -> None:
    command = [sys.executable, "-c", PIECES]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    both = [process.communicate()[0].split() for process in started]
    third = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
    assert [both[0][1]] * 2 == [both[1][1], third[1]]
    assert third[0] == "True"
    assert {file.suffix for file in folder.iterdir()} == {ENDING}
    assert not [file for file in folder.iterdir() if file.name.startswith(".")]


def changed(value: Any) -> Iterator[Any]:
    """A nested value with one number, text or truth value after the other changed."""
    if isinstance(value, Spec):
        for name in type(value).model_fields:
            for one in changed(getattr(value, name)):
                yield value.model_copy(update={name: one})
    elif isinstance(value, dict):
        for key, own in value.items():
            for one in changed(own):
                yield type(value)({**value, key: one})
    elif isinstance(value, tuple):
        for k, own in enumerate(value):
            for one in changed(own):
                yield (*value[:k], one, *value[k + 1 :])
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, float | int):
        yield float(np.nextafter(value, np.inf)) if isinstance(value, float) else value + 1
    elif isinstance(value, str):
        yield value + "x"
    elif value is None:
        yield 0.0


@pytest.mark.second
def test_every_value_of_every_input_is_part_of_the_key() -> None:
    resolved = job()
    given = resolved.instrument, dict(resolved.cameras), resolved.detector, resolved.disturbances
    keys = [CacheEntry.of(load_backend(), (), one).key for one in (given, *changed(given))]
    assert None not in keys
    assert len(set(keys)) == len(keys) > 300


@pytest.mark.second
def test_an_experiment_names_each_of_its_inputs() -> None:
    resolved = job()
    name, camera = next(iter(resolved.cameras.items()))
    sharper = camera.model_copy(update={"description": "another"})
    moved = {**resolved.cameras, name: sharper}
    detector = resolved.detector.model_copy(update={"dark_noise_e": 13.0})
    instrument = resolved.instrument.model_copy(update={"temperature": 293.5})
    jobs = {
        "camera": {"cameras": type(resolved.cameras)(moved)},
        "detector": {"detector": detector},
        "instrument": {"instrument": instrument},
    }
    keys = {"": MonitorExperiment(resolved, load_backend())._entry.key}
    keys |= {k: MonitorExperiment(resolved.model_copy(update=u), load_backend())._entry.key for k, u in jobs.items()}
    keys["beams"] = MonitorExperiment(resolved, load_backend(), free_beams=False)._entry.key
    assert len(set(keys.values())) == 5
    one = MonitorExperiment(resolved, load_backend())
    stated = [one._entry.part("disturbances", replace(one.prior, name=name)).key for name in ("launch", "other")]
    assert len({*stated, one._entry.key}) == 3


@pytest.mark.second
@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (provenance, "program_digest", lambda: "0" * 64),
        (provenance, "versions", lambda: {"numpy": "1"}),
        (provenance, "_processor", lambda: "another"),
        (provenance, "_simd", lambda: ["another"]),
        (provenance, "cores", lambda: 99),
        (os.environ, "OPENBLAS_CORETYPE", "Sandybridge"),
        (os.environ, "DRJIT_LIBLLVM_PATH", "/another/libLLVM.so"),
        (calibration_cache, "threadpool_info", lambda: [{"filepath": "numpy", "internal_api": "a", "version": "b"}]),
        (SAG_TERMS, "zernike", SAG_TERMS["polynomial"]),
        (REFLECTORS, "another", next(iter(REFLECTORS.values()))),
        (calibration_cache, "MATERIALS", dict(list(MATERIALS.items())[1:])),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_program_packages_and_machine_are_part_of_the_key(owner, name, value, entry, monkeypatch) -> None:
    backend = load_backend()
    (monkeypatch.setitem if isinstance(owner, MutableMapping) else monkeypatch.setattr)(owner, name, value)
    calibration_cache._machine.cache_clear()
    other = CacheEntry.of(backend, (), "some input").key
    monkeypatch.undo()
    calibration_cache._machine.cache_clear()
    assert None not in (other, entry.key)
    assert other != entry.key
    assert CacheEntry.of(backend, (), "some input").key == entry.key


def test_the_content_of_a_file_that_an_input_names_is_part_of_the_key(tmp_path: Path) -> None:
    file = tmp_path / "map.csv"
    keys = []
    for text in ("1", "2"):
        file.write_text(text)
        keys.append(CacheEntry.of(load_backend(), (), str(file)).key)
    assert keys[0] != keys[1]


class Foreign:
    """A class of somebody's script."""


@pytest.mark.parametrize("value", [Foreign, Foreign(), lambda: 0, object(), {"a": [Foreign()]}])
def test_what_is_no_part_of_the_program_has_no_key_and_is_not_kept(value, folder: Path) -> None:
    entry = CacheEntry.of(load_backend(), (), value)
    assert entry.key is None
    assert entry.part("more").key is None
    assert entry.get(lambda: 1.0) == 1.0
    assert not folder.exists()
    assert CacheEntry.of(replace(load_backend(), name="cuda"), (), 1).key is None


class Command:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (os.environ[VARIABLE] + "/intruder",)


def written(entry: CacheEntry, folder: Path) -> Path:
    entry.write({"numbers": np.arange(3.0)})
    (file,) = folder.iterdir()
    return file


DAMAGES = {
    "cut": lambda file, entry: file.write_bytes(file.read_bytes()[:-1]),
    "empty": lambda file, entry: file.write_bytes(b""),
    "flipped": lambda file, entry: file.write_bytes(file.read_bytes()[:-1] + bytes([file.read_bytes()[-1] ^ 1])),
    "other key": lambda file, entry: replace(entry, key="x").write(1) or file.with_name(f"x{ENDING}").rename(file),
    "readable by others": lambda file, entry: file.chmod(0o640),
    "folder of others": lambda file, entry: file.parent.chmod(0o770),
    "a link": lambda file, entry: file.symlink_to(file.rename(file.with_suffix(".x"))),
    "a folder": lambda file, entry: (file.unlink(), file.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_entry_is_computed_anew(damage, folder: Path, entry: CacheEntry) -> None:
    file = written(entry, folder)
    assert list(entry.read()["numbers"]) == [0.0, 1.0, 2.0]
    assert (folder.stat().st_mode & 0o777, file.stat().st_mode & 0o777) == (0o700, 0o600)
    DAMAGES[damage](file, entry)
    assert entry.read() is None
    assert entry.get(lambda: 7.0) == 7.0
    if damage in ("cut", "empty", "flipped", "other key", "readable by others"):
        assert entry.read() == 7.0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make files of another user")
def test_an_entry_of_another_user_is_not_read(folder: Path, entry: CacheEntry) -> None:
    os.chown(written(entry, folder), 12345, 12345)
    assert entry.read() is None


@pytest.mark.parametrize("thing", [Command(), os.system, Foreign(), pickle.loads])
def test_no_entry_runs_code(thing, folder: Path, entry: CacheEntry, monkeypatch) -> None:
    monkeypatch.setenv(VARIABLE, str(folder))
    entry.write({"numbers": thing})
    assert len(list(folder.iterdir())) == 1
    assert entry.read() is None
    assert len(list(folder.iterdir())) == 1


def test_the_folder_is_bounded_and_the_oldest_go_first(folder: Path, entry: CacheEntry, monkeypatch) -> None:
    monkeypatch.setenv(VARIABLE, str(folder))
    monkeypatch.setattr(calibration_cache, "MOST_BYTES", 3500)
    entries = [entry.part(k) for k in range(4)]
    for k, one in enumerate(entries[:3]):
        one.write(b"x" * 1000)
        os.utime(folder / f"{one.key}{ENDING}", (k, k))
    entries[0].read()  # used last
    entries[3].write(b"x" * 1000)
    assert [one.read() is not None for one in entries] == [True, False, True, True]
    monkeypatch.setattr(calibration_cache, "MOST_WRITTEN", 0)
    entry.write(1)
    assert entry.read() is None


def test_where_the_cache_is(monkeypatch, tmp_path: Path, entry: CacheEntry) -> None:
    for variables, place in (
        ({VARIABLE: OFF}, None),
        ({VARIABLE: "/a", "XDG_CACHE_HOME": "/b"}, Path("/a")),
        ({VARIABLE: "", "XDG_CACHE_HOME": "/b"}, Path("/b/space-camera-twin")),
        ({VARIABLE: "", "XDG_CACHE_HOME": "relative", "HOME": "/c"}, Path("/c/.cache/space-camera-twin")),
    ):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        assert cache_folder() == place
    # a place where nothing can be written changes nothing
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file/below"))
    assert entry.get(lambda: 3.0) == 3.0


@pytest.mark.second
def test_only_calibrations_of_the_built_instrument_are_kept(folder: Path) -> None:
    first, _ = calibrated(job())
    other = first.with_instrument(first.instrument)
    assert "wide_photons" not in vars(other)
    other.calibration  # noqa: B018
    assert not calibrated(job())[1]
    # images of other states would count in the manifest of every later run
    first.path.expected_photons([{}])
    first.calibration  # noqa: B018
    assert not calibrated(job())[1]


def test_an_entry_refers_to_no_specification_but_those_given(folder: Path, entry: CacheEntry) -> None:
    entry.write(job().instrument)
    assert not folder.exists()
