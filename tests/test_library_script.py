"""The script in the README runs as printed, from the installed wheel, where the source tree is not."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def printed_script() -> str:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert len([line for line in block.splitlines() if line]) <= 10
    return block


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the wheel's files and nothing else; what it needs comes from this environment."""
    place = tmp_path_factory.mktemp("wheel")
    source = place / "source"  # building leaves its own files there, and then it goes
    for name in ("optics", "scenes", "analysis", "twin"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", place / "dist", source]
    subprocess.run(build, check=True, cwd=place)
    shutil.rmtree(source)
    (wheel,) = (place / "dist").glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", place / "site", wheel], check=True, cwd=place)
    return place / "site"


def run(site: Path, folder: Path, *words: object) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(site), "MPLBACKEND": "agg"}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


@pytest.mark.slow
def test_the_printed_script_runs(installed: Path, tmp_path: Path) -> None:
    tail = "assert runs.sizes['run'] == 100 and not runs.failed.any()\nassert twin.__file__.startswith({!r})\n"
    script = tmp_path / "script.py"
    script.write_text(printed_script() + tail.format(str(installed)))
    done = run(installed, tmp_path, script)
    assert done.returncode == 0, done.stderr
    assert re.search(r"d_f_um +-1\.210", done.stdout)


@pytest.mark.slow
def test_commands_of_the_wheel_run(installed: Path, tmp_path: Path) -> None:
    """With every file of the library, every template, and the examples that their help names."""
    examples = [path.relative_to(ROOT) for path in (ROOT / "scenes").rglob("*.yaml")]
    assert len(examples) > 20
    assert [path for path in examples if not (installed / path).is_file()] == []
    templates = [path.relative_to(ROOT) for kind in ("j2", "css") for path in (ROOT / "twin").rglob(f"*.{kind}")]
    assert len(templates) > 4
    assert [path for path in templates if not (installed / path).is_file()] == []
    job = installed / "scenes/examples/perturb.yaml"
    for words in (("twin.render", job, "--out", "a"), ("twin.compare", "a", "a", "--out", "b")):
        done = run(installed, tmp_path, "-m", *words)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "a/report.html").is_file()
    assert (tmp_path / "b/report.html").is_file()
