"""How the quantities of the files are written, by key: what a message shows where one is missing or cannot be read.

A kind of quantity has an example of its own; of a length that would be the 20 um of a shift, which no entrance pupil
has.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from scenes.yaml.errors import KeyPath, Problem, key_text
from scenes.yaml.quantity import Quantity, Vector

EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "angle": ("5 deg",),
    "aperture": ("50 mm",),
    "argument": ("90 deg",),
    "back_radius": ("-0.5 m",),
    "camera_angle": ("26 deg",),
    "clearance": ("5 mm",),
    "correlation": ("500 m",),
    "diameter": ("50 mm",),
    "distance": ("0.5 m",),
    "elevation": ("45 deg",),
    "entrance_pupil": ("0.6 m",),
    "field": ("1.2 deg",),
    "field_bias": ("6 deg",),
    "parcel_size": ("100 m",),
    "focal_distance": ("0.5 m",),
    "focal_length": ("5.5 m", "10 um"),
    "front_radius": ("0.5 m",),
    "height": ("60 mm",),
    "last": ("360 deg",),
    "latitude": ("40 deg",),
    "light": ("80 percent",),
    "longest": ("2 km",),
    "longitude": ("116 deg",),
    "look": ("26 deg",),
    "noise": ("0.1 m",),
    "offset": ("5 mm",),
    "pitch": ("7 um",),
    "position": ("0.5 m",),
    "post": ("30 m",),
    "prism_0.shift": ("100 mm",),
    "pupil_offset": ("220 mm",),
    "radius": ("-2.5 m", "0.5 m"),
    "reach": ("0.2 mm",),
    "roads": ("500 m",),
    "separation": ("0.24 m",),
    "spacing": ("10 m",),
    "spectrum": ("650 nm",),
    "spread": ("60 mm",),
    "step": ("20 um", "1 deg"),
    "thickness": ("10 mm",),
    "track": ("20 km",),
    "velocity": ("0.1 m/s",),
    "wavelength": ("650 nm",),
    "white": ("80 percent",),
    "wide": ("5 deg",),
    "width": ("60 mm",),
    "x": ("1.2 deg",),
    "y": ("0.15 deg",),
    "z": ("-2 m",),
}
"""Key, or two of them, -> how its quantity may be written; the first that the key's own limits allow is shown."""


def example_of(quantity: Quantity, key: KeyPath) -> str:
    """How a quantity may be written at a key, within its limits."""
    limits = (text for text in (quantity.smallest, quantity.largest) if text is not None)
    known = (text for n in (2, 1) for text in EXAMPLES.get(key_text(key[-n:]), ()))
    for text in (*known, quantity.kind.example, *limits):
        try:
            quantity.parse(text)
        except Problem:
            continue
        return text
    return quantity.kind.example


def written(metadata: Iterable[Any], key: KeyPath) -> str | None:
    """How the value of a field may be written, if it is a quantity or a row of them.

    Args:
        metadata: annotations of the field.
        key: where it stands in the file.
    """
    for item in metadata:
        if isinstance(item, Quantity):
            return example_of(item, key)
        if isinstance(item, Vector):
            return f"[{', '.join([example_of(item.of, key)] * item.length)}]"
    return None


def allowed_at(metadata: Iterable[Any], key: KeyPath, allowed: str | None) -> str | None:
    """What may stand at a key, as the quantity's reader said it, with the key's own example in it."""
    for item in metadata:
        quantity = item.of if isinstance(item, Vector) else item
        if isinstance(quantity, Quantity) and allowed == quantity.kind.allowed:
            return quantity.kind.asked(example_of(quantity, key))
    return allowed
