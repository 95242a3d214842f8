"""Messages."""

import pickle

import pytest

from scenes.yaml.errors import InputError, Issue, key_text, nearest, shown, unknown


def test_message() -> None:
    issue = Issue(
        "no such node", "job.yaml", 4, ("perturb", "base/M9", "shift", 2), "'base/M9'", "base/M1, base/M2", "base/M1"
    )
    assert str(issue) == (
        "job.yaml:4: perturb.base/M9.shift[2]: no such node; did you mean 'base/M1'? "
        "Found 'base/M9', allowed: base/M1, base/M2"
    )
    assert str(Issue("wrong", "a.yaml", found="x", allowed="y")) == "a.yaml: wrong; found x, allowed: y"
    assert str(Issue("wrong", "a.yaml", suggestion="y")) == "a.yaml: wrong; did you mean 'y'?"
    assert str(Issue("no such file", "job.yaml")) == "job.yaml: no such file"
    assert str(Issue("wrong", allowed="right")) == "input: wrong; allowed: right"


def test_error_gives_the_first_issue_and_all_of_them() -> None:
    error = InputError(Issue("one", "a.yaml", 1, ("x",), "f", "g", "h"), Issue("two", "a.yaml", 2))
    first = (error.file, error.line, error.key, error.found, error.allowed, error.suggestion)
    assert first == ("a.yaml", 1, ("x",), "f", "g", "h")
    assert str(error).splitlines() == ["a.yaml:1: x: one; did you mean 'h'? Found f, allowed: g", "a.yaml:2: two"]
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(ValueError, match="at least one issue"):
        InputError()


def test_nearest() -> None:
    assert nearest("ARCSEK", ["arcsec", "deg"]) == "arcsec"
    assert nearest("zzz", ["arcsec", "deg"]) is None
    assert nearest("x", []) is None


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


def test_key_text() -> None:
    assert key_text(("a", "b/c", 0, "d")) == "a.b/c[0].d"


def test_a_name_that_is_not_known() -> None:
    wrong = unknown("no such line", "nadr", ("forward", "nadir"), ("lines",))
    assert (wrong.found, wrong.allowed, wrong.suggestion) == ("'nadr'", "forward, nadir", "nadir")
    issue = wrong.below("camera").at("a.yaml", 3, ("test",))
    assert str(issue) == (
        "a.yaml:3: test.camera.lines: no such line; did you mean 'nadir'? Found 'nadr', allowed: forward, nadir"
    )
    assert unknown("no such line", 5, ("nadir",), allowed="a line").allowed == "a line"
