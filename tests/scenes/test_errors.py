"""Messages."""

import pickle

import pytest

from scenes.yaml.errors import InputError, Issue, nearest, shown


def test_error_gives_the_first_issue_and_all_of_them() -> None:
    error = InputError(Issue("one", "a.yaml", 1, ("x",), "f", "g", "h"), Issue("two", "a.yaml", 2))
    first = (error.file, error.line, error.key, error.found, error.allowed, error.suggestion)
    assert first == ("a.yaml", 1, ("x",), "f", "g", "h")
    assert str(error).splitlines() == ["a.yaml:1: x: one; did you mean 'h'? Found f, allowed: g", "a.yaml:2: two"]
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(ValueError, match="at least one issue"):
        InputError()


def test_of_a_path_the_last_parts_are_enough() -> None:
    nodes = ["base", "base/forward/M1", "base/forward/M2", "base/backward/M2", "base/forward/focal_plane"]
    assert nearest("M2", nodes) == "base/forward/M2"
    assert nearest("backward/m2", nodes) == "base/backward/M2"
    assert nearest("focalplane", nodes) == "base/forward/focal_plane"
    assert nearest("nothing/like/it", nodes) is None


def test_shown_is_one_short_line() -> None:
    for value in ("a\nb" * 100, {"k": 1}, {}, [1] * 99, None, True, 1.5, float("nan")):
        assert len(shown(value)) <= 60
        assert "\n" not in shown(value)
