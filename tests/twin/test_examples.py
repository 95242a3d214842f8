"""Shipped jobs, and the one that the help of twin.render shows, give no warning."""

import re
import textwrap
from pathlib import Path

import pytest

from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from twin.framework.console import parser
from twin.main_job.render_job import render_job
from twin.main_job.verdict import judge

JOBS = ("aligned", "heat_soak", "image_quality", "launch", "orbit", "perturb", "steady", "targets")
"""Examples of the main job. Those of twin.asbuilt, design, operate, study and tolerance take minutes each."""


def test_no_job_is_forgotten() -> None:
    jobs = {file.stem for file in EXAMPLES.glob("*.yaml") if re.search(r"^render:", file.read_text("utf-8"), re.M)}
    assert jobs == set(JOBS)


def warnings_of(file: Path, backend) -> tuple[str, ...]:
    """Warnings of a job without the images of targets, which take most of the time and are not judged."""
    resolved = resolve(file)
    render = resolved.job.render.model_copy(update={"images": ("spots",), "targets": None})
    return judge(render_job(resolved.with_job(resolved.job.model_copy(update={"render": render})), backend)).warnings


@pytest.mark.second
@pytest.mark.parametrize("name", JOBS)
def test_an_example_gives_no_warning(backend, name: str) -> None:
    assert warnings_of(EXAMPLES / f"{name}.yaml", backend) == ()


@pytest.mark.second
def test_the_example_of_the_help_gives_no_warning(backend, tmp_path: Path) -> None:
    _, _, below = textwrap.dedent(parser("twin.render").help).partition("perturbation:\n")
    text, _, _ = below.partition("Every quantity")
    (tmp_path / "job.yaml").write_text(textwrap.dedent(text), "utf-8")
    assert "disturbances: launch" in text
    assert warnings_of(tmp_path / "job.yaml", backend) == ()
