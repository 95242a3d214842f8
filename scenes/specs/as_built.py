"""One instrument as it was built: another file's instrument, and how its bodies stand and are shaped against that."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from optics.geometry.tree import Motion, State
from optics.numerics.number_tree import FrozenMap
from scenes.specs.instrument import InstrumentSpec
from scenes.specs.perturbation import AsBuilt, PlainPerturbationSpec
from scenes.yaml.spec import Reference, TitledSpec

DESIGN = "design"
"""Key by which the file of an instrument as built is told."""


def alone(value: Any) -> Any:
    """`{camera: my.yaml}` is the camera by itself."""
    return value["camera"] if isinstance(value, Mapping) and set(value) == {"camera"} else value


InstrumentReference = Annotated[Reference, BeforeValidator(alone)]
"""Name or path of an instrument, or of a camera that is one without a monitor."""


class AsBuiltInstrumentSpec(TitledSpec):
    """An instrument as it was built: the instrument of a design, and how its bodies stand and are shaped against that.

    Attributes:
        name: as the file is called.
        description: for people.
        design: the instrument of the drawing: name of one in scenes/library/instruments, or path of an own file. A
            camera, as `{camera: NAME or FILE}` or named like an instrument, is one without a monitor.
        as_built: node -> how it stands and is shaped against the drawing, as in a job's `perturb`, by the node's path
            or the last parts of it; or a list of texts such as `M2 shift z 20 um`. What a job perturbs comes on top of
            it, and changes count from it.
        disturbances: what is expected to move, or how well it is known how the bodies stand: a file of
            scenes/library/disturbances or of one's own; the design's by default.
    """

    design: InstrumentReference
    as_built: AsBuilt = Field(default_factory=FrozenMap)
    disturbances: Reference | None = None

    def made_of(self, design: InstrumentSpec, disturbances: str | None = None) -> InstrumentSpec:
        """The instrument that this one is.

        Args:
            design: what `design` names.
            disturbances: name or absolute path of the file of disturbances; None for the design's.
        """
        update: dict[str, Any] = {"name": self.name, "as_built": self.as_built}
        update |= {} if not self.description else {"description": self.description}
        update |= {} if disturbances is None else {"disturbances": disturbances}
        return design.model_copy(update=update)


def as_built_of(state: State) -> FrozenMap[str, PlainPerturbationSpec]:
    """A state of an instrument as `as_built` has it.

    Args:
        state: body path -> motion, for example what `optics.geometry.tree.compose` makes of the state that was found
            and of the one that the file has already. Bodies at rest are left out.

    Raises:
        ValueError: a motion that no file can say: with a scale, a stretch, a gradient of the index or a grid.
    """
    return FrozenMap({path: _built(path, motion) for path, motion in state.items() if motion != Motion()})


def _built(path: str, motion: Motion) -> PlainPerturbationSpec:
    if motion.scale or motion.stretch or any(motion.index_gradient) or motion.grid is not None:
        raise ValueError(f"{path}: only rigid motions, Zernike terms, radius, conic constant and index are as built")
    # of checked parts: to validate them would ask for quantities as text
    return PlainPerturbationSpec.model_construct(
        rotate=motion.rotate,
        shift=motion.shift,
        pivot=motion.pivot,
        figure=FrozenMap({f"Z{j}": value for j, value in sorted(motion.figure.items())}),
        radius=motion.radius or None,
        conic=motion.conic or None,
        index=motion.index or None,
    )


def as_built_file(
    name: str, design: str, state: State, disturbances: str | None = None, description: str = "", remark: str = ""
) -> str:
    """Text of the file of an instrument as it was built; `scenes.specs.load.load_instrument` reads it back to exactly
    this state.

    Args:
        name: of the instrument.
        design: name or path of the instrument of the drawing, as the file is to say it.
        state: body path -> motion against the drawing.
        disturbances: name of a file of disturbances, or its path from where the file is going to stand; None for those
            of the design.
        description: for people.
        remark: at the top of the file, lines of comment.

    Raises:
        ValueError: as ``as_built_of``.
    """
    spec = AsBuiltInstrumentSpec.model_construct(
        name=name, description=description, design=design, as_built=as_built_of(state), disturbances=disturbances
    )
    return spec.file_text(remark)
