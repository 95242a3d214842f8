"""Files and folders on the command line that are not what they should be."""

import os
from pathlib import Path

import pytest

from tests.robustness.case import cut
from tests.robustness.spoilt_run import limited, listing
from tests.tiers import quick
from tests.twin.commands import invoke
from twin.design.__main__ import app as design
from twin.lab import app as lab
from twin.orbit.__main__ import app as orbit
from twin.render import app as render
from twin.study.__main__ import app as study

COMMANDS = {
    "render": (render,),
    "design": (design,),
    "study": (study,),
    "lab": (lab, "focus"),
    "orbit": (orbit, "angle"),
}
EXAMPLE = Path(__file__).parents[2] / "scenes/examples/perturb.yaml"
FILES = (
    *("missing.yaml", "", ".", "..", "/", "/dev/zero", "/dev/stdin", "/proc/self/mem", "/etc/shadow", "folder", "fifo"),
    *("loop", "a\0b", "a\nb", "\x1b[31mred", "[red]x[/red]", "[/]", "n" * 5000, "file/below", "~", "{x}", "%s"),
    *("\udcff", "😀", "empty"),
)
OUTS = (
    *("file", "file/below", "folder", "loop", "fifo", "a\0b", "n" * 5000, "/proc/x", "/dev/null", "/dev/null/x", "."),
    *("..", "/", ""),
)


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").touch()
    (tmp_path / "file").write_text("x: 1\n")
    (tmp_path / "empty").touch()
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "fifo")
    return tmp_path


@pytest.mark.parametrize("command", quick(1, COMMANDS))
def test_the_file(command, here) -> None:
    app, *words = COMMANDS[command]
    before = listing(here)
    for file in FILES:
        with cut(soon=True), limited(10.0):
            result = invoke(app, *words, file)
        assert (result.exit_code, result.stdout) == (2, ""), ascii(file)
        assert not any(ord(c) < 32 and c != "\n" for c in result.stderr), ascii(file)
        assert listing(here) == before, ascii(file)


@pytest.mark.second
def test_the_run_folder(here) -> None:
    before = listing(here)
    for out in OUTS:
        for force in ((), ("--force",)):
            with cut(soon=True), limited(10.0):
                result = invoke(render, EXAMPLE, "--out", out, *force, "--quiet")
            assert result.exit_code == 2, ascii(out)
            # what is no path at all is refused by the command line's reader
            assert result.stderr.startswith("error: ") or "\0" in out, result.stderr
            assert listing(here) == before, ascii(out)
