"""The inputs of an error budget as a file in scenes/library/budgets gives them: how steady things are, all as 3
sigma.
"""

from typing import Annotated

from pydantic import AfterValidator, Field

from optics.numerics.frozen_map import FrozenMap
from scenes.specs.instrument import Frames, InstrumentSpec, Tilt
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Name, NothingIsEmpty, Number, Reference, Spec, Text, Whole
from scenes.yaml.units import ANGLE, TEMPERATURE_DIFFERENCE, TEMPERATURE_GRADIENT

Steadiness = Annotated[float, Quantity(TEMPERATURE_DIFFERENCE, above_zero=True, largest="100 K")]
GradientSteadiness = Annotated[float, Quantity(TEMPERATURE_GRADIENT, above_zero=True, largest="100 K/m")]
RotationSteadiness = Annotated[float, Quantity(ANGLE, above_zero=True, largest="1 deg")]
AngleErrors = Annotated[
    dict[Name, Annotated[dict[Name, Tilt], AfterValidator(FrozenMap)]], NothingIsEmpty, AfterValidator(FrozenMap)
]


class SteadinessSpec(Spec):
    """How far things change between the nominal measurement and a later one: 3 sigma of each component, independent
    for every body and axis.

    Attributes:
        focal_plane_temperature: of each camera's focal plane, kelvin.
        prism_180_gradient, prism_0_gradient, central_prism_gradient: change of the temperature gradient in the glass,
            K/m.
        prism_180_rotation, prism_0_rotation: of the prisms in their mounts, radians.
    """

    focal_plane_temperature: Steadiness
    prism_180_gradient: GradientSteadiness
    prism_0_gradient: GradientSteadiness
    prism_180_rotation: RotationSteadiness
    prism_0_rotation: RotationSteadiness
    central_prism_gradient: GradientSteadiness


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
        steadiness: what changes, and by how much.
    """

    description: Text = ""
    instrument: Reference
    photons_per_frame: Annotated[Number, Field(gt=0.0, le=1e12)]
    frames: Frames = 9
    trials: Annotated[Whole, Field(ge=20, le=100_000)] = 100
    all_together: Annotated[Whole, Field(ge=20, le=100_000)] = 300
    angle_errors: AngleErrors
    steadiness: SteadinessSpec

    def applied_to(self, instrument: InstrumentSpec) -> InstrumentSpec:
        """The instrument with this budget's angle errors and light."""
        monitor = instrument.monitor
        changed = {
            prism: getattr(monitor, prism).model_copy(update={"angle_errors": errors})
            for prism, errors in self.angle_errors.items()
        }
        reticle = monitor.reticle.model_copy(update={"photons_per_frame": self.photons_per_frame})
        copied = monitor.model_copy(update={**changed, "reticle": reticle})
        return instrument.model_copy(update={"monitor": copied})
