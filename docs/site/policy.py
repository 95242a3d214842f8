"""The Content-Security-Policy of the site's pages: their own files, and the few inline pieces that Sphinx writes."""

from __future__ import annotations

import re

from twin.framework.page import NOTHING, checksum, policy

OWN = "'self' file:"
"""Files of the site, on a server or in a folder; not every browser takes a folder for one origin."""
_INLINE = re.compile(r"<(script|style)\b([^>]*)>(.*?)</\1>", re.S | re.I)
_HEAD = re.compile(r"<head[^>]*>\s*(<meta charset=[^>]*>)?", re.I)
_EVENT = re.compile(r"<[a-z][^<>]*\s(on[a-z]+)\s*=", re.I)


def with_policy(text: str) -> str:
    """A page with its policy at the beginning of its head.

    Scripts and style sheets that stand in the page are allowed by their checksums; all text is the project's own.
    ``style`` attributes are allowed, since figures and highlighted programs have them.

    Raises:
        ValueError: the page has no head, or attributes that hold programs, which no checksum covers.
    """
    head = _HEAD.search(text)
    if head is None:
        raise ValueError("the page has no head")
    if found := _EVENT.search(text):
        raise ValueError(f"the page has an attribute {found[1]}, which its policy forbids")
    pieces: dict[str, list[str]] = {"script": [], "style": []}
    for tag, attributes, inside in _INLINE.findall(text):
        if "src=" not in attributes:
            pieces[tag.lower()].append(checksum(inside))
    allowed = policy(
        {
            **NOTHING,
            "script-src": " ".join([OWN, *dict.fromkeys(pieces["script"])]),
            "style-src-elem": " ".join([OWN, *dict.fromkeys(pieces["style"])]),
            "style-src-attr": "'unsafe-inline'",
            "img-src": f"{OWN} data:",
            "font-src": f"{OWN} data:",
            # the search reads pages for its excerpts, and its field is a form
            "connect-src": OWN,
            "form-action": OWN,
        }
    )
    meta = f'<meta http-equiv="Content-Security-Policy" content="{allowed}">'
    return text[: head.end()] + meta + text[head.end() :]
