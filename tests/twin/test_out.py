"""The option --out of every command: a folder or a file that does not exist yet; what exists stays as it is."""

import importlib
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from docs.site.command_pages import ROOT, commands, programs

RUN = "needs a run or a record of other commands"
FIRST = {
    "twin.render": "scenes/examples/perturb.yaml",
    "twin.recover": RUN,
    **{f"twin.lab {name}": f"scenes/lab/{name}.yaml" for name in ("focus", "distortion", "turntable")},
    **{
        f"twin.orbit {name}": f"scenes/orbit/{name}.yaml"
        for name in ("angle", "calibrate", "jitter", "monitor", "simulate", "adjust")
    },
    **{f"twin.orbit {name}": RUN for name in ("check", "match", "export")},
    "twin.study": "scenes/examples/study_smoke.yaml",
    "twin.design camera": "scenes/examples/design_gf7_short.yaml",
    "twin.design monitor": "scenes/examples/design_monitor_two.yaml",
    "scenes.lens read": "tests/scenes/lens/files/none.seq",
    "scenes.lens new": "triplet",
    "scenes.lens write": "gf7",
    "scenes.schema": "",
    "twin.asbuilt estimate": "scenes/examples/asbuilt_gf7.yaml",
    "twin.asbuilt check": "scenes/examples/asbuilt_gf7.yaml",
    "twin.camera": "gf7",
    "twin.compare": RUN,
    "twin.export": RUN,
    "twin.new camera": "triplet",
    **{
        f"twin.new {kind}": "--camera gf7"
        for kind in ("job", "tolerance", "study", "asbuilt", "instrument", "operation")
    },
    "twin.operate simulate": "scenes/examples/operation.yaml --from 2027-01-01T00:00:00Z --days 2 --every 1d",
    **{f"twin.operate {name}": RUN for name in ("export", "products", "report", "judge")},
    "twin.tolerance": "scenes/examples/tolerance_cassegrain.yaml",
    "twin.uncertainty": "gf7_pair",
    "twin.validate": "--only 000",
}
"""Command -> its arguments before ``--out``, or the reason why it is not called here."""


def commands_with_out() -> Iterator[tuple[str, Any]]:
    """Yield the words and the parser of every command that has the option."""
    for program in programs():
        for words, command in commands(program).items():
            if any("--out" in parameter.opts for parameter in command.params):
                yield words, command


def app_of(program: str) -> typer.Typer:
    """Return the application of a program, as `twin.framework.console.parser` finds it."""
    module = importlib.import_module(program)
    module = importlib.import_module(f"{program}.__main__") if hasattr(module, "__path__") else module
    app: typer.Typer = getattr(module, "app", None) or typer.Typer(add_completion=False)
    if not hasattr(module, "app"):
        app.command()(module.main)
    return app


@pytest.mark.second
def test_out_is_one_option() -> None:
    """A path, a folder or a file by its help, and --force beside it, as docs/commands.md promises."""
    found = dict(commands_with_out())
    assert set(found) == set(FIRST)
    for words, command in found.items():
        options = {name: parameter for parameter in command.params for name in parameter.opts}
        metavar = options["--out"].metavar or ""
        assert metavar == "DIR" or metavar.startswith("FILE"), words
        assert "--force" in options, words
        assert "it exists" not in (options["--out"].help or ""), words


@pytest.mark.second
@pytest.mark.parametrize("words", [words for words, first in FIRST.items() if first != RUN])
def test_what_exists_stays(words: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    command = dict(commands_with_out())[words]
    program, _, below = words.partition(" ")
    metavar = next(parameter.metavar for parameter in command.params if "--out" in parameter.opts)
    target = tmp_path / {"DIR": "run", "FILE": "camera.zmx"}.get(metavar, "file.yaml")
    kept = target / "mine.txt" if metavar == "DIR" else target
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("mine", "utf-8")
    done = CliRunner().invoke(app_of(program), [*below.split(), *FIRST[words].split(), "--out", str(target)])
    assert done.exit_code == 2, done.output
    assert "exists" in done.output
    assert kept.read_text("utf-8") == "mine"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [kept]
