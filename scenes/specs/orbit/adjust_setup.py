"""An adjustment of a block together with its camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scenes.specs import load
from scenes.specs.orbit.adjust import OrbitAdjustSpec
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, read_setup
from scenes.yaml.errors import unknown


class AdjustSetup(ExperimentSetup[OrbitAdjustSpec]):
    """A block with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec


def resolve_adjust(path: str | Path) -> AdjustSetup:
    """Read a block and the camera it refers to; a run's config.yaml can be given in its place.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(AdjustSetup, path)
    if setup is None:
        test = load.load_named(OrbitAdjustSpec, load.ORBIT, path)
        camera = load_three_line_camera(load.find_named(load.PAYLOADS, test.camera, test, ("camera",)))
        setup = AdjustSetup.model_construct(test=test, camera=camera)
    for k, name in enumerate(setup.test.lines):
        if name not in setup.camera.lines:
            raise setup.test.error(unknown("no such line", name, setup.camera.lines), ("lines", k))
    _require_sensors(setup.test)
    return setup


def without_sensors(setup: AdjustSetup, names: Sequence[str]) -> AdjustSetup:
    """The block adjusted without further sensors.

    Args:
        setup: the block.
        names: of sensors.

    Raises:
        InputError: the block has no such sensor.
    """
    if not names:
        return setup
    every = tuple(dict.fromkeys((*setup.test.without, *names)))
    test = setup.test.model_copy(update={"without": every})
    _require_sensors(test)
    return setup.model_copy(update={"test": test})


def _require_sensors(test: OrbitAdjustSpec) -> None:
    """InputError for a sensor that is to be left out and is not there."""
    for name in test.without:
        if name not in test.sensors:
            raise test.error(unknown("the block has no such sensor", name, test.sensors), ("without",))
