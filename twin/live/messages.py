"""What page and program say to each other.

The page sends JSON texts, each one of `Message`; nothing in them names a file. The program answers with JSON texts and,
for a state's images, with one binary message: four bytes (little endian) with the length of a JSON text, the text,
spaces up to a multiple of eight bytes, and the images that the text lists under ``images``, uint16, little endian.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

LARGEST_MESSAGE = 1 << 16
"""Bytes of a message of the page."""
MOST_KNOBS = 400
"""Knobs off zero at once."""
MOST_FRAMES = 64
LARGEST_SEED = 2**53 - 1
"""What a number in JSON holds exactly."""

Text = Annotated[str, Field(max_length=200)]
Number = Annotated[float, Field(allow_inf_nan=False)]


class _PageMessage(BaseModel):
    """Nothing else may stand in a message."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class AskedState(_PageMessage):
    """A state of the knobs.

    Attributes
    ----------
    n : int
        Its number, counted by the page.
    t : Number
        The page's clock when it was asked for, which is sent back.
    knobs : dict[Text, Number]
        Name -> value, of those that are not at zero.
    pivots : dict[Text, Text]
        Body -> name of the point about which it turns.
    noise : bool
        Frames with noise, or the expected image.
    frames : int
        Of each exposure.
    seed : int
        Of the noise.
    time : int | None
        Number of a time of the job's course; None for the job's single state.
    """

    type: Literal["state"] = "state"
    n: Annotated[int, Field(ge=0, le=LARGEST_SEED)]
    t: Number = 0.0
    knobs: Annotated[dict[Text, Number], Field(max_length=MOST_KNOBS)] = {}
    pivots: Annotated[dict[Text, Text], Field(max_length=MOST_KNOBS)] = {}
    noise: bool = True
    frames: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 1
    time: Annotated[int, Field(ge=0, le=1000)] | None = None


class BlindState(AskedState):
    """A state of the knobs while something is hidden. The program makes it; it is never read from a page.

    Attributes
    ----------
    blind : int
        Seed of what is drawn.
    """

    blind: int


class AskedView(_PageMessage):
    """A picture of one camera in the last state.

    Attributes
    ----------
    n : int
        Its number.
    state : AskedState
        Of the knobs.
    view : Literal['wavefront', 'spot', 'mtf', 'focus', 'target']
        Which picture.
    camera : Text
        Of which camera.
    field : float
        Along the line, as a share of the half field.
    """

    type: Literal["view"] = "view"
    n: Annotated[int, Field(ge=0, le=LARGEST_SEED)]
    state: AskedState
    view: Literal["wavefront", "spot", "mtf", "focus", "target"]
    camera: Text
    field: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0


class Factors(_PageMessage):
    """Build the instrument with other values of a study's factors; for all pages.

    Attributes
    ----------
    values : dict[Text, Number]
        Factor -> number in its unit.
    """

    type: Literal["factors"] = "factors"
    values: Annotated[dict[Text, Number], Field(max_length=100)]


class Blind(_PageMessage):
    """Hide motions that are drawn, or end it and show them.

    Attributes
    ----------
    on : bool
        Begin, or reveal.
    """

    type: Literal["blind"] = "blind"
    on: bool


class Record(_PageMessage):
    """Begin to keep every state that is shown, or end.

    Attributes
    ----------
    on : bool
        Begin (what was kept is forgotten), or end.
    """

    type: Literal["record"] = "record"
    on: bool


class Save(_PageMessage):
    """A job file of a state, or a job with a course of what was recorded.

    Attributes
    ----------
    what : Literal['job', 'course']
        which.
    state : AskedState
        Of the knobs.
    """

    type: Literal["save"] = "save"
    what: Literal["job", "course"]
    state: AskedState


Message = AskedState | AskedView | Factors | Blind | Record | Save
_MESSAGE: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="type")])


class BadMessage(ValueError):
    """A message of a page that is none."""


def read_message(text: str | bytes) -> Message:
    """A message of a page.

    Raises
    ------
    BadMessage
        It is none; the text says where.
    """
    if len(text) > LARGEST_MESSAGE:
        raise BadMessage(f"the message has {len(text)} bytes, more than {LARGEST_MESSAGE}")
    try:
        return _MESSAGE.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])[:200]
        raise BadMessage(f"not a message: {where or 'the text'}: {first['msg']}"[:400]) from None


def packed(data: Mapping[str, Any], images: Mapping[str, np.ndarray]) -> bytes:
    """A binary message of the program.

    Parameters
    ----------
    told : Mapping[str, Any]
        Plain data.
    images : Mapping[str, np.ndarray]
        Name -> uint16 (C, H, W).
    """
    whole = {**data, "images": {name: list(image.shape) for name, image in images.items()}}
    text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % 8)
    pixels = [np.ascontiguousarray(image, "<u2").tobytes() for image in images.values()]
    return len(text).to_bytes(4, "little") + text + b"".join(pixels)


@dataclass(frozen=True, eq=False)
class Opened:
    """An instrument that is ready.

    Attributes
    ----------
    greeting : dict[str, Any]
        What a page has to know.
    scene : bytes
        Binary glTF of it as designed.
    """

    greeting: dict[str, Any]
    scene: bytes
