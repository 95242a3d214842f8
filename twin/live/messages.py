"""Messages between the page and the program of the live twin.

The page sends JSON texts, each one of `Message`; none of them names a file. The program answers with JSON texts and,
for a state's images, with one binary message: four bytes (little endian) with the length of a JSON text, the text,
spaces up to a multiple of eight bytes, and the images listed under ``images`` in the text, uint16, little endian.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

LARGEST_MESSAGE = 1 << 16
"""Largest size of a message of the page, in bytes."""
MOST_KNOBS = 400
"""Largest number of knobs in a message; only knobs that are not zero are sent."""
MOST_FRAMES = 64
"""Largest number of frames of an exposure."""
LARGEST_SEED = 2**53 - 1
"""Largest whole number that a number in JSON represents exactly."""

Text = Annotated[str, Field(max_length=200)]
Number = Annotated[float, Field(allow_inf_nan=False)]


class _PageMessage(BaseModel):
    """Base class of the messages that a page sends; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class AskedState(_PageMessage):
    """Request of the page for a state of the knobs.

    Attributes
    ----------
    n : int
        Number of the request, counted by the page.
    t : float
        Time of the request by the page's clock, which is sent back.
    knobs : dict[str, float]
        Name -> value of every knob that is not zero.
    pivots : dict[str, str]
        Body -> name of its pivot.
    noise : bool
        True for frames with noise, False for the expected image.
    frames : int
        Number of frames of each exposure.
    seed : int
        Seed of the noise.
    time : int | None
        Index of a time in the job's time series (``course``); None for the job's single state.
    quality : bool
        Whether image quality is computed for an instrument without a monitor; the page of a single camera asks for it
        when the knobs rest.
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
    quality: bool = True


class BlindState(AskedState):
    """Request for a state while motions are hidden; it is made by the program and never read from a page.

    Attributes
    ----------
    blind : int
        Seed of the hidden motions.
    """

    blind: int


class AskedView(_PageMessage):
    """Request for a picture of one camera in the latest state.

    Attributes
    ----------
    n : int
        Number of the request.
    state : AskedState
        State of the knobs.
    view : str
        ``wavefront``, ``spot``, ``mtf``, ``focus`` or ``target``.
    camera : str
        Name of the camera.
    field : float
        Field along the line, as a fraction of the half field; where the field point has knobs, these set it.
    """

    type: Literal["view"] = "view"
    n: Annotated[int, Field(ge=0, le=LARGEST_SEED)]
    state: AskedState
    view: Literal["wavefront", "spot", "mtf", "focus", "target"]
    camera: Text
    field: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0


class Factors(_PageMessage):
    """Request to build the instrument with other values of a study's factors, for all pages.

    Attributes
    ----------
    values : dict[str, float]
        Factor -> number in its unit.
    """

    type: Literal["factors"] = "factors"
    values: Annotated[dict[Text, Number], Field(max_length=100)]


class Blind(_PageMessage):
    """Request to perturb the instrument by hidden random motions, or to reveal them.

    The user of the page is to guess the motions.

    Attributes
    ----------
    on : bool
        True to hide, False to reveal.
    """

    type: Literal["blind"] = "blind"
    on: bool


class Record(_PageMessage):
    """Request to begin recording every shown state, or to end the recording.

    Attributes
    ----------
    on : bool
        True to begin, which drops an earlier recording; False to end.
    """

    type: Literal["record"] = "record"
    on: bool


class Save(_PageMessage):
    """Request for a file: of a state, of the recorded states as a time series (``course``), or of a changed camera.

    Attributes
    ----------
    what : str
        ``job``, ``course`` or ``camera``.
    state : AskedState
        State of the knobs.
    """

    type: Literal["save"] = "save"
    what: Literal["job", "course", "camera"]
    state: AskedState


Message = AskedState | AskedView | Factors | Blind | Record | Save
_MESSAGE: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="type")])


class BadMessage(ValueError):
    """Error that a message from a page is not valid."""


def read_message(text: str | bytes) -> Message:
    """Read a message of a page.

    Raises
    ------
    BadMessage
        The message is not valid; the text says where.
    """
    if len(text) > LARGEST_MESSAGE:
        raise BadMessage(f"the message has {len(text)} bytes, more than {LARGEST_MESSAGE}")
    try:
        return _MESSAGE.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])[:200]
        raise BadMessage(f"invalid message: {where or 'the text'}: {first['msg']}"[:400]) from None


def packed(data: Mapping[str, Any], images: Mapping[str, np.ndarray]) -> bytes:
    """Return a binary message of the program with data and images.

    Parameters
    ----------
    data : Mapping[str, Any]
        Plain data.
    images : Mapping[str, ndarray]
        Name -> (C, H, W) array of type uint16: C images of H rows and W columns.
    """
    whole = {**data, "images": {name: list(image.shape) for name, image in images.items()}}
    text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % 8)
    pixels = [np.ascontiguousarray(image, "<u2").tobytes() for image in images.values()]
    return len(text).to_bytes(4, "little") + text + b"".join(pixels)


@dataclass(frozen=True, eq=False)
class Opened:
    """Instrument that is ready for the requests of pages.

    Attributes
    ----------
    greeting : dict[str, Any]
        Data that a page needs before its first request.
    scene : bytes
        Binary glTF of the nominal instrument.
    """

    greeting: dict[str, Any]
    scene: bytes
