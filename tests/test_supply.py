"""Lock files, bill of materials, licences and known vulnerabilities: complete, and refusing what is not."""

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.markers import Marker, default_environment
from packaging.requirements import Requirement

from docs.supply.__main__ import findings
from docs.supply.licences import read_carried, read_table
from docs.supply.lock_file import FOLDER, LAYERS, LockError, normal, parse, read_layer, read_lock
from docs.supply.make_lock import EXTRAS, SupplyError

ROOT = Path(__file__).resolve().parent.parent
PROJECT = "space-camera-twin"
LOCK = {layer: read_layer(layer) for layer in LAYERS}
PYTHONS = ("3.11.2", "3.11.7", "3.12.3", "3.13.5")
"""Debian 12's, the one of the tests, Ubuntu 24.04's and Debian 13's."""


def installed(layers: tuple[str, ...], python: str) -> dict[str, str]:
    """Name -> version of what these layers install on Linux with this Python; no name with two versions."""
    here = default_environment() | {"python_version": python.rpartition(".")[0], "python_full_version": python}
    out: dict[str, str] = {}
    for layer in layers:
        for p in LOCK[layer]:
            if not p.marker or Marker(p.marker).evaluate(here):
                assert out.setdefault(p.name, p.version) == p.version, p.name
    return out


def direct(extras: tuple[str, ...] | None) -> list[str]:
    """Requirements of pyproject.toml itself, with those of extras; None for all of them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    optional = project["optional-dependencies"]
    named = optional if extras is None else extras
    return [*project["dependencies"], *(line for name in named for line in optional[name])]


@pytest.mark.second
def test_every_requirement_is_locked_at_the_version_where_its_range_begins() -> None:
    for layer, python in itertools.product(EXTRAS, PYTHONS):
        have = installed(LAYERS[: LAYERS.index(layer) + 1], python)
        wanted = [Requirement(line) for line in direct(EXTRAS[layer])]
        assert len(wanted) > 30
        minor = {"python_version": python[:4], "platform_machine": "x86_64", "sys_platform": "linux"}
        for one in wanted:
            if one.marker is None or one.marker.evaluate(minor):
                assert one.specifier.contains(have[normal(one.name)]), one
                assert f">={have[normal(one.name)]}" in str(one.specifier).split(","), one


def test_nothing_else_is_locked() -> None:
    """Every package is asked for by the project, or by another one that its own layer or one before it has."""
    for layer in EXTRAS:
        before = {p.name: p for name in LAYERS[: LAYERS.index(layer) + 1] for p in LOCK[name]}
        own = {normal(Requirement(line).name) for line in direct(EXTRAS[layer])}
        reached, left = set(own), set(before)
        while left:
            more = {name for name in left if name in own or reached & set(before[name].asked_by)}
            if not more:
                break
            reached |= more
            left -= more
        assert left <= {p.name for p in LOCK["install"]}
        assert own <= reached
    for layer in ("install", "peers"):
        listed = [
            Requirement(line) for line in (FOLDER / f"{layer}.in").read_text("utf-8").splitlines() if "==" in line
        ]
        assert {(normal(r.name), str(r.specifier)) for r in listed} == {(p.name, f"=={p.version}") for p in LOCK[layer]}


def test_a_lock_file_that_is_none_is_refused() -> None:
    for text, told in (
        ("numpy==2.4.6\n", "x:1: numpy has no hash"),
        ("numpy==2.4.6 \\\n    --hash=sha256:12\n", "x:2: not a hash"),
        ("numpy>=2\n", "x:1: not a pinned package"),
        ("--index-url https://index.example/simple\n", "x:1: not a pinned package"),
        ("numpy @ file:///tmp/numpy.whl\n", "x:1: not a pinned package"),
    ):
        with pytest.raises(LockError, match=re.escape(told)):
            parse(text, "runtime", "x")


def forged(folder: Path, name: str, version: str) -> None:
    """A wheel that can be installed, with other contents than the locked one."""
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as wheel:
        info = f"{name}-{version}.dist-info"
        wheel.writestr(f"{name}/__init__.py", "raise SystemExit('forged')\n")
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: x\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")


@pytest.mark.second
def test_setup_refuses_another_file_than_the_locked_one(tmp_path: Path) -> None:
    project, index = tmp_path / "project", tmp_path / "index"
    (project / "docs/supply").mkdir(parents=True)
    index.mkdir()
    shutil.copytree(FOLDER, project / "docs/supply/lock")
    for name in ("setup.sh", "pyproject.toml"):
        shutil.copy(ROOT / name, project)
    for p in LOCK["install"]:
        forged(index, p.name, p.version)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PIP_")}
    environment |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(index), "PYTHON": sys.executable}
    environment["PIP_CONFIG_FILE"] = os.devnull
    how = {"capture_output": True, "text": True, "timeout": 300}
    done = subprocess.run(["bash", "setup.sh"], cwd=project, env=environment, check=False, **how)
    assert done.returncode == 1
    assert "DO NOT MATCH THE HASHES" in done.stderr
    assert "Do not install that file" in done.stderr
    assert not (project / ".venv/installed").exists()
    assert list(project.glob(".venv/lib/*/site-packages/pip-26.3*")) == []


def test_setup_names_the_packages_that_an_administrator_installs(tmp_path: Path) -> None:
    """With a Python without its venv module, and no right to use apt."""
    for name in ("bash", "dirname", "echo", "id", "uname", "xargs"):
        (tmp_path / name).symlink_to(shutil.which(name))
    python = tmp_path / "python"
    python.write_text(f'#!{shutil.which("sh")}\n[ "$2" != "import venv, ensurepip" ] && exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    environment = {"PATH": str(tmp_path), "PYTHON": str(python)}
    done = subprocess.run(["bash", ROOT / "setup.sh"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "setup: python3-venv missing; an administrator installs it with" in done.stderr
    assert "apt-get install python3-venv" in done.stderr


@pytest.mark.second
def test_every_locked_package_has_its_licence() -> None:
    rows = read_table()
    assert len(rows) == len({(row.package, row.version) for row in rows})
    assert {(row.package, row.version) for row in rows} == {(p.name, p.version) for p in read_lock()}
    assert {row.copyleft for row in (*rows, *read_carried())} == {"no", "weak", "strong"}
    # of what the twin needs, as docs/installed.md says
    names = {row.package for row in rows if row.for_ in ("install", "runtime", "live")}
    assert {row.package for row in rows if row.copyleft == "strong"} == set()
    assert {inner.package for inner in read_carried() if inner.copyleft == "strong"} & names == set()
    assert {inner.package for inner in read_carried()} <= {row.package for row in rows}
    pytest.importorskip("license_expression")
    from docs.supply.licences import copyleft, spdx

    for row in (*rows, *read_carried()):
        assert row.copyleft == copyleft(row.licence), row
        named = row.licence.replace("LicenseRef-Public-Domain", "CC0-1.0")
        assert spdx().parse(named, validate=True, strict=True) is not None


@pytest.mark.second
def test_the_bill_of_materials_lists_every_locked_package() -> None:
    layers = ("install", "live")
    pytest.importorskip("cyclonedx")
    from docs.supply.sbom import bill

    text = bill(layers)  # checks itself against the schema
    assert text == bill(layers)
    made = json.loads(text)
    assert made["specVersion"] == "1.6"
    parts = {(part["name"], part["version"]): part for part in made["components"]}
    every = read_lock(layers=layers)
    assert set(parts) == {(p.name, p.version) for p in every}
    for p in every:
        part = parts[p.name, p.version]
        assert part["purl"] == f"pkg:pypi/{p.name}@{p.version}"
        assert {one["content"] for one in part["hashes"]} == set(p.hashes)
        assert part["licenses"]
    needs = {one["ref"]: one.get("dependsOn", []) for one in made["dependencies"]}
    assert "pkg:pypi/starlette@1.10.0" in needs[PROJECT]
    assert "pkg:pypi/h11@0.16.0" in needs["pkg:pypi/uvicorn@0.54.0"]
    assert {ref for refs in needs.values() for ref in refs} <= {part["bom-ref"] for part in made["components"]}
    assert str(ROOT) not in text


GOOD = {"name": "a", "version": "1", "vulns": []}
BAD = {
    "name": "b",
    "version": "2",
    "vulns": [{"id": "PYSEC-1", "fix_versions": ["3"], "aliases": [], "description": ""}],
}
SKIPPED = {"name": "c", "skip_reason": "Dependency not found on PyPI and could not be audited: c (3)"}


def test_known_vulnerabilities_are_told_and_what_was_not_checked_is_no_good_news() -> None:
    assert findings(json.dumps({"dependencies": [GOOD], "fixes": []})) == (1, [])
    assert findings(json.dumps({"dependencies": [GOOD, BAD], "fixes": []})) == (2, ["b 2: PYSEC-1; mended in 3"])
    with pytest.raises(SupplyError, match="no answer for 1 of 2 packages: c"):
        findings(json.dumps({"dependencies": [GOOD, SKIPPED], "fixes": []}))
    with pytest.raises(SupplyError, match="0 of 0"):
        findings(json.dumps({"dependencies": [], "fixes": []}))
