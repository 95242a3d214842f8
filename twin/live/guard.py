"""Who may speak to the live twin: one token, one host, one origin.

The address that the command prints carries a random token. The first request with it gets the token as a cookie, which
no script can read and no other site can send, and is led to the page without it. Every other request, and the WebSocket
before it is accepted, needs the cookie, a Host that is the server's own (a page elsewhere may have its name resolve to
127.0.0.1) and, where the browser tells it, an Origin that is the page's own.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie

TOKEN = "TWIN_LIVE_TOKEN"
"""Environment variable with a token that stays the same when the server is started again."""
SHORTEST = 22
"""Characters of such a token."""
COOKIE = "space_camera_twin"
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
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
    """

    token: str
    hosts: tuple[str, ...]

    @classmethod
    def of(cls, token: str, host: str, port: int) -> Guard:
        """That of a server that listens on a host and a port."""
        named = f"[{host}]" if ":" in host else host
        names = LOOPBACK if host in ("127.0.0.1", "localhost", "::1") else (named, *LOOPBACK)
        return cls(token, tuple(f"{name}:{port}" for name in names))

    def knows(self, token: str) -> bool:
        """Whether it is the token; takes as long whatever is wrong with it."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def refuses_host(self, headers: Mapping[str, str]) -> str:
        """Why a request's host or origin is not the server's own; empty if it is."""
        host = headers.get("host", "").lower()
        if host not in self.hosts:
            return "this server has another name"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the page comes from elsewhere"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "the page comes from elsewhere"
        return ""

    def refuses(self, headers: Mapping[str, str], socket: bool = False) -> str:
        """Why a request is refused; empty if it is not.

        Args:
            headers: of the request, names in small letters.
            socket: whether it asks for a WebSocket, for which browsers always tell the origin.
        """
        why = self.refuses_host(headers)
        if not why and socket and "origin" not in headers:
            why = "no origin"
        if not why and not self.knows(cookie_of(headers)):
            why = "open the address that the command printed"
        return why


def cookie_of(headers: Mapping[str, str]) -> str:
    """The token in a request's cookie; empty without."""
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


def cookie(token: str) -> str:
    """What sets the cookie; the token is renewed with every server, so that it needs no date."""
    return f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
