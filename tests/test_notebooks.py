"""The notebooks of docs/notebooks run as they are, each in less than a minute, and are kept without their outputs."""

import os
import resource
from datetime import UTC, datetime
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
LONG = ("heat", "orbit_calibration", "targets_mtf", "trade_study")
"""Twenty seconds to a minute each: another one every day."""
MOST_SECONDS = 60.0
"""Of the processor, all processes together, with kernels compiled; not on the clock, for a machine may be busy."""


def test_there_are_six() -> None:
    assert len(NOTEBOOKS) == 6
    assert {path.stem for path in NOTEBOOKS} > set(LONG)


@pytest.mark.second
@pytest.mark.parametrize("path", [path for path in NOTEBOOKS if path.stem not in LONG] + [None])
def test_a_notebook_runs(path: Path | None, monkeypatch: pytest.MonkeyPatch) -> None:
    today = LONG[datetime.now(UTC).toordinal() % len(LONG)]
    path = path or ROOT / f"docs/notebooks/{today}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    assert notebook.cells[0].source.startswith("# ")
    inherited = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(ROOT), inherited))))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    # in a folder of its own: a notebook needs nothing but the package
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": "/tmp"}}).execute()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert 0.5 < used < MOST_SECONDS, f"{used:.0f} s"
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    errors = [output.text for cell in code for output in cell.outputs if output.get("name") == "stderr"]
    assert not errors
