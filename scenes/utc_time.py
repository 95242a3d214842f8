"""Instants in UTC as fields of a specification: ISO 8601 text in YAML, `2011-03-05T03:05:00Z`, and in the model."""

import re
from datetime import UTC, datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, WithJsonSchema

from scenes.errors import Problem, shown

FIRST_YEAR, LAST_YEAR = 1972, 2099
"""UTC has whole leap seconds since 1972."""
ALLOWED = f"date and time in UTC, ISO 8601 and ending in Z, {FIRST_YEAR} to {LAST_YEAR}, e.g. '2011-03-05T03:05:00Z'"
PATTERN = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}(:[0-9]{2}(\.[0-9]{1,6})?)?Z$"


def parse_utc(text: Any) -> str:
    """The same text, checked; a value that is written another way than the pattern is refused, also a leap second.

    Raises:
        Problem: no text, another form, without its zone, or no such instant.
    """
    if not isinstance(text, str):
        raise Problem("not a date and time", shown(text), ALLOWED)
    stripped = text.strip()
    if re.fullmatch(PATTERN.replace("Z$", "$"), stripped):
        raise Problem("a date and time without its zone", shown(text), ALLOWED)
    if not re.fullmatch(PATTERN, stripped):
        raise Problem("not a date and time", shown(text), ALLOWED)
    try:
        time = datetime.fromisoformat(stripped).astimezone(UTC)
    except ValueError:
        raise Problem("no such date or time", shown(text), ALLOWED) from None
    if not FIRST_YEAR <= time.year <= LAST_YEAR:
        raise Problem("outside the years of this time scale", shown(text), ALLOWED)
    return stripped


UtcTime = Annotated[
    str,
    BeforeValidator(parse_utc),
    WithJsonSchema(
        {"type": "string", "pattern": PATTERN, "description": ALLOWED, "examples": ["2011-03-05T03:05:00Z"]}
    ),
]
"""An instant in UTC, ISO 8601 text ending in Z."""
