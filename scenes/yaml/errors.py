"""What is wrong with an input, said so that the user can mend it: file, line, key, what was found, what is allowed,
what was meant.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass

KeyPath = tuple[str | int, ...]
"""Where a value stands in a YAML file: keys and list indices from the root, for instance ("perturb", "base/forward/M2",
"shift", 2).
"""

LONGEST_SHOWN = 60
"""A found value is cut after this many characters: enough to recognise it, and the message stays a line."""


@dataclass(frozen=True)
class Issue:
    """One fault of an input.

    Attributes
    ----------
    problem : str
        What is wrong, in a few words.
    file : str
        Path as the user gave it; "" if the input did not come from a file.
    line : int | None
        Counted from 1; None if unknown.
    key : KeyPath
        Where in the file; empty for the file as a whole.
    found : str | None
        What stands there, None if that says nothing.
    allowed : str | None
        What may stand there.
    suggestion : str | None
        The nearest valid name.
    """

    problem: str
    file: str = ""
    line: int | None = None
    key: KeyPath = ()
    found: str | None = None
    allowed: str | None = None
    suggestion: str | None = None

    def __str__(self) -> str:
        place = self.file or "input"
        if self.line is not None:
            place += f":{self.line}"
        if self.key:
            place += f": {key_text(self.key)}"
        text = f"{place}: {self.problem}"
        known = [] if self.found is None else [f"found {self.found}"]
        known += [] if self.allowed is None else [f"allowed: {self.allowed}"]
        rest = ", ".join(known)
        if self.suggestion is not None:  # first: the lists of what is allowed can be long
            text += f"; did you mean {self.suggestion!r}?" + (f" {rest[0].upper()}{rest[1:]}" if rest else "")
        elif rest:
            text += f"; {rest}"
        return printable(text)


class InputError(Exception):
    """An input that cannot be used: one or more issues, one a line in the message. Commands end with exit code 2 on it.

    Attributes
    ----------
    issues
        All of them.
    file, line, key, found, allowed, suggestion
        Of the first one.
    """

    def __init__(self, *issues: Issue) -> None:
        if not issues:
            raise ValueError("an InputError needs at least one issue")
        super().__init__(*issues)
        self.issues, first = issues, issues[0]
        self.file, self.line, self.key = first.file, first.line, first.key
        self.found, self.allowed, self.suggestion = first.found, first.allowed, first.suggestion

    def __str__(self) -> str:
        return "\n".join(str(issue) for issue in self.issues)


class Problem(ValueError):
    """Raised by the reader of a value, which knows what is wrong with it but not where it stands.

    Attributes
    ----------
    problem, found, allowed, suggestion
        As in `Issue`.
    within
        Where in the value the fault lies; empty for the value as a whole.
    """

    def __init__(
        self,
        problem: str,
        found: str | None = None,
        allowed: str | None = None,
        suggestion: str | None = None,
        within: KeyPath = (),
    ) -> None:
        super().__init__(problem, found, allowed, suggestion, within)
        self.problem, self.found, self.allowed, self.suggestion = problem, found, allowed, suggestion
        self.within = within

    def __str__(self) -> str:
        return self.problem

    def below(self, *key: str | int) -> Problem:
        """Tell the problem at a key within the value."""
        return Problem(self.problem, self.found, self.allowed, self.suggestion, (*key, *self.within))

    def at(self, file: str = "", line: int | None = None, key: KeyPath = ()) -> Issue:
        """The fault of the file in which the value stands."""
        return Issue(self.problem, file, line, (*key, *self.within), self.found, self.allowed, self.suggestion)


def unknown(
    problem: str, name: object, known: Iterable[str], within: KeyPath = (), allowed: str | None = None
) -> Problem:
    """A name that is none of the known ones, with these and the nearest of them, for the caller to raise.

    Parameters
    ----------
    problem : str
        What is wrong, "no such line".
    name : object
        As it was found.
    known : Iterable[str]
        Names that may stand there.
    within : KeyPath
        Where in the value it stands.
    allowed : str | None
        What may stand there, where the names alone do not say it.
    """
    names = tuple(known)
    return Problem(problem, shown(name), allowed or names_text(names), nearest(str(name), names), within)


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The one of `names` that `name` was probably meant to be, or None if none comes near. Case is ignored.

    Of a path the last parts are enough: M2 is near to base/forward/M2.
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
    """A key path as text: `perturb.base/forward/M2.shift[2]`."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def shown(value: object) -> str:
    """A found value as it appears in a message: on one line, not too long, and text in quotes."""
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
    """Text on one line without what a terminal would act upon: control characters come out as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def names_text(names: Iterable[object]) -> str:
    """Names as a list to read: `a, b, c`."""
    return ", ".join(str(name) for name in names)
