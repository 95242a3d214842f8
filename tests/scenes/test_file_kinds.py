"""A file is told by its keys, whichever command it is given to."""

import importlib
from pathlib import Path

import pytest

from scenes.specs.file_kinds import file_kinds, kind_of, kinds_of, read_for
from scenes.specs.load import SCENES
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError, Issue
from scenes.yaml.yaml_file import read_yaml
from tests.twin.commands import invoke
from twin.design.__main__ import app as design
from twin.lab import app as lab
from twin.orbit.__main__ import app as orbit
from twin.render import app as render
from twin.study.__main__ import app as study

FOLDERS = dict(line.split() for line in Path(__file__).with_name("file_kinds.txt").read_text("utf-8").splitlines())
"""Beginning of a shipped file's place -> its kind."""
FILES = sorted(path.relative_to(SCENES).as_posix() for path in SCENES.rglob("*.yaml"))


@pytest.mark.second
def test_every_shipped_file_is_recognised() -> None:
    assert {kind.name for kind in file_kinds()} == set(FOLDERS.values())
    for file in FILES:
        expected = next(name for start, name in FOLDERS.items() if file.startswith(start))
        data = read_yaml(SCENES / file).data
        assert kind_of(data).name == expected, file
        # a typing error does not make it another one
        again = kind_of({**data, "no_such_key": 1})
        assert again is None or again.name == expected, file


def test_what_could_be_anything_is_nothing() -> None:
    for data in (None, 3, [], {}, {"name": "x"}, {"a": 1, "b": 2}, {"instrument": "x", "a": 1, "b": 2}):
        assert kind_of(data) is None, data


def test_a_file_of_either_of_two_kinds_is_told_as_either(tmp_path) -> None:
    """An instrument and its disturbances alone are a job as well as a plan of operation; both commands take it."""
    file = tmp_path / "either.yaml"
    file.write_text("instrument: gf7_pair\ndisturbances: launch\n")
    assert [kind.name for kind in kinds_of(read_yaml(file).data)] == ["job", "operation"]

    def own(_: Path) -> None:
        raise InputError(Issue("what the command says itself"))

    with pytest.raises(InputError, match=r"a job of the monitor or a plan of operation.*twin\.render .*twin\.operate"):
        read_for("twin.lab focus", file, own)
    for command in ("twin.render", "twin.operate status"):
        with pytest.raises(InputError, match="itself"):
            read_for(command, file, own)


def test_configs_of_runs_are_told_as_well() -> None:
    test = read_yaml(SCENES / "lab/focus.yaml").data
    found = [kind_of(data) for data in ({"job": {}, "cameras": {}}, {"study": {}, "base": {}}, {"test": test})]
    assert [kind and kind.name for kind in found] == ["job", "study", "focus_test"]


def test_the_commands_are_there() -> None:
    for kind in file_kinds():
        if kind.command:
            program, *sub = kind.command.split()
            try:
                app = importlib.import_module(f"{program}.__main__").app
            except ModuleNotFoundError:
                app = importlib.import_module(program).app
            names = {command.name or command.callback.__name__ for command in app.registered_commands}
            assert names >= set(sub), kind.name


# what is given to a command, what is said of it, and which command reads it
WRONG = [
    (render, "", "examples/study_smoke.yaml", "a study, which twin.render", "twin.study {} does"),
    (study, "", "examples/perturb.yaml", "a job of the monitor, which twin.study", "twin.render {} does"),
    (study, "--gradient", "lab/focus.yaml", "a focus test, which twin.study", "twin.lab focus {} does"),
    (lab, "focus", "lab/distortion.yaml", "which twin.lab focus", "twin.lab distortion {} does"),
    (orbit, "angle", "library/cameras/gf7.yaml", "a camera's prescription, which twin.orbit angle", "twin.camera {} d"),
    (
        design,
        "",
        "orbit/simulate.yaml",
        "images of the ground, which twin.design camera",
        "twin.orbit simulate {} does",
    ),
]


@pytest.mark.second
def test_a_file_given_to_the_wrong_command(tmp_path: Path) -> None:
    for app, words, file, what, other in WRONG:
        path = SCENES / file
        done = invoke(app, *words.split(), path, "--out", tmp_path / "run")
        assert (done.exit_code, done.stdout) == (2, "")
        assert done.stderr.startswith(f"error: {path}: this is ")
        assert f"{what} does not read; python -m {other.format(path)}" in done.stderr
        assert not (tmp_path / "run").exists()


def test_an_own_file_with_faults_is_told_its_faults(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("instrument: gf7_pair\npertrub: {}\n", "utf-8")
    with pytest.raises(InputError, match="did you mean 'perturb'"):
        read_for("twin.render", path, resolve)
    path.write_text("instrument: gf7_pair\nperturb: [\n", "utf-8")
    with pytest.raises(InputError, match="not valid YAML"):
        read_for("twin.render", path, resolve)
