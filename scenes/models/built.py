"""The instrument that was built, of the one that was drawn."""

from __future__ import annotations

from dataclasses import replace

from optics.geometry.pose import rotation_vector, triple
from optics.geometry.tree import Motion, State
from optics.numerics.backend import Backend
from optics.numerics.frozen_map import FrozenMap
from scenes.models.instrument_model import Instrument
from scenes.models.monitor_chain import square_facets
from scenes.specs.perturbation import in_full, perturbation_issues
from scenes.yaml.errors import InputError


def as_built(drawn: Instrument) -> Instrument:
    """An instrument whose bodies stand and are shaped as its file's `as_built` says; the same one where it says
    nothing.

    Poses of bodies, shapes of surfaces and indices of lenses have it in them, so that the state {} is the instrument
    as built, and a state of it acts on top. What was worked out of the drawing (frames, apertures, first-order numbers,
    the turns of the central prism's facets) stays that of the drawing.

    Args:
        drawn: the instrument of the drawing.

    Raises:
        InputError: a node that the instrument does not have, or that does not move or change so; one issue for each
            fault, at the file and line that says it.
    """
    stated = drawn.spec.as_built
    if not stated:
        return drawn
    named = in_full(stated, drawn.nodes, lambda problem, name: stated[name].issue(problem))
    issues = [issue for path, what in named.items() for issue in perturbation_issues(what, drawn.nodes, path, what, ())]
    if issues:
        raise InputError(*issues)
    state = FrozenMap({path: what.motion() for path, what in named.items()})
    return replace(drawn, assembly=drawn.assembly.standing(state), as_built=state)


def squared_facets(instrument: Instrument, backend: Backend) -> State:
    """How the facets of the central prism have to stand, beyond how they do, for the beams to return to the middle of
    the area CCDs.

    Those of a drawing do. The facets of an instrument are turned so when its monitor is mounted, after its cameras were
    aligned: ``compose`` this with ``as_built`` for the file of such an instrument.

    Args:
        instrument: as built.
        backend: where to trace.

    Returns:
        Body path of each facet -> its turn, about its own axes.

    Raises:
        MisplacedError: a beam misses a mirror or a prism.
    """
    tree = instrument.assembly.tree
    square = square_facets(instrument.assembly, instrument.channels, instrument.cameras, backend).tree
    return {
        channel.face_body: Motion(
            rotate=triple(
                rotation_vector(tree[channel.face_body].pose.rotation.T @ square[channel.face_body].pose.rotation)
            )
        )
        for channel in instrument.channels
    }
