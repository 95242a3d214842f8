"""What every experiment's input has in common: a test, what it refers to, and a config.yaml that repeats it."""

from pathlib import Path
from typing import Generic, Self, TypeVar

from scenes.yaml.spec import Source, Spec
from scenes.yaml.translate import validate
from scenes.yaml.yaml_file import dump_yaml, read_yaml

TestType = TypeVar("TestType", bound=Spec)
SetupType = TypeVar("SetupType", bound="ExperimentSetup")


class ExperimentSetup(Spec, Generic[TestType]):
    """A test together with all it refers to, so that one file says all that went into a run.

    Attributes:
        test: what the test's file says.
    """

    test: TestType

    def with_seed(self, seed: int) -> Self:
        """The same with another seed, for one that a command overrides."""
        return self.model_copy(update={"test": self.test.model_copy(update={"seed": seed})})

    def to_yaml(self) -> str:
        """Text of a config.yaml, which ``read_setup`` reads back to the same values."""
        return dump_yaml(self.plain())


def read_setup(model: type[SetupType], path: str | Path) -> SetupType | None:
    """The setup that a run's config.yaml holds; None for the file, or the name in the library, of a test alone.

    Raises:
        InputError: the file cannot be read, or is a config.yaml that is not valid.
    """
    if not (isinstance(path, Path) or "/" in str(path) or str(path).endswith((".yaml", ".yml"))):
        return None
    yaml = read_yaml(path)
    if not (isinstance(yaml.data, dict) and "test" in yaml.data):
        return None
    setup = validate(model, yaml)
    # the test knows where it was read, so that what is found wrong later is told by its line
    test = setup.test.with_source(Source(setup.source.file, setup.source.lines, ("test",)))
    return setup.model_copy(update={"test": test})
