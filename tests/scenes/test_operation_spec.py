"""Plans of operation: what they say, what is told of a mistake, and the shipped one on both instruments."""

from pathlib import Path

import pytest

from optics.numerics.backend import load_backend
from scenes.models.disturbances import stated_motions
from scenes.models.instrument_builder import build_instrument
from scenes.specs.load import EXAMPLES
from scenes.specs.operation import ENDINGS, OperationSpec, read_operation, resolve_operation
from scenes.yaml.units import parse_quantity
from tests.tiers import quick

SHORT = "instrument: gf7_pair\ndisturbances: in_service\n"


def written(folder: Path, text: str) -> Path:
    file = folder / "plan.yaml"
    file.write_text(text, "utf-8")
    return file


def test_the_example_says_its_limits_in_the_units_of_its_quantities() -> None:
    setup = read_operation(EXAMPLES / "operation.yaml")
    limits = {(one.group, one.key): (one.largest, one.probability) for one in setup.operation.requirements}
    assert limits == {
        ("intersection_angle", "change_arcsec"): (pytest.approx(2.0), 0.99),
        ("forward", "d_f_um"): (pytest.approx(60.0), 0.95),
        ("ground", "height_m"): (10.0, 0.95),
    }
    assert {cause for causes in setup.operation.events.values() for cause in causes} <= set(setup.disturbances.causes)
    again = OperationSpec.model_validate(setup.operation.plain())
    assert again == setup.operation
    assert resolve_operation(again).model.plain() == setup.model.plain()


@pytest.mark.parametrize("instrument", quick(1, ["gf7_pair", "gf7_pair_two"]))
def test_in_service_finds_its_bodies_in_both_instruments(instrument: str, tmp_path: Path) -> None:
    """Every cause has bodies, and the causes share a few laws of time, each of which an estimate carries along."""
    setup = read_operation(written(tmp_path, SHORT.replace("gf7_pair", instrument)))
    built = build_instrument(setup.model.instrument, setup.model.cameras, load_backend())
    stated = stated_motions(setup.model, built)
    assert stated is not None
    assert {one.cause for one in stated.components} == set(setup.disturbances.causes)
    assert len({law.text for law in stated.laws}) == 6


def test_own_files_are_found_from_the_plans_folder(tmp_path: Path) -> None:
    cause = "{bodies: base/<camera>, rotate: 1 arcsec, time: {drift: 4800 h}, reason: a test}"
    (tmp_path / "own.yaml").write_text(f"name: own\ncauses:\n  mount: {cause}\n")
    setup = read_operation(written(tmp_path, SHORT.replace("in_service", "own.yaml")))
    assert setup.operation.disturbances == str(tmp_path / "own.yaml")
    assert list(setup.disturbances.causes) == ["mount"]


def test_every_ending_measures_one_of_its_unit() -> None:
    for kind, unit in ENDINGS.values():
        assert parse_quantity(f"1 {unit}", kind) > 0.0
