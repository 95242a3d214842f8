"""Examples in messages are quantities that the key takes."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

import scenes.specs
from scenes.yaml.examples import EXAMPLES, example_of
from scenes.yaml.quantity import Quantity, Vector
from scenes.yaml.spec import Spec

for module in pkgutil.walk_packages(scenes.specs.__path__, "scenes.specs."):
    importlib.import_module(module.name)


def kinds(spec: type[Spec]) -> Iterator[type[Spec]]:
    for one in spec.__subclasses__():
        yield one
        yield from kinds(one)


QUANTITIES = {
    (spec.__name__, name): item.of if isinstance(item, Vector) else item
    for spec in kinds(Spec)
    for name, field in spec.model_fields.items()
    for item in field.metadata
    if isinstance(item, Quantity | Vector)
}


def test_every_example_is_allowed() -> None:
    assert len(QUANTITIES) > 150
    for (_, name), quantity in QUANTITIES.items():
        quantity.parse(example_of(quantity, (name,)))


def test_an_example_is_of_its_key() -> None:
    names = {name for _, name in QUANTITIES}
    assert {key.rpartition(".")[2] for key in EXAMPLES} <= names
    pupil = QUANTITIES["CameraSpec", "entrance_pupil"]
    assert example_of(pupil, ("entrance_pupil",)) == "0.6 m"
    assert example_of(QUANTITIES["Prism0Spec", "shift"], ("monitor", "prism_0", "shift")) == "100 mm"
