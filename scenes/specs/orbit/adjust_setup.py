"""An adjustment of a block together with its camera."""

from __future__ import annotations

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
    return setup
