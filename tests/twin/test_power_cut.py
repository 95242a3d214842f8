"""What stands on the disk after a power cut at any moment: only what was written through (fsync) can be relied on.

A layer below the programs (``LD_PRELOAD``) reports every fsync of a file or folder and every change of a name before it
happens. From what it saw the disk is made up again as it may be after a cut at each of these moments: the oldest that
the file system may keep, the newest, and mixtures. It writes nothing through itself.

    python -m tests.twin.test_power_cut SCENARIO FOLDER INPUTS FAULT
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import shutil
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from tests.twin import record_bench, replacing
from tests.twin.commands import invoke
from twin.framework import durable
from twin.framework.journal import Journal
from twin.framework.run_folder import KeptWork, RunFolder, RunFolderError, read_manifest, remove_run, write_manifest
from twin.operate.__main__ import app

pytestmark = pytest.mark.second
ROOT = Path(__file__).resolve().parents[2]
Inode = tuple[int, int]
Tree = dict[str, bytes | None]
"""Path -> content of a file, None of a folder."""


@dataclass
class Moment:
    """What stood below the folder, reached the disk or not: names by folder, contents by file."""

    event: str
    inode: Inode
    names: dict[Inode, dict[str, Inode]]
    contents: dict[Inode, bytes]


class Recorder:
    """Hears the layer, one event at a time, and keeps what stands below a folder. No inode's number is used again."""

    def __init__(self, base: Path, place: Path, scenario: str) -> None:
        self.base, self.moments, self.heard, self.scenario = base, [], [], scenario
        self.folders: set[Inode] = set()
        self._held: dict[Inode, int] = {}
        self._known: dict[bytes, bytes] = {}
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(place))
        self._socket.listen(64)
        self.root = self._look(base, {}, {})
        self._thread = threading.Thread(target=self._hear, daemon=True)
        self._thread.start()

    def _hear(self) -> None:
        while True:
            caller, _ = self._socket.accept()
            with caller:
                event, *inode = caller.recv(128).decode().rsplit(" ", 2)
                if event == "end":
                    return
                names: dict[Inode, dict[str, Inode]] = {}
                contents: dict[Inode, bytes] = {}
                self._look(self.base, names, contents)
                self.moments.append(Moment(event, (int(inode[0]), int(inode[1])), names, contents))
                if event == "sync" and sum(one.event == "sync" for one in self.moments) == LOCKED[self.scenario][0]:
                    self.heard.append(second_command(self.scenario, self.base))
                with suppress(OSError):
                    caller.send(b".")

    def _look(self, place: Path, names: dict[Inode, dict[str, Inode]], contents: dict[Inode, bytes]) -> Inode:
        file = os.open(place, os.O_PATH | os.O_NOFOLLOW)
        about = os.fstat(file)
        inode = about.st_dev, about.st_ino
        if self._held.setdefault(inode, file) != file:
            os.close(file)
        if stat.S_ISDIR(about.st_mode):
            self.folders.add(inode)
            own = names[inode] = {}
            for name in os.listdir(place):
                with suppress(FileNotFoundError):
                    own[name] = self._look(place / name, names, contents)
        else:
            content = place.read_bytes()
            contents[inode] = self._known.setdefault(content, content)
        return inode

    def end(self) -> None:
        """Hear no more."""
        with socket.socket(socket.AF_UNIX) as last:
            last.connect(self._socket.getsockname())
            last.send(b"end 0 0")
        self._thread.join(30)
        for file in (*self._held.values(), self._socket.detach()):
            os.close(file)


def disks(recorder: Recorder, files: bool = True, folders: bool = True) -> Iterator[tuple[str, tuple[str, ...], Tree]]:
    """Return moment, what was acknowledged until then, and the disk after a cut, each that is new.

    Args:
        recorder: has heard all.
        files, folders: whether what was asked to be written through is; else a fault of the program's.
    """
    synced: dict[Inode, bytes] = {}
    listed: dict[Inode, dict[str, Inode]] = {}
    last: dict[Inode, bytes] = {}
    acknowledged: tuple[str, ...] = ()
    seen = set()
    for number, moment in enumerate(recorder.moments):
        last |= moment.contents
        if moment.event.startswith("done "):
            acknowledged += (moment.event.removeprefix("done "),)
        old = dict.fromkeys(last, b"") | synced
        zeros = {one: old[one][: len(new)].ljust(len(new), b"\0") for one, new in last.items()}
        models = [
            ("nothing more", listed, old),
            ("names alone", moment.names, old),
            ("names and sizes", moment.names, zeros),
            ("sizes", listed, zeros),
            ("contents alone", listed, last),
            ("all", moment.names, last),
        ]
        dirty = [one for one, content in moment.contents.items() if old[one] != content]
        models += [("one content", moment.names, old | {one: last[one]}) for one in dirty if len(dirty) in (2, 3)]
        for model, names, contents in models:
            tree = dict(_standing(recorder.root, names, recorder.folders, contents))
            key = (acknowledged, frozenset(tree.items()))
            if key not in seen:
                seen.add(key)
                yield f"moment {number} ({moment.event}, {model})", acknowledged, tree
        if moment.event == "sync" and moment.inode in moment.names and folders:
            listed[moment.inode] = moment.names[moment.inode]
        elif moment.event == "sync" and moment.inode in last and files:
            synced[moment.inode] = last[moment.inode]


def _standing(folder: Inode, names: dict, folders: set[Inode], contents: dict, path: str = "") -> Iterator[tuple]:
    for name, inode in names.get(folder, {}).items():
        yield f"{path}{name}", None if inode in folders else contents[inode]
        if inode in folders:
            yield from _standing(inode, names, folders, contents, f"{path}{name}/")


# --- programs, and what a disk must hold after them -----------------------------------------------------------------


def done(step: str) -> None:
    """Say that a step has been acknowledged to its user."""
    ctypes.CDLL(None).power_cut_report(f"done {step}".encode(), -1)


def commands(base: Path, inputs: Path) -> list[tuple[object, ...]]:
    """Commands of twin.operate, and the number of entries in the record after each."""
    record = base / "record"
    return [
        ("init", record, "gf7_pair", "--simulated"),
        ("ingest", record, inputs / "a.yaml"),
        ("ingest", record, inputs / "recover-1", "--time", "2026-01-01T01:00:00Z"),
        ("exclude", record, 6, "--why", "a test"),
        ("ingest", record, inputs / "b.yaml"),
    ]


ENTRIES = [0, 5, 6, 7, 12]


def operate(base: Path, inputs: Path) -> None:
    for number, words in enumerate(commands(base, inputs)):
        result = invoke(app, *words)
        assert result.exit_code == 0, result.output
        done(str(number))


def check_record(base: Path, inputs: Path, steps: tuple[str, ...], again: bool) -> None:
    def status() -> int:
        result = invoke(app, "status", base / "record", "--check-all", "--json")
        if result.exit_code:
            assert result.exit_code == 2, result.output
            assert "Traceback" not in result.stderr
            return -1
        told = json.loads(result.stdout)
        assert not told["warnings"], told["warnings"]
        return told["entries"]

    allowed, found = [-1, *ENTRIES], status()
    assert found in allowed[len(steps) : len(steps) + 2], f"{found} entries after {len(steps)} commands"
    if len(steps) < len(ENTRIES) and again:
        result = invoke(app, *commands(base, inputs)[len(steps)])
        assert result.exit_code == 0 or "excluded already" in result.stderr, result.output
        assert status() == ENTRIES[len(steps)]


def replace_run(base: Path, inputs: Path) -> None:
    import h5py

    for stem in ("1", "2"):
        with RunFolder(base / "runs/run", force=True) as folder:
            folder.write_bytes("which.txt", stem.encode())
            (folder.path / "artefacts").mkdir()
            with h5py.File(folder.path / "artefacts/numbers.nc", "w") as file:
                file["numbers"] = list(range(2000))
            write_manifest(folder, "twin.test", 1.5e9, 1.0)
        done(stem)


def check_run(base: Path, inputs: Path, steps: tuple[str, ...], again: bool) -> None:
    target = base / "runs/run"
    found = replacing.standing(target) if target.exists() and any(target.iterdir()) else ""
    assert found in ("", "1", "2")[len(steps) : len(steps) + 2], f"{found!r} after {steps}"
    for other in base.glob("runs/.run.*.partial"):
        # beside a whole target it is the former run, which is being removed, or a run that will be
        assert found or read_manifest(other) is None or replacing.standing(other) is not None, "taken for whole"
    if again:
        replacing.replace_run(target, "again", 1e-6)
        assert replacing.standing(target) == "again"
        durable.sweep(target.parent, remove_run)
        assert [path.name for path in target.parent.iterdir()] == ["run"]


def keep_work(base: Path, inputs: Path) -> None:
    with KeptWork(base / "out", "out", "samples", resume=True) as kept:
        with Journal(kept.begin() / "tested.journal", "this budget", "budget", ()) as journal:
            for piece in range(6):
                journal.keep({str(piece): [float(piece)] * 40})
                done(str(piece))


def check_kept(base: Path, inputs: Path, steps: tuple[str, ...], again: bool) -> None:
    file = base / "out.samples/tested.journal"
    if steps:
        with pytest.raises(RunFolderError, match="another budget"), Journal(file, "another", "budget", ()):
            pass
    with Journal(file, "this budget", "budget", ()) as journal:
        assert {*steps} <= journal.known.keys(), f"{len(journal.known)} pieces after {steps}"
        assert not journal.damaged


SCENARIOS = {"record": (operate, check_record), "run": (replace_run, check_run), "kept": (keep_work, check_kept)}


def plant(fault: str) -> None:
    """Leave out what keeps acknowledged work through a power cut."""
    from twin.operate.record import schema

    if fault.startswith("synchronous"):
        connect = schema._on_connect
        schema._on_connect = lambda connection, record: (
            connect(connection, record),
            connection.execute(f"PRAGMA {fault}").close(),
        )
    elif fault == "no lock":
        fcntl.flock = lambda file, how: None


@pytest.fixture(scope="module")
def layer(tmp_path_factory) -> Path:
    """The layer, compiled."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here, which builds the layer that sees what is written through")
    folder = tmp_path_factory.mktemp("layer")
    source = Path(__file__).with_name("power_cut.c")
    line = [compiler, "-shared", "-fPIC", "-o", str(folder / "layer.so"), str(source), "-ldl"]
    if subprocess.run(line, check=False, capture_output=True).returncode:
        pytest.skip("the C compiler here does not build the layer that sees what is written through")
    return folder / "layer.so"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """Tables and a run folder."""
    folder = tmp_path_factory.mktemp("inputs")
    for name, first in (("a", 0), ("b", 100)):
        (folder / f"{name}_t.csv").write_text(record_bench.table(first, 5))
        (folder / f"{name}.yaml").write_text(record_bench.TELEMETRY.replace("t_*.csv", f"{name}_t.csv"))
    record_bench.run_folder(folder / "recover-1")
    return folder


def record_program(scenario: str, fault: str, layer: Path, inputs: Path, folder: Path) -> Recorder:
    """Return what was seen of a program that ran to its end."""
    (folder / "disk").mkdir()
    recorder = Recorder(folder / "disk", folder / "socket", scenario)
    words = [sys.executable, "-m", "tests.twin.test_power_cut", scenario, str(folder / "disk"), str(inputs), fault]
    own = {"LD_PRELOAD": str(layer), "POWER_CUT": str(folder / "socket")}
    try:
        result = subprocess.run(
            words, cwd=ROOT, env={**os.environ, **own}, capture_output=True, text=True, timeout=120, check=False
        )
    finally:
        recorder.end()
    assert result.returncode == 0, result.stderr
    return recorder


@pytest.fixture(scope="module")
def recorded(layer, inputs, tmp_path_factory):
    """Function: scenario and fault -> what was seen; each program runs once."""
    patch = pytest.MonkeyPatch()
    patch.setattr("twin.operate.record.schema.WAIT", 0.1)
    yield cache(lambda *what: record_program(*what, layer, inputs, tmp_path_factory.mktemp("recorded")))
    patch.undo()


def check_all(scenario: str, recorder: Recorder, inputs: Path, folder: Path, **synced: bool) -> int:
    """Check every disk that a power cut may leave; return how many there are."""
    count, tried = 0, set()
    for count, (moment, steps, tree) in enumerate(disks(recorder, **synced), 1):
        kind = (steps, frozenset((name, content and not any(content)) for name, content in tree.items()))
        base = folder / str(count)
        base.mkdir(parents=True)
        for path, content in tree.items():
            (base / path).mkdir() if content is None else (base / path).write_bytes(content)
        try:
            SCENARIOS[scenario][1](base, inputs, steps, kind not in tried)
        except (Exception, pytest.fail.Exception) as error:
            raise AssertionError(f"{moment}, acknowledged {steps}: {sorted(tree)}: {error}") from error
        tried.add(kind)
        shutil.rmtree(base)
    return count


@pytest.fixture(autouse=True)
def quick_checks(monkeypatch) -> None:
    """The checks write nothing through: their disk is no one's."""
    monkeypatch.setattr(os, "fsync", lambda file: None)
    monkeypatch.setattr(replacing, "FILES", 2)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_what_was_acknowledged_outlives_a_power_cut(scenario, recorded, inputs, tmp_path) -> None:
    """At every moment what was acknowledged stands whole, all else is absent or refused, and the work goes on."""
    assert check_all(scenario, recorded(scenario, "none"), inputs, tmp_path) > 20


FAULTS = [
    ("record", "synchronous = OFF", {}),
    *((scenario, "none", {kind: False}) for scenario in SCENARIOS for kind in ("files", "folders")),
]
"""Program, what is planted in it, and what of that which it writes through is not."""


@pytest.mark.parametrize(("scenario", "fault", "synced"), FAULTS)
def test_a_missing_sync_is_noticed(scenario, fault, synced, recorded, inputs, tmp_path) -> None:
    """Without any one of the syncs, or with the name before them, a disk loses or doctors what was acknowledged."""
    with pytest.raises(AssertionError, match=r"moment .*, acknowledged"):
        check_all(scenario, recorded(scenario, fault), inputs, tmp_path, **synced)


def second_command(scenario: str, base: Path) -> str:
    """What is told to another command that begins meanwhile; nothing to one that clears up."""
    try:
        if scenario == "record":
            return invoke(app, "init", base / "record", "gf7_pair", "--simulated").stderr
        if scenario == "run":
            durable.sweep(base / "runs", remove_run)
        else:
            KeptWork(base / "out", "out", "samples", resume=True).begin()
    except RunFolderError as error:
        return str(error)
    return ""


LOCKED = {"record": (4, "database is locked"), "run": (3, ""), "kept": (4, "is in use by another command")}
"""At which sync another command begins, and what it says."""


@pytest.mark.parametrize("scenario", LOCKED)
def test_another_command_leaves_all_as_it_is(scenario, recorded) -> None:
    """A lock holds while a program writes: another command is refused meanwhile."""
    (heard,) = recorded(scenario, "none").heard
    assert LOCKED[scenario][1] in heard


@pytest.mark.parametrize("scenario", ["run", "kept"])
def test_a_missing_lock_is_noticed(scenario, recorded) -> None:
    """Without it the other command is not refused, or spoils the work."""
    with pytest.raises(AssertionError):
        assert LOCKED[scenario][1] in recorded(scenario, "no lock").heard[0]


if __name__ == "__main__":
    replacing.FILES = 2
    plant(sys.argv[4])
    SCENARIOS[sys.argv[1]][0](Path(sys.argv[2]), Path(sys.argv[3]))
