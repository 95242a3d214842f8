"""Messages."""

import pickle

import pytest

from scenes.yaml.errors import InputError, Issue, key_text, nearest, shown


def test_message() -> None:
    issue = Issue(
        "no such node", "job.yaml", 4, ("perturb", "base/M9", "shift", 2), "'base/M9'", "base/M1, base/M2", "base/M1"
    )
    assert str(issue) == (
        "job.yaml:4: perturb.base/M9.shift[2]: no such node; "
        "found 'base/M9', allowed: base/M1, base/M2; did you mean 'base/M1'?"
    )
    assert str(Issue("no such file", "job.yaml")) == "job.yaml: no such file"
    assert str(Issue("wrong", allowed="right")) == "input: wrong; allowed: right"


def test_error_gives_the_first_issue_and_all_of_them() -> None:
    error = InputError(Issue("one", "a.yaml", 1, ("x",), "f", "g", "h"), Issue("two", "a.yaml", 2))
    assert (error.file, error.line, error.key, error.found, error.allowed, error.suggestion) == (
        "a.yaml",
        1,
        ("x",),
        "f",
        "g",
        "h",
    )
    assert str(error).splitlines() == ["a.yaml:1: x: one; found f, allowed: g; did you mean 'h'?", "a.yaml:2: two"]
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(ValueError, match="at least one issue"):
        InputError()


def test_nearest() -> None:
    assert nearest("ARCSEK", ["arcsec", "deg"]) == "arcsec"
    assert nearest("zzz", ["arcsec", "deg"]) is None
    assert nearest("x", []) is None


def test_shown_is_one_short_line() -> None:
    for value in ("a\nb" * 100, {"k": 1}, {}, [1] * 99, None, True, 1.5, float("nan")):
        assert len(shown(value)) <= 60
        assert "\n" not in shown(value)


def test_key_text() -> None:
    assert key_text(("a", "b/c", 0, "d")) == "a.b/c[0].d"
