"""An error budget: an instrument, the light of its spots, and the causes whose errors are its lines."""

from typing import Annotated

from pydantic import AfterValidator, Field

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.instrument import Frames, InstrumentSpec, Tilt
from scenes.yaml.spec import Name, NothingIsEmpty, Number, Reference, Spec, Text, Whole

AngleErrors = Annotated[
    dict[Name, Annotated[dict[Name, Tilt], AfterValidator(FrozenMap)]], NothingIsEmpty, AfterValidator(FrozenMap)
]


class ErrorBudgetSpec(Spec):
    """An error budget.

    Attributes:
        description: for people.
        instrument: which, by name or path.
        photons_per_frame: light of one spot in one frame; weak, as noise of the centroid is a line.
        frames: averaged in one measurement.
        trials: number of random states for each line.
        all_together: number of random states with all causes at once.
        angle_errors: prism (prism_180 or prism_0) -> face -> tilt about its x and y, as made.
        disturbances: what changes, and by how much: a file of scenes/library/disturbances or of one's own. Each of its
            causes is a line.
    """

    description: Text = ""
    instrument: Reference
    photons_per_frame: Annotated[Number, Field(gt=0.0, le=1e12)]
    frames: Frames = 9
    trials: Annotated[Whole, Field(ge=20, le=100_000)] = 100
    all_together: Annotated[Whole, Field(ge=20, le=100_000)] = 300
    angle_errors: AngleErrors
    disturbances: Reference

    def applied_to(self, instrument: InstrumentSpec) -> InstrumentSpec:
        """The instrument with this budget's angle errors and light."""
        monitor = instrument.autocollimator
        changed = {
            prism: getattr(monitor, prism).model_copy(update={"angle_errors": errors})
            for prism, errors in self.angle_errors.items()
        }
        reticle = monitor.reticle.model_copy(update={"photons_per_frame": self.photons_per_frame})
        copied = monitor.model_copy(update={**changed, "reticle": reticle})
        return instrument.model_copy(update={"monitor": copied})
