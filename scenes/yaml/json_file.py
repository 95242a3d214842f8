"""JSON that nobody has vetted: results in run folders, points of other programs."""

import json
from pathlib import Path
from typing import Any

from scenes.yaml.errors import InputError, Issue
from scenes.yaml.input_file import read_text
from scenes.yaml.yaml_file import DEEPEST

LARGEST_JSON = 500_000_000
"""Bytes of a file; a study of a million runs and twenty responses has a hundredth of it."""
MOST_DIGITS = 300
"""Most digits of a whole number, so that it is a finite floating-point number, too."""


def read_json(path: str | Path) -> Any:
    """Plain data of a JSON file.

    Raises:
        InputError: the file cannot be read, is too large or not JSON.
    """
    return parse_json(read_text(path, "a JSON file", LARGEST_JSON, (".json",)), str(path))


def parse_json(text: str, file: str) -> Any:
    """Plain data of JSON; `file` is what messages call it. NaN and infinities are taken, as Python writes them.

    Raises:
        InputError: it is not JSON, is nested deeper than YAML may be, or has whole numbers that no computation takes.
    """
    try:
        data = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise InputError(Issue(f"not JSON: {error.msg}", file, error.lineno)) from None
    except RecursionError:
        raise InputError(_too_deep(file)) from None
    except ValueError as error:
        raise InputError(Issue(f"not JSON: {error}", file)) from None
    level = [data] if isinstance(data, dict | list) else []
    for _ in range(DEEPEST):
        level = [one for held in level for one in (held.values() if isinstance(held, dict) else held)]
        level = [one for one in level if isinstance(one, dict | list)]
        if not level:
            return data
    raise InputError(_too_deep(file))


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _too_deep(file: str) -> Issue:
    return Issue("nested too deeply", file, allowed=f"at most {DEEPEST} levels")
