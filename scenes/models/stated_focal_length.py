"""Are the focal length and the entrance pupil that a camera's file states those of its surfaces, and if not, which
number is wrong?
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.camera import CameraSpec, MirrorSpec
from scenes.yaml.errors import KeyPath, key_text
from scenes.yaml.units import ANGLE, LENGTH, format_quantity

LARGEST_DIFFERENCE = 0.1
"""Share by which the traced focal length may differ from the stated one. The library's cameras need 0.5 % along the
line and 8 % across it; a wrong sign or unit is seldom below a third.
"""

LARGEST_PUPIL_DIFFERENCE = 0.4
"""Share by which the traced entrance pupil may differ from the stated one where the stop's diameter is stated as well.
Of off-axis cameras the pupil of the axis is up to some 10 % from that of the field's middle, and the smallest mistake,
a radius in place of a diameter, is a factor of two."""

SAME_PUPIL = 0.01
"""Share by which the beam that fills the stop may differ from the beam that made it: none about an axis; cameras with
turned surfaces map one circle to another curve and back."""


class TracedFocalLengths(NamedTuple):
    """Focal lengths of a camera about the chief ray of its field's middle, metres.

    Attributes:
        image: change of the image's place per angle, along the line and across it, (2,): on the plane that the file
            states, in focus or not.
        light: of parallel light, wherever its focus is: in the two principal directions about that ray, infinite
            without power, and the effective focal length about the axis, (3,); negative where light diverges after the
            last surface.
    """

    image: np.ndarray
    light: np.ndarray


FocalLengths = Callable[[CameraSpec], TracedFocalLengths]

_MOST_NAMED = 3  # causes in a message

_UNITS = ((1000.0, "m in place of mm"), (0.001, "mm in place of m"))

_NO_LIGHT = (AimError, BeamMissedError, ArithmeticError, np.linalg.LinAlgError, ValueError)


def check_focal_length(spec: CameraSpec, traced: TracedFocalLengths, focal_lengths: FocalLengths) -> None:
    """Check the stated focal length against the traced one.

    Either of the two directions will do, since cameras with surfaces off the axis differ in them. A camera that is only
    out of focus is none of another focal length, unless a single number explains it: it can be refocused.

    Args:
        spec: the camera.
        traced: its focal lengths.
        focal_lengths: how those of a changed camera are traced; asked only to find out what is wrong.

    Raises:
        InputError: they differ by more than ``LARGEST_DIFFERENCE``; with the number whose other sign or unit brings
            the focal length to the stated one, where there is one.
    """
    stated, real = spec.focal_length, bool(np.all(traced.light > 0.0))
    in_place, in_focus = (_difference(np.abs(one), stated) <= LARGEST_DIFFERENCE for one in traced)
    if in_focus and in_place and real:
        return
    cause, suggestion = _cause(spec, float(traced.image[0]), focal_lengths, in_focus and real)
    if suggestion is None and in_focus:
        return
    off = float(traced.light[-1] if in_place else traced.image[0])
    problem = f"the focal length is stated as {stated:.4g} m, but light through the surfaces has one of {off:.4g} m"
    allowed = f"the traced focal length within {100 * LARGEST_DIFFERENCE:.0f} %, or surfaces that have the stated one"
    raise spec.error(problem + cause, ("focal_length",), allowed=allowed, suggestion=suggestion)


def check_entrance_pupil(spec: CameraSpec, traced: float) -> None:
    """Check the stated entrance pupil of a camera against the traced diameter, metres.

    Raises:
        InputError: they differ by more than ``LARGEST_PUPIL_DIFFERENCE`` where the stop is stated, else at all: other
            rays than those of the stated beam meet the rim of the stop.
    """
    off = abs(traced / spec.entrance_pupil - 1.0)
    if spec.stop_diameter is None and off > SAME_PUPIL:
        problem = "rays of other heights than the stated beam's meet the rim of the stop, which stands near their focus"
        raise spec.error(problem, ("stop",), allowed="a stop that rays of different heights meet in different places")
    if off > LARGEST_PUPIL_DIFFERENCE:
        stated, found = (format_quantity(float(f"{d:.4g}"), LENGTH) for d in (spec.entrance_pupil, traced))
        problem = f"a stop of this size has an entrance pupil of {found} on the axis; the file states one of {stated}"
        allowed = f"both within {100 * LARGEST_PUPIL_DIFFERENCE:.0f} %, or the entrance pupil alone"
        raise spec.error(problem, ("stop_diameter",), allowed=allowed)


def _difference(traced: np.ndarray, stated: float) -> float:
    """Relative difference of the nearer direction."""
    return float(np.min(np.abs(traced / stated - 1.0)))


def _cause(spec: CameraSpec, traced: float, focal_lengths: FocalLengths, place: bool) -> tuple[str, str | None]:
    """What is likely wrong, in words and as the line that would be right; nothing where no single number is."""
    for factor, what in _UNITS:
        if abs(factor * traced / spec.focal_length - 1.0) <= LARGEST_DIFFERENCE:
            right = format_quantity(spec.focal_length / factor, LENGTH)
            return f"; the stated one is likely {what}", f"focal_length: {right}"
    # surfaces that have the stated focal length are right: only where the image is taken may be wrong
    for among in (_places(spec),) if place else (_single(spec), _places(spec), _together(spec)):
        fits = []
        for words, line, changed in among:
            try:
                off = max(_difference(one, spec.focal_length) for one in focal_lengths(changed))
            except _NO_LIGHT:
                continue
            if off <= LARGEST_DIFFERENCE:
                fits.append((off, words, line))
        if fits:
            fits.sort()
            others = ", ".join(words for _, words, _ in fits[1:_MOST_NAMED])
            also = f" (or {others})" if others else ""
            return f"; the likely cause is {fits[0][1]}{also}", fits[0][2]
    return "", None


Candidates = Iterator[tuple[str, str, CameraSpec]]
"""What may be wrong, the line that would be right, and the camera with it."""


def _single(spec: CameraSpec) -> Candidates:
    """One number of one surface."""
    for name, mirror in spec.mirrors.items():
        for key, words, value, text in _changes(mirror):
            mirrors = {**spec.mirrors, name: mirror.model_copy(update={key: value})}
            line = f"{key_text(('mirrors', name, key))}: {text}"
            yield f"{words} of {name}", line, spec.model_copy(update={"mirrors": FrozenMap(mirrors)})


def _together(spec: CameraSpec) -> Candidates:
    """The sign of all radii, as another program has it."""
    turned = {name: mirror.model_copy(update={"radius": -mirror.radius}) for name, mirror in spec.mirrors.items()}
    line = "radius of every surface with the other sign: positive if its centre of curvature lies toward +z"
    yield "the sign of every radius", line, spec.model_copy(update={"mirrors": FrozenMap(turned)})


def _places(spec: CameraSpec) -> Candidates:
    """One number of the image or the field."""
    image = spec.image
    changes: list[tuple[KeyPath, str, dict[str, Any]]] = []
    for z, words in _lengths("z", image.z):
        changes.append((("image", "z"), words, {"image": image.model_copy(update={"z": z})}))
    if image.tilt:
        tilted = image.model_copy(update={"tilt": -image.tilt})
        changes.append((("image", "tilt"), "the sign of the tilt", {"image": tilted}))
    if spec.field_bias:
        changes.append((("field_bias",), "the sign of the bias", {"field_bias": -spec.field_bias}))
    for key, words, update in changes:
        changed = spec.model_copy(update=update)
        value = changed.field_bias if key == ("field_bias",) else getattr(changed.image, str(key[1]))
        text = format_quantity(value, LENGTH if key[-1] == "z" else ANGLE)
        whose = "field" if key == ("field_bias",) else "image"
        yield f"{words} of the {whose}", f"{key_text(key)}: {text}", changed


def _changes(mirror: MirrorSpec) -> Iterator[tuple[str, str, Any, str]]:
    """Key, what is wrong with it, its other value, and that as text."""
    if math.isfinite(mirror.radius):
        for value, words in _lengths("radius", mirror.radius):
            yield "radius", words, value, format_quantity(value, LENGTH)
    for value, words in _lengths("z", mirror.z):
        yield "z", words, value, format_quantity(value, LENGTH)
    if mirror.conic:
        yield "conic", "the sign of the conic constant", -mirror.conic, f"{-mirror.conic:g}"
    for key, words, kind in (("rotate", "the tilt about", ANGLE), ("decentre", "the decentre along", LENGTH)):
        given = getattr(mirror, key) or ()
        for axis, value in enumerate(given):
            if value:
                other = (*given[:axis], -value, *given[axis + 1 :])
                text = ", ".join(format_quantity(v, kind) for v in other)
                yield key, f"the sign of {words} {'xyz'[axis]}", other, f"[{text}]"


def _lengths(what: str, value: float) -> Iterator[tuple[float, str]]:
    """Other signs and units of a length."""
    if value:
        yield -value, f"the sign of the {what}"
        for factor, words in _UNITS:
            yield value / factor, f"the unit of the {what} ({words})"
