"""Small edits of a prescription, a look, a position or a prism make another instrument of the same kind: it runs.

An edit of one part in a hundred is what a designer does all day. The facets of the central prism and the places of the
prisms follow from the traced beams, so that spots stay on the middle of their CCDs; what an edit does is to blur them.
"""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.solid import solid_mesh
from scenes.specs.resolved import resolve
from scenes.yaml.errors import InputError
from tests.daily import numbers
from tests.robustness.tree_edits import editable, holder, job_of, scaled, trees
from tests.tiers import quick
from twin.main_job.render_job import STAGES, render_job
from twin.monitor.monitor_experiment import MonitorExperiment

LIMIT = 0.01
"""Largest edit, relative; of a zero, relative to the values beside it."""

KEPT, NEW, TO_THE_FRAMES = range(12), 6, 10
"""Numbers of edits, and how many new ones; every so many of these go on to the calibration and the first images."""


class Stop(BaseException):
    """Far enough."""


def random_edit(number: int) -> tuple[str, dict[str, Any], dict[str, Any], str]:
    """The edit of that number, the same every time: instrument, both trees, and what was changed.

    One key, a few, or all of them; by anything up to the limit, or by orders of magnitude less.
    """
    chance = random.Random(f"edit {number}")
    name = ("gf7_pair", "monitor_pair")[number % 2]
    camera, instrument = trees(name)
    keys = editable(camera, instrument)
    size = chance.choice((LIMIT, LIMIT * 10.0 ** chance.uniform(-3.0, 0.0)))
    changes = []
    for file, key in chance.sample(keys, chance.choice((1, 1, 1, 2, 3, 5, len(keys)))):
        changes.append((file, key, size * chance.uniform(-1.0, 1.0)))
        scaled(camera if file == "camera" else instrument, key, changes[-1][2])
    text = ", ".join(f"{file} {'.'.join(map(str, key))} {change:+.3g}" for file, key, change in changes)
    return name, camera, instrument, text


def run_until(job: Path, backend, last: str) -> None:
    """The render command's own way up to a stage: files read, instrument built, nominal spots traced."""

    def advance(part: str, done: int, total: int) -> None:
        if part == last:
            raise Stop

    with pytest.raises(Stop):
        render_job(resolve(job), backend, advance=advance)


def outcome(number: int, folder: Path, backend) -> tuple[str, str]:
    """Whether an edit "runs", or the problem that it is refused for, and all that there is to say. Other exceptions
    get through.
    """
    name, camera, instrument, how = random_edit(number)
    job = job_of(folder, camera, instrument)
    try:
        run_until(job, backend, STAGES[5] if number % TO_THE_FRAMES == 0 else STAGES[3])
    except InputError as error:
        kind = error.issues[0].problem if well_told(error) else "badly told"
        return kind, f"edit {number} of {name} ({how}): {error}"
    return "runs", ""


def well_told(error: InputError) -> bool:
    """Whether it says where, what and what to do."""
    said = all(i.file and i.line and i.key and (i.allowed or "depends on" in i.problem) for i in error.issues)
    return said and "watertight" not in str(error)


@pytest.mark.parametrize("first", quick(0, [(0,), (1,)]))
def test_random_edits_run(first, tmp_path, backend) -> None:
    """None makes a job that cannot be rendered."""
    for number in KEPT[:2] if not first else numbers(KEPT[2:], NEW):
        assert outcome(number, tmp_path, backend) == ("runs", ""), number


NAMED = [("camera", "mirrors.M2.radius", 0.9e-4), ("instrument", "cameras.forward.look", "27 deg")]


@pytest.mark.second
@pytest.mark.parametrize(("file", "key", "change"), quick(1, NAMED), ids=[key for _, key, _ in NAMED])
def test_named_edits(file, key, change, tmp_path, backend) -> None:
    """Spots lie on the middle of their CCDs, and the central prism is a closed body of the volume that its facets give
    it, also where a wall is no more because the facets beside it go down to the bottom.
    """
    camera, instrument = trees("gf7_pair")
    tree = camera if file == "camera" else instrument
    keys = tuple(key.split("."))
    if isinstance(change, str):
        assert holder(tree, keys)[keys[-1]] != change
        holder(tree, keys)[keys[-1]] = change
    else:
        scaled(tree, keys, change)
    job = job_of(tmp_path, camera, instrument)
    run_until(job, backend, STAGES[3])
    experiment = MonitorExperiment(resolve(job), backend)
    places = experiment.path.coarse_trace([{}]).centre
    assert np.abs(places).max() < 0.1  # pixels; coma of the beam's edge against its middle
    block = experiment.instrument.solids[-1]
    mesh = solid_mesh(block, experiment.instrument.assembly.place()).mesh
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(_block_volume(experiment), rel=1e-3)


def _block_volume(experiment: MonitorExperiment) -> float:
    """Of the block under four facets that meet in its apex, by midpoints of columns: height where it is positive."""
    model = experiment.instrument
    spec, placed = model.spec.central_prism, model.assembly.place()
    count = 1000
    x, y = (2.0 * s * ((np.arange(count) + 0.5) / count * 2.0 - 1.0) for s in spec.spread)
    top = np.full((count, count), np.inf)
    for channel in model.channels:
        pose = placed.pose(channel.face_body)
        normal, point = pose.rotation[:, 2], pose.translation - np.array(spec.position)
        top = np.minimum(top, (point @ normal - x[:, None] * normal[0] - y * normal[1]) / normal[2])
    return float(np.mean(np.maximum(top + spec.height, 0.0)) * 16.0 * spec.spread[0] * spec.spread[1])


@pytest.mark.second
def test_focus_of_the_reference_is_where_its_plane_is(experiment, tmp_path, backend) -> None:
    """A plane 1 mm beside is 1 mm out of focus: pinhole and CCD go together, the image goes twice as far."""
    nominal = experiment("gf7_pair").nominal_focus
    assert np.all(nominal.error < 1e-3)
    camera, instrument = trees("gf7_pair")
    before = float(camera["image"]["z"].removesuffix(" m"))
    camera["image"]["z"] = f"{before - 1e-3!r} m"
    moved = MonitorExperiment(resolve(job_of(tmp_path, camera, instrument)), backend).nominal_focus
    # the focal plane's Z is the prescription's -z; the beam goes back through another part of the camera
    assert moved.defocus - nominal.defocus == pytest.approx(-1e-3, rel=2e-2)


def test_a_monitor_that_misses_says_by_how_much(tmp_path, backend, monkeypatch) -> None:
    """Facets that are not turned to their beams: which spot, how far off in pixels and mm, in which file.
    The job is not to blame, it perturbs nothing.
    """
    import scenes.models.monitor_chain

    monkeypatch.setattr(scenes.models.monitor_chain, "square_facets", lambda assembly, *_: assembly)
    camera, instrument = trees("gf7_pair")
    instrument["monitor"]["prism_180"]["angle_errors"] = {"roof_a": ["30 arcsec", "0 arcsec"]}
    with pytest.raises(InputError) as caught:
        render_job(resolve(job_of(tmp_path, camera, instrument)), backend)
    (issue,) = caught.value.issues
    assert issue.file.endswith("instrument.yaml")
    assert issue.key == ("monitor",)
    assert "does not work as designed" in issue.problem
    match = re.search(r"the spot (\w+/\w+) falls on row .*: ([\d.]+) px or ([\d.]+) mm beyond its edge", issue.problem)
    assert match is not None, issue.problem
    assert float(match[3]) == pytest.approx(0.012 * float(match[2]), rel=1e-2)  # pixels of 12 um, three digits
    assert "area_ccd" in issue.allowed
