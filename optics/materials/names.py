"""What to say about an unknown name."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown_name(kind: str, name: str, known: Iterable[str]) -> KeyError:
    """A KeyError that names the nearest known name and lists all of them."""
    names = sorted(known)
    by_lower = {n.lower(): n for n in names}
    near = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.4)
    hint = f"; did you mean {by_lower[near[0]]!r}?" if near else ""
    return KeyError(f"unknown {kind} {name!r}{hint} (known: {', '.join(names)})")
