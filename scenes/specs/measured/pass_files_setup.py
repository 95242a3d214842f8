"""Tests on passes in files of other people's formats, together with the camera that they refer to."""

from pathlib import Path

from scenes.specs.measured.orbit_check import OrbitCheckSpec
from scenes.specs.measured.orbit_match import OrbitMatchSpec
from scenes.specs.measured.pass_files import with_absolute_files
from scenes.specs.orbit.load import find_payload, load_orbit_test, load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.specs.resolved import ExperimentSetup, read_setup
from scenes.yaml.errors import names_text, nearest


class CheckSetup(ExperimentSetup[OrbitCheckSpec]):
    """A check of a pass in files with its camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> "CheckSetup":
        """The same: nothing is drawn."""
        return self


def resolve_check(path: str | Path) -> CheckSetup:
    """Read a check and the camera it refers to; a run's config.yaml can be given in its place. Paths of the files of
    the pass are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid.
    """
    setup = read_setup(CheckSetup, path)
    if setup is not None:
        return setup
    test = load_orbit_test(OrbitCheckSpec, path)
    camera = load_three_line_camera(find_payload(test))
    return CheckSetup.model_construct(test=with_absolute_files(test), camera=camera)


class MatchSetup(ExperimentSetup[OrbitMatchSpec]):
    """Points in a user's images with the camera.

    Attributes:
        camera: the payload.
    """

    camera: ThreeLineCameraSpec

    def with_seed(self, seed: int) -> "MatchSetup":
        """The same: nothing is drawn."""
        return self


def resolve_match(path: str | Path) -> MatchSetup:
    """Read what is to be matched and the camera it refers to; a run's config.yaml can be given in its place. Paths of
    files are made absolute, so that the config.yaml is good anywhere.

    Raises:
        InputError: a file cannot be read or is not valid, or the camera has no such line.
    """
    setup = read_setup(MatchSetup, path)
    if setup is None:
        test = load_orbit_test(OrbitMatchSpec, path)
        camera = load_three_line_camera(find_payload(test))
        setup = MatchSetup.model_construct(test=with_absolute_files(test), camera=camera)
    for name in setup.test.images:
        if name not in setup.camera.lines:
            allowed, meant = names_text(setup.camera.lines), nearest(name, setup.camera.lines)
            raise setup.test.error("no such line", ("images", name), found=name, allowed=allowed, suggestion=meant)
    return setup
