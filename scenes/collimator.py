"""The laboratory's collimator and the camera that looks into it, as files in scenes/lab give them."""

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from optics.collimator import Collimator
from optics.frozen_map import FrozenMap
from scenes.errors import Problem
from scenes.job import FigureTerm, PerturbationSpec, Term, noll
from scenes.quantity import PositiveLength
from scenes.spec import Paths, Reference, Spec


class CollimatorSpec(Spec):
    """A long collimator with its target at the focus.

    Attributes:
        focal_length: metres.
        aperture: diameter, metres.
        wavefront: its error over the aperture by Zernike terms, Noll's numbering, metres rms.
    """

    focal_length: PositiveLength
    aperture: PositiveLength
    wavefront: Annotated[dict[Term, FigureTerm], AfterValidator(FrozenMap)] = Field(default_factory=FrozenMap)

    @property
    def model(self) -> Collimator:
        """The collimator."""
        terms = {noll(term): size for term, size in self.wavefront.items()}
        return Collimator(self.focal_length, 0.5 * self.aperture, terms)


class CameraUnderTestSpec(Spec):
    """The camera under test, alone in front of the collimator.

    Attributes:
        camera: prescription, by name or path.
        as_built: how it departs from the prescription: ``M1``, ``M2`` ... or ``focal_plane`` -> perturbation, as in a
            job; figures of mirrors for the most part.
    """

    camera: Reference
    as_built: Paths[PerturbationSpec] = Field(default_factory=FrozenMap)

    @model_validator(mode="after")
    def _cold(self) -> "CameraUnderTestSpec":
        for path, what in self.as_built.items():
            if "temperature" in what.uses():
                raise Problem(
                    "temperatures are not modelled in the laboratory",
                    "temperature",
                    "rotate, shift, scale or figure",
                    within=("as_built", path, "temperature"),
                )
        return self
