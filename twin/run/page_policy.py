"""What a page that the program writes may do: a Content-Security-Policy that stands in the page itself.

A report holds texts of a user's files, and is opened from a folder or sent to somebody. All texts are escaped where
they are put in; the policy is there for the day on which one is not. It allows what the page is made of, each piece by
its checksum, and nothing else: no file beside it, no network, no form, no script that somebody's text brought along.

One thing is as loose as it has to be: ``style`` attributes are allowed, since Matplotlib gives every line of a figure
one. They can change how a page looks, and load nothing.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping

FIGURES = "*{stroke-linejoin: round; stroke-linecap: butt}"
"""The style sheet that Matplotlib writes into every figure."""
NOTHING: Mapping[str, str] = {"default-src": "'none'", "base-uri": "'none'", "form-action": "'none'"}


def checksum(text: str) -> str:
    """The source expression of one inline script or style sheet.

    Args:
        text: all that stands between its tags.
    """
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def page_policy(style: str, programs: Iterable[str] = ()) -> str:
    """The policy of a page that needs no other file.

    Args:
        style: its style sheet, all that stands between the tags.
        programs: scripts that it holds, likewise, and scripts that these put in.
    """
    scripts = [checksum(program) for program in programs]
    return policy(
        {
            **NOTHING,
            "img-src": "data:",
            "style-src-elem": f"{checksum(style)} {checksum(FIGURES)}",
            "style-src-attr": "'unsafe-inline'",
            **({"script-src": " ".join(scripts)} if scripts else {}),
        }
    )


def policy(directives: Mapping[str, str]) -> str:
    """Directives as one text."""
    return "; ".join(f"{name} {sources}" for name, sources in directives.items())
