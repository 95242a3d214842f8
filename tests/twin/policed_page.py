"""Whether a page that the program wrote keeps the Content-Security-Policy that it holds; for tests."""

from __future__ import annotations

import re
from html.parser import HTMLParser

from twin.framework.page import checksum

LOADS = ("src", "srcset", "data", "poster", "background", "action", "formaction", "manifest", "ping")


class Policed(HTMLParser):
    """What a page holds that its policy speaks of.

    Attributes:
        policy: directive -> its sources; inline: (tag, type, text) of every script and style sheet; faults: what no
            policy of this kind allows.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.policy: dict[str, list[str]] = {}
        self.inline: list[tuple[str, str, str]] = []
        self.faults: list[str] = []
        self.tags: set[str] = set()
        self._in: list[str] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        if tag == "meta" and given.get("http-equiv", "").lower() == "content-security-policy":
            if self.inline:
                self.faults.append("the policy comes after what it is for")
            for directive in given["content"].split(";"):
                name, *sources = directive.split()
                self.policy[name] = sources
        if tag in ("script", "style"):
            self._in = [tag, given.get("type", ""), ""]
        for name, value in given.items():
            if name.startswith("on"):
                self.faults.append(f"<{tag} {name}>")
            if name in LOADS and not value.startswith("data:"):
                self.faults.append(f"<{tag} {name}={value[:60]!r}>")
            if name in ("href", "xlink:href") and re.match(r"\s*(javascript|vbscript|https?:|//)", value, re.I):
                self.faults.append(f"<{tag} {name}={value[:60]!r}>")
            if name == "style" and re.search(r"url\s*\(\s*['\"]?(?!#|data:)|@import|expression", value, re.I):
                self.faults.append(f"<{tag} style={value[:60]!r}>")

    def handle_data(self, data: str) -> None:
        if self._in is not None:
            self._in[2] += data

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style") and self._in is not None:
            self.inline.append((self._in[0], self._in[1], self._in[2]))
            self._in = None


def breaches(page: str) -> list[str]:
    """Where a page breaks its own policy, and where that is not strict."""
    seen = Policed(page)
    out = list(seen.faults)
    if seen.policy.get("default-src") != ["'none'"]:
        out.append("default-src")
    loose = {"script-src", "script-src-elem", "style-src-elem", "connect-src", "base-uri", "form-action"}
    for name in loose & seen.policy.keys():
        if any(not source.startswith("'sha256-") and source != "'none'" for source in seen.policy[name]):
            out.append(f"{name} {seen.policy[name]}")
    if seen.policy.get("img-src") != ["data:"]:
        out.append("img-src")
    for tag, kind, text in seen.inline:
        if tag == "script" and kind not in ("", "text/javascript", "module"):
            continue  # data, which nobody runs
        if checksum(text) not in seen.policy.get(f"{tag}-src-elem", seen.policy.get(f"{tag}-src", [])):
            out.append(f"<{tag}> is not in the policy: {text[:60]!r}")
    return out
