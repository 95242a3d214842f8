"""Files of tests in orbit, written whole or with one mistake in them."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from scenes.yaml.errors import InputError


def write(folder: Path, text: str) -> Path:
    path = folder / "test.yaml"
    path.write_text(text, "utf-8")
    return path


def assert_told(
    resolve: Callable[[Path], object], folder: Path, text: str, mistake: tuple[str, str, str, Sequence[str]]
) -> None:
    """The file with one place changed is refused, at the line that holds the key, in these words.

    Args:
        resolve: reads the file.
        folder: for the file.
        text: of the right file.
        mistake: what is replaced, by what, the key that is named, words that are said.
    """
    old, new, key, words = mistake
    assert text.count(old) == 1
    path = write(folder, text.replace(old, new))
    with pytest.raises(InputError) as caught:
        resolve(path)
    told = str(caught.value)
    found = re.search(rf"{re.escape(str(path))}:(\d+): {re.escape(key)}", told)
    assert found, told
    assert key.split(".")[-1] in path.read_text("utf-8").splitlines()[int(found[1]) - 1], told
    for word in words:
        assert word in told
