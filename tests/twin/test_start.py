"""What a command imports before it can say anything: help and completion nothing that computes, draws or reads files,
a bad file only the models of its own kind.

Which modules are loaded is the same on every machine; how long it takes is in tests/benchmarks/start_speed.py.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenes.kinds.file_kinds import FILE_KINDS
from scenes.yaml.spec import Spec
from tests.twin.study_bench import ROOT
from twin.run.console import PROGRAMS

HEAVY = {
    *("cv2", "dask", "distributed", "drjit", "erfa", "h5netcdf", "h5py", "jinja2", "matplotlib", "mitsuba", "networkx"),
    *("pandas", "pyproj", "scipy", "skfem", "sklearn", "sqlalchemy", "tifffile", "trimesh", "xarray"),
}
"""Packages that take a tenth of a second or more to import."""
TOLD = """
import json, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
{before}
print(json.dumps({{"modules": sorted(sys.modules), **globals().get("more", {{}})}}))
"""


def loaded(before: str, *words: object) -> dict[str, Any]:
    """What a process has loaded after these lines of Python.

    Args:
        before: the lines.
        words: its arguments.
    """
    command = [sys.executable, "-c", TOLD.format(before=before), *map(str, words)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=120, env=os.environ)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def packages(modules: Sequence[str]) -> set[str]:
    return {module.partition(".")[0] for module in modules}


def test_help_waits_for_nothing_that_computes_or_reads() -> None:
    """The parsers of all programs: what --help and a shell's completion need."""
    # last the schemas, whose generator is pydantic's
    names = sorted((module for module, _ in PROGRAMS.values()), key=lambda name: name == "scenes.schema")
    found = loaded(
        f"from twin.run.console import parser\nfor name in {names}:\n"
        " more = {'pydantic': 'pydantic' in sys.modules}\n parser(name)"
    )
    assert {"typer", "twin.run.cli", "twin.study.__main__", "analysis.mtf.__main__"} <= set(found["modules"])
    assert (packages(found["modules"]) & HEAVY, found["pydantic"]) == (set(), False)


BAD = {
    "twin.render": ("", "instrument: gf7_pair\nno_such_key: 1\n"),
    "twin.lab": ("focus", "name: x\nmisset: {}\nscan: {}\nno_such_key: 1\n"),
    "twin.orbit.__main__": ("angle", "name: x\ncamera: tlc\norbit: {}\nstrips: []\nno_such_key: 1\n"),
    "twin.study.__main__": ("", "name: x\nbase: {}\nfactors: {}\nresponses: {}\nno_such_key: 1\n"),
    "twin.tolerance.__main__": ("", "instrument: gf7\ntolerances: {}\nmerits: {}\nno_such_key: 1\n"),
    "twin.design.__main__": ("", "name: x\ncamera: gf7\nvary: {}\nno_such_key: 1\n"),
    "twin.recover.__main__": ("", "frames: {}\nno_such_key: 1\n"),
}
"""Program -> its subcommand, and a file of its kind with a key that it does not know."""
REFUSED = """
import importlib
more = {}
for program, words in json.loads(sys.argv[1]):
    with redirect_stderr(StringIO()) as told, redirect_stdout(StringIO()):
        try: importlib.import_module(program).app(words)
        except SystemExit as end: code = end.code
    more[program] = [code, told.getvalue(), sorted({name.partition(".")[0] for name in sys.modules})]
"""


def test_a_bad_file_waits_for_nothing_that_computes(tmp_path: Path) -> None:
    runs = []
    for program, (sub, text) in BAD.items():
        file = tmp_path / f"{program}.yaml"
        file.write_text(text, "utf-8")
        runs.append((program, [*sub.split(), str(file)]))
    found = loaded(REFUSED, json.dumps(runs))
    for program, (_, text) in BAD.items():
        code, told, there = found[program]
        line = text.count("\n")
        assert (code, set(there) & HEAVY) == (2, set()), (program, told)
        assert f"{program}.yaml:{line}: no_such_key: unknown key; found 'no_such_key'" in told


def test_a_bad_job_waits_for_no_other_kind_of_file(tmp_path: Path) -> None:
    """Nor is a model built that it does not need."""
    file = tmp_path / "job.yaml"
    file.write_text(BAD["twin.render"][1], "utf-8")
    found = loaded(
        REFUSED + "from scenes.yaml.spec import Spec\n"
        "def below(model):\n return [model, *(one for part in model.__subclasses__() for one in below(part))]\n"
        "more['built'] = [model.__name__ for model in below(Spec) if model.__pydantic_complete__]",
        json.dumps([("twin.render", [str(file)])]),
    )
    modules = set(found["modules"])
    assert "scenes.specs.job" in modules
    kinds = {kind.described.partition(":")[0] for kind in FILE_KINDS}
    assert not {name for name in modules & kinds if name.startswith(("scenes.specs.orbit", "scenes.specs.measured"))}
    assert not modules & {"scenes.specs.study", "scenes.specs.tolerance", "scenes.specs.operation"}
    assert "JobSpec" in found["built"]
    assert not {"InstrumentSpec", "CameraSpec", "DisturbancesSpec"} & set(found["built"])


def test_import_twin_imports_nothing() -> None:
    found = loaded("import twin")["modules"]
    assert packages(found) & (HEAVY | {"numpy", "pydantic", "rich", "ruamel", "typer"}) == set()


def test_a_kind_is_told_by_keys_that_its_model_requires() -> None:
    """`FileKind.needs` is looked at before the model is imported, so it must say no more than the model does."""
    for kind in FILE_KINDS:
        assert issubclass(kind.model, Spec)
        required = {name for name, item in kind.model.model_fields.items() if item.is_required()}
        assert kind.needs, kind.name
        assert set(kind.needs) <= required, kind.name
