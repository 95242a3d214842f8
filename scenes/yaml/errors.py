"""Input errors that a user can act on: file, line, key, the value there, the values allowed, the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass

KeyPath = tuple[str | int, ...]
"""Position of a value in a YAML file: keys and list indices from the root, for instance ("perturb", "base/forward/M2",
"shift", 2).
"""

LONGEST_SHOWN = 60
"""Number of characters after which a value is cut in a message: enough to recognise it, and the message stays on one
line.
"""


@dataclass(frozen=True)
class Issue:
    """Single fault of an input.

    Attributes
    ----------
    problem : str
        Short text of the fault.
    file : str
        Path as the user wrote it; "" if the input did not come from a file.
    line : int | None
        Line number, counted from 1; None if unknown.
    key : KeyPath
        Position in the file; empty for the file as a whole.
    value : str | None
        The value in the file; None if showing it would not help.
    allowed : str | None
        The values that are allowed there.
    suggestion : str | None
        The nearest valid name.
    """

    problem: str
    file: str = ""
    line: int | None = None
    key: KeyPath = ()
    value: str | None = None
    allowed: str | None = None
    suggestion: str | None = None

    def __str__(self) -> str:
        position = self.file or "input"
        if self.line is not None:
            position += f":{self.line}"
        if self.key:
            position += f": {key_text(self.key)}"
        text = f"{position}: {self.problem}"
        details = [] if self.value is None else [f"found {self.value}"]
        details += [] if self.allowed is None else [f"allowed: {self.allowed}"]
        rest = ", ".join(details)
        if self.suggestion is not None:  # comes first because the list of allowed values can be long
            text += f"; did you mean {self.suggestion!r}?" + (f" {rest[0].upper()}{rest[1:]}" if rest else "")
        elif rest:
            text += f"; {rest}"
        return printable(text)


class InputError(Exception):
    """Input that cannot be used, with one or more issues; a command ends with exit code 2 on it.

    The message has one line for each issue.

    Attributes
    ----------
    issues : tuple of Issue
        All issues.
    file, line, key, value, allowed, suggestion
        Fields of the first issue.
    """

    def __init__(self, *issues: Issue) -> None:
        if not issues:
            raise ValueError("an InputError needs at least one issue")
        super().__init__(*issues)
        self.issues, first = issues, issues[0]
        self.file, self.line, self.key = first.file, first.line, first.key
        self.value, self.allowed, self.suggestion = first.value, first.allowed, first.suggestion

    def __str__(self) -> str:
        return "\n".join(str(issue) for issue in self.issues)


class Problem(ValueError):
    """Fault of a value, raised by a reader that does not know where in the file the value is.

    Attributes
    ----------
    problem, value, allowed, suggestion
        Fields as in `Issue`.
    within : KeyPath
        Position of the fault inside the value; empty for the value as a whole.
    """

    def __init__(
        self,
        problem: str,
        value: str | None = None,
        allowed: str | None = None,
        suggestion: str | None = None,
        within: KeyPath = (),
    ) -> None:
        super().__init__(problem, value, allowed, suggestion, within)
        self.problem, self.value, self.allowed, self.suggestion = problem, value, allowed, suggestion
        self.within = within

    def __str__(self) -> str:
        return self.problem

    def below(self, *key: str | int) -> Problem:
        """Return the problem with a key put before its position, for a value inside a mapping or list."""
        return Problem(self.problem, self.value, self.allowed, self.suggestion, (*key, *self.within))

    def at(self, file: str = "", line: int | None = None, key: KeyPath = ()) -> Issue:
        """Return the issue of this problem for a value at a given file, line and key."""
        return Issue(self.problem, file, line, (*key, *self.within), self.value, self.allowed, self.suggestion)


def unknown(
    problem: str, name: object, known: Iterable[str], within: KeyPath = (), allowed: str | None = None
) -> Problem:
    """Return the problem of an unknown name, with the known names and the nearest of them, for the caller to raise.

    Parameters
    ----------
    problem : str
        Short text of the fault, such as "no such line".
    name : object
        The unknown name.
    known : Iterable[str]
        Names that are allowed.
    within : KeyPath
        Position of the name inside the value.
    allowed : str | None
        Text of what is allowed, where the list of names is not enough.
    """
    names = tuple(known)
    return Problem(problem, shown(name), allowed or names_text(names), nearest(str(name), names), within)


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the known name nearest to `name`, ignoring case, or None if none is near.

    For a path, its last parts are enough: M2 is near to base/forward/M2.
    """
    wanted = name.casefold()
    folded = {candidate.casefold(): candidate for candidate in names}
    parts = wanted.count("/") + 1
    tails = {"/".join(candidate.split("/")[-parts:]): candidate for candidate in reversed(folded)}
    for known in ({candidate: candidate for candidate in folded}, tails):
        matches = difflib.get_close_matches(wanted, known, n=1, cutoff=0.6)
        if matches:
            return folded[known[matches[0]]]
    return None


def key_text(key: KeyPath) -> str:
    """Return a key path as text: `perturb.base/forward/M2.shift[2]`."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def shown(value: object) -> str:
    """Return a value as messages show it: on one line, cut to `LONGEST_SHOWN` characters, text in quotes."""
    if isinstance(value, dict):
        text = "a mapping" + (f" with keys {names_text(value)}" if value else " without keys")
    elif isinstance(value, list):
        text = f"a list of {len(value)}"
    elif value is None:
        return "nothing"
    elif isinstance(value, bool):
        return str(value).lower()
    else:
        text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 3] + "..."


def printable(text: str) -> str:
    """Return the text on one line, with control characters replaced by escape sequences.

    A terminal would otherwise act on them.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def names_text(names: Iterable[object]) -> str:
    """Return names as a readable list: `a, b, c`."""
    return ", ".join(str(name) for name in names)
