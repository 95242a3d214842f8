"""Which parts of a perturbation a statement does not hold."""

from pathlib import Path

import pytest

from scenes.models.disturbances import stated_motions
from scenes.models.job_state import LIKELY, beyond_statement
from scenes.specs.resolved import resolve


@pytest.fixture
def beyond(tmp_path: Path, gf7_pair):
    """Function: perturbation and statement as YAML -> texts of what is beyond it."""

    def texts(perturb: str, disturbances: str = "launch") -> list[str]:
        job = tmp_path / "job.yaml"
        job.write_text(f"instrument: gf7_pair\nperturb: {perturb}\ndisturbances: {disturbances}\n", "utf-8")
        resolved = resolve(job)
        return [e.text for e in beyond_statement(resolved, stated_motions(resolved, gf7_pair))]

    return texts


def test_amounts_are_held_against_those_stated(beyond) -> None:
    # launch states 1.5 um and 5 nm of a mirror, 2 K of the base, nothing of a line and of Z22
    assert (
        beyond("{base/forward/M2: {shift: [0 um, -6 um, 5.9 um], figure: {Z7: 19 nm}}, base: {temperature: 8 K}}") == []
    )
    assert beyond("{base/forward/M2: {shift: [0 um, -6.1 um, 3 um], figure: {Z22: 1 nm}}}") == [
        "base/forward/M2 shift y (-6.1 um, stated 1.5 um)",
        "base/forward/M2 figure Z22 (1 nm, not stated)",
    ]
    assert beyond(
        "{base/forward/focal_plane/line: {rotate: [0 arcsec, 0 arcsec, 1 arcsec]}, base/forward: {scale: 1 ppm}}"
    ) == ["base/forward/focal_plane/line rotate z (1 arcsec, not stated)"]
    assert beyond("{base/forward/M2: {temperature: 1 K}}") == ["base/forward/M2 temperature (1 K, not stated)"]


def test_causes_of_one_component_add_up(beyond) -> None:
    more = "{file: launch, causes: {shock: {bodies: base/*/M2, shift: 8 um, time: constant, reason: a test}}}"
    sigma = (1.5**2 + 8.0**2) ** 0.5
    for times, count in ((0.99, 0), (1.01, 1)):
        assert len(beyond(f"{{base/forward/M2: {{shift: [{times * LIKELY * sigma} um, 0 um, 0 um]}}}}", more)) == count


def test_without_a_statement_everything_is_beyond(beyond) -> None:
    assert beyond("{base/forward/M2: {shift: [0 um, 0 um, 1 nm]}}", "none") == [
        "base/forward/M2 shift z (0.001 um, not stated)"
    ]
