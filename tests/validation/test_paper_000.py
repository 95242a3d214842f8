"""The checks of paper 000: what is compared with what, what comes out, and that only what is asked for runs."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml

from analysis.orbit.planes import Station, sensitivity
from optics.numerics.backend import load_backend
from scenes.specs.orbit.angle import LINES, usual_angles
from tests.analysis.test_planes import DEG, SCENE, Pass, descending_pass
from tests.validation.mutated import undrawn
from twin.validation.check import CORRECTED, REFUTED
from twin.validation.paper_000.results import SENTENCES, Answers, Sentence
from twin.validation.registry import GROUPS as ALL
from twin.validation.registry import select
from twin.validation.runner import run_checks

GROUPS = tuple(group for group in ALL if group.prefix.startswith("000"))
TRACED = ("000.traced", "000.centres")
"""Need an instrument traced, which takes longer than all others."""

FOUND = yaml.safe_load(Path(__file__).with_name("paper_000.yaml").read_text("utf-8"))


def checked(only, seed=3):
    with undrawn():
        return run_checks(select(GROUPS, only), load_backend("llvm"), seed, fast=True)


def test_every_check_is_listed():
    assert {check.id for group in GROUPS for check in group.checks} == {*FOUND, *TRACED}
    expected = {check.id: check.expected for group in GROUPS for check in group.checks}
    assert {name: verdict for name, (_, _, verdict) in FOUND.items()} == {name: expected[name] for name in FOUND}


@pytest.mark.second
def test_what_is_found():
    results = {r.id: r for r in checked(",".join(FOUND)).results}
    for identifier, (value, accuracy, verdict) in FOUND.items():
        result = results[identifier]
        assert result.verdict == verdict, identifier
        assert "cause is not known" not in result.how, identifier
        assert result.measured is None if value is None else result.measured == pytest.approx(value, abs=accuracy)


def false_on(scene: Pass, lines: Sequence[str] = LINES) -> set[Sentence]:
    """Sentences that do not hold for a pass made by hand, without the orbit of the library's test."""
    strips = dict(zip(lines, scene.strips(1.5), strict=True))
    found = Answers.of(sensitivity(Station.of(scene.station, 0.5), strips, usual_angles(LINES)))
    return {sentence for sentence in SENTENCES if not sentence.holds(found.rises, found.growth)}


@pytest.mark.second
@pytest.mark.parametrize("yaw", [True, False], ids=["yaw-steered", "inertial"])
def test_sentences_over_40_north_116_east(yaw):
    """Every sign and every ranking of the text, whatever the heading, but not what the checks expect to be wrong."""
    wrong = {s for s in SENTENCES if s.row.expected in (CORRECTED, REFUTED)}
    assert false_on(descending_pass(yaw=yaw)) == wrong
    assert len(wrong) == 3


@pytest.mark.second
@pytest.mark.parametrize(("lat", "lon"), [(45, 120), (40, 126), (48, 120)])
def test_farther_to_the_north_east_the_sentence_on_x_and_z_holds_too(lat, lon):
    """Which axes are alike depends on the place of the test field; the paper does not name it."""
    assert {s.kind for s in false_on(descending_pass(lat=lat * DEG, lon=lon * DEG))} == {"grows"}


def test_sentences_fail_elsewhere():
    """The southern hemisphere, and forward and backward points exchanged, contradict the paper."""
    assert "signs" in {s.kind for s in false_on(descending_pass(lat=-40 * DEG))}
    assert {s.kind for s in false_on(SCENE, LINES[::-1])} >= {"signs", "largest", "far"}
