"""Who may speak to the live twin: one token, one host, one origin.

The address that the command prints carries a random token. The first request with it gets the token as a cookie, which
no script can read and no other site can send, and is led to the page without it. Every other request, and the WebSocket
before it is accepted, needs the cookie, a Host that is the server's own (a page elsewhere may have its name resolve to
127.0.0.1) and, where the browser tells it, an Origin that is the page's own.
"""

from __future__ import annotations

import os
import secrets
import socket as sockets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

TOKEN = "TWIN_LIVE_TOKEN"
"""Environment variable with a token that stays the same when the server is started again."""
SHORTEST = 22
"""Characters of such a token."""
COOKIE = "space_camera_twin_{port}"
"""Name of the cookie. Browsers keep one jar for a host, whatever the port: two servers on one host, two names."""
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that stand for all numbers of this machine."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer."""


class BadToken(ValueError):
    """A token that somebody could guess."""


def new_token() -> str:
    """The token of a server: random, or the environment's.

    Raises:
        BadToken: the environment's is too short, or has characters that a cookie cannot have.
    """
    named = os.environ.get(TOKEN, "")
    if not named:
        return secrets.token_urlsafe(24)
    if len(named) < SHORTEST or not all(c.isascii() and (c.isalnum() or c in "-_") for c in named):
        raise BadToken(f"{TOKEN} needs {SHORTEST} or more characters of A-Z, a-z, 0-9, - and _")
    return named


@dataclass(frozen=True)
class Guard:
    """What a request needs.

    Attributes:
        token: the secret.
        hosts: names under which the server is called, with their port.
        port: it listens on.
    """

    token: str
    hosts: tuple[str, ...]
    port: int

    @classmethod
    def of(cls, token: str, host: str, port: int) -> Guard:
        """That of a server that listens on a host and a port."""
        named = f"[{host}]" if ":" in host else host.lower()
        names = LOOPBACK if host in ("127.0.0.1", "localhost", "::1") else (named, *LOOPBACK)
        if host in EVERYWHERE:
            names = (*names, *(name.lower() for name in names_of_this_machine()))
        return cls(token, tuple(_called(name, port) for name in names), port)

    @property
    def cookie_name(self) -> str:
        """Of the cookie with the token."""
        return COOKIE.format(port=self.port)

    @property
    def cookie(self) -> str:
        """What sets the cookie; the token is renewed with every server, so that it needs no date."""
        return f"{self.cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def knows(self, token: str) -> bool:
        """Whether it is the token; takes as long whatever is wrong with it."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def knows_cookie(self, headers: Mapping[str, str]) -> bool:
        """Whether a request brings the token as its cookie.

        Args:
            headers: of the request, names in small letters.
        """
        return any(map(self.knows, _cookies(headers.get("cookie", ""), self.cookie_name)))

    def refuses_host(self, headers: Mapping[str, str], reached: str = "") -> str:
        """Why a request's host or origin is not the server's own; empty if it is.

        Args:
            headers: of the request, names in small letters.
            reached: number of this machine under which the request came here. A page elsewhere whose name resolves to
                it calls it by that name.
        """
        host = headers.get("host", "").lower()
        plain = reached.removeprefix("::ffff:")
        own = _called(f"[{plain}]" if ":" in plain else plain, self.port)
        if host not in self.hosts and not (plain and host == own):
            return "this server has another name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the page comes from elsewhere"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "the page comes from elsewhere"
        return ""

    def refuses(self, headers: Mapping[str, str], socket: bool = False, reached: str = "") -> str:
        """Why a request is refused; empty if it is not.

        Args:
            headers: of the request, names in small letters.
            socket: whether it asks for a WebSocket, for which browsers always tell the origin.
            reached: as of `refuses_host`.
        """
        why = self.refuses_host(headers, reached)
        if not why and socket and "origin" not in headers:
            why = "no origin"
        if not why and not self.knows_cookie(headers):
            why = "open the address that the command printed"
        return why


def _called(name: str, port: int) -> str:
    """A host as browsers write it: without the port that is HTTP's own."""
    return name if port == 80 else f"{name}:{port}"


def names_of_this_machine() -> tuple[str, ...]:
    """By which other machines may call it, the shortest first."""
    return tuple(sorted({name for name in (sockets.gethostname(), sockets.getfqdn()) if name}, key=len))


def _cookies(header: str, name: str) -> Iterator[str]:
    """Values of all cookies of a name; those of other programs on this host may be written in any way."""
    for part in header.split(";"):
        found, _, value = part.strip().partition("=")
        if found == name:
            yield value
