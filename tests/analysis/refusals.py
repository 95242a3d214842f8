"""Refusals in one line."""

from collections.abc import Callable

import pytest


def refuses(error: type[Exception], match: str, call: Callable, *arguments: object, **options: object) -> None:
    """Assert that a call is refused with an error whose message matches."""
    with pytest.raises(error, match=match):
        call(*arguments, **options)
