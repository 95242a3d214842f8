"""The wheel: all packages within one name, whatever else is installed under `optics` and `analysis`; the script in the
README and the main job run from it as from the source tree.
"""

import ast
import importlib.util
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.test_safe_path import folder_of_traps, hits
from twin.framework.provenance import program_digest

ROOT = Path(__file__).resolve().parent.parent
_FOUND = importlib.util.spec_from_file_location("wheel_backend", ROOT / "docs/wheel/wheel_backend.py")
backend = importlib.util.module_from_spec(_FOUND)
_FOUND.loader.exec_module(backend)
FILES = [path for package in backend.PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


# --- what is rewritten -----------------------------------------------------------------------------------


LOOK_FOR = "import_module", "files", "run_module", "find_spec"
"""Functions that look for a module by its name."""


def names_of_ours(text: str) -> list[str]:
    """Modules of the source tree that a module asks for by name: imported, or as text where a module is looked for."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            found.append(node.module or "")
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in LOOK_FOR:
            found += [one.value for one in node.args if isinstance(one, ast.Constant)]
        elif isinstance(node, ast.List | ast.Tuple):
            words = [one.value if isinstance(one, ast.Constant) else "" for one in node.elts]
            found += [after for word, after in itertools.pairwise(words) if word == "-m"]
    return [name for name in found if str(name).partition(".")[0] in backend.PACKAGES]


@pytest.mark.second
def test_no_module_of_a_wheel_asks_for_one_outside_of_it() -> None:
    asked = 0
    for path in FILES:
        source = path.read_text("utf-8")
        made = backend.rewritten(source)
        asked += made.count(f"{backend.PREFIX}.")
        assert names_of_ours(made) == [], path
        # what the digest of the program relies on
        assert made.replace(f"{backend.PREFIX}.", "") == source, path
    assert asked > 3000


def test_what_is_rewritten() -> None:
    for text, made in (
        ("from optics.waves import x\n", "from space_camera_twin.optics.waves import x\n"),
        ("import os, twin.study as s\n", "import os, space_camera_twin.twin.study as s\n"),
        ("if 1:\n    from scenes import b\n", "if 1:\n    from space_camera_twin.scenes import b\n"),
        ("from opticsandmore import twin\n", "from opticsandmore import twin\n"),
        ('"python -m twin.render F"\n', '"python -m space_camera_twin.twin.render F"\n'),
        ('f"python -m {program} F"\n', 'f"python -m space_camera_twin.{program} F"\n'),
        ('"twin.render"\n', '"twin.render"\n'),
    ):
        assert backend.rewritten(text) == made
    with pytest.raises(ValueError, match="line 1: import optics"):
        backend.rewritten("import optics.waves\noptics.waves.f()\n")


def test_the_citation_and_the_changelog_have_the_version() -> None:
    assert f"\nversion: {version()}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.search(rf"^## {re.escape(version())}\b", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)


# --- what is installed -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel and foreign packages of the same names; what it needs comes from this one."""
    place = tmp_path_factory.mktemp("wheel")
    source = place / "source"  # building leaves its own files there, and then it goes
    for name in (*backend.PACKAGES, "docs/wheel"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", place / "dist", source]
    subprocess.run(build, check=True, cwd=place)
    shutil.rmtree(source)
    (wheel,) = (place / "dist").glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place / "venv"], check=True)
    python = place / "venv/bin/python"
    subprocess.run([*pip, "--python", python, "install", "--no-deps", wheel], check=True, cwd=place)
    (site,) = (place / "venv/lib").glob("python*/site-packages")
    # .pth files of that folder are not read, so that an editable installation there is not seen
    (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n", "utf-8")
    for name in backend.PACKAGES:
        (site / name).mkdir()
        (site / name / "__init__.py").write_text("raise ImportError('of other people')\n", "utf-8")
    return site


def run(site: Path, folder: Path, *words: object) -> subprocess.CompletedProcess:
    environment = os.environ | {"MPLBACKEND": "agg"}
    for name in ("PYTHONPATH", "PYTHONSAFEPATH"):
        environment.pop(name, None)
    program = site.parents[2] / "bin" / str(words[0])
    command = [program, *map(str, words[1:])]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


@pytest.mark.second
def test_commands_of_the_wheel_run_beside_foreign_packages_of_their_names(installed: Path, tmp_path: Path) -> None:
    """With every file of the library, every template, and the examples that their help names; of the folder where they
    are started neither they nor their second process and workers run anything.
    """
    assert run(installed, tmp_path, "python", "-c", "import optics").returncode == 1
    script = "from space_camera_twin import twin; print(twin.load('gf7_pair').jacobian(['base/forward/M2 shift z']))"
    done = run(installed, tmp_path, "python", "-c", script)
    assert done.returncode == 0, done.stderr
    own = installed / backend.PREFIX
    kept = ("yaml", "csv", "zmx", "j2", "css", "html", "js", "typed", "py")
    files = [path.relative_to(ROOT) for name in backend.PACKAGES for path in (ROOT / name).rglob("*.*")]
    files = [path for path in files if path.suffix[1:] in kept]
    assert len(files) > 400
    assert [path for path in files if not (own / path).is_file()] == []
    assert run(installed, tmp_path, "python", "-m", f"{backend.PREFIX}.scenes.lens", "--help").returncode == 0
    folder_of_traps(tmp_path)
    job = own / "scenes/examples/perturb.yaml"
    done = run(installed, tmp_path, "camtwin", "render", job, "--out", "a", "--frames", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "a/report.html").is_file()
    manifest = json.loads((tmp_path / "a/manifest.json").read_text("utf-8"))
    assert (manifest["program"], manifest["versions"]["space-camera-twin"]) == ("twin.render", version())
    assert manifest["provenance"]["source"] == program_digest()
    # with processes of its own
    study = ("study", own / "scenes/examples/study_smoke.yaml", "--workers", "1", "--yes", "--quiet", "--out", "s")
    done = run(installed, tmp_path, "camtwin", *study)
    assert done.returncode == 0, done.stdout + done.stderr
    assert hits(tmp_path) == ""
    told = run(installed, tmp_path, "camtwin", "--version").stdout
    assert told == f"camtwin {version()} from {own}\n"


def version() -> str:
    (found,) = re.findall(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text("utf-8"), re.M)
    return found
