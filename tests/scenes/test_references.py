"""A reference is read alike by every command: the library's name, a file, or the mapping itself."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scenes.specs.load import EXAMPLES, SCENES, load_error_budget
from scenes.specs.operation import read_operation
from scenes.specs.procedures import PROCEDURES
from scenes.specs.resolved import resolve, resolve_budget, resolve_on
from scenes.yaml.spec import Spec
from scenes.yaml.yaml_file import dump_yaml, read_yaml
from tests.scenes.refusals.readers import measurement
from twin.operate.record.entries import digest_of_job
from twin.operate.record.telemetry import read_telemetry


def telemetry(path: Path) -> Any:
    """The file's instrument, after the check against a record of the pair."""
    bodies: dict[str, None] = {"warm": None, "cameras": None}
    digest = digest_of_job(resolve(EXAMPLES / "perturb.yaml"))
    history: Any = SimpleNamespace(sha256=digest, name="gf7_pair", bodies=bodies)
    spec = read_telemetry(path, history)
    return resolve_on(spec, spec.instrument)


def frames(path: Path) -> Any:
    """Measured frames that are made beside the file."""
    path.write_text(re.sub("(?m)^frames: .*", "frames: frames.csv", path.read_text("utf-8")), "utf-8")
    return measurement(path.parent, lambda name: None)(path)


READERS: dict[str, Callable[[Path], Any]] = {
    **{name: procedure.resolve for name, procedure in PROCEDURES.items()},
    "render": resolve,
    "instrument": lambda path: resolve_on(Spec(), str(path)),
    "recover": frames,
    "operate": read_operation,
    "operate ingest": telemetry,
    "validate": lambda path: resolve_budget(load_error_budget(path)),
}
"""Beginning of a row of the table -> what reads its file."""
ROWS = [line.split(" | ") for line in Path(__file__).with_name("references.txt").read_text("utf-8").splitlines()]
FOLDERS = ("library/[!b]*", "lab")


def written(folder: Path, file: Path, key: str, form: str) -> tuple[Path, str]:
    """A file whose reference at a key has another form, and what it refers to."""
    folder.mkdir()
    shutil.copytree(file.parent, folder / "copy") if file.parent.name == "measured" else (folder / "copy").mkdir()
    data = read_yaml(file).data
    *way, last = (int(part) if part.isdigit() else part for part in key.split("."))
    owner: Any = data
    for part in way:
        owner = owner[part]
    name = owner[last]
    (referred,) = (
        one for place in FOLDERS for one in SCENES.glob(f"{place}/{name}.yaml") if "budgets" not in one.parts
    )
    shutil.copy(referred, folder / "own.yaml")
    own = "../own.yaml"
    owner[last] = {"name": name, "file": own, "camera": {"camera": own}, "mapping": read_yaml(referred).data}[form]
    path = folder / "copy/it.yaml"
    path.write_text(dump_yaml(data), "utf-8")
    return path, name


@pytest.mark.parametrize(
    ("name", "file", "key"), [(name, file, key) for name, file, keys in ROWS for key in keys.split()]
)
def test_every_form_of_a_reference_is_read_alike(name: str, file: str, key: str, tmp_path: Path) -> None:
    reader, found = READERS[max((one for one in READERS if name.startswith(one)), key=len)], []
    camera = ["camera"] if key in ("instrument", "camera", "design") else []
    for k, form in enumerate(("name", "file", "mapping", *camera)):
        path, referred = written(tmp_path / str(k), SCENES / file, key, form)
        text = dump_yaml(reader(path).plain()).replace(str(tmp_path / str(k)), "")
        found.append(re.sub(r"[^\s\[\],]*own\.yaml", referred, text))
    assert found == [found[0]] * len(found)
