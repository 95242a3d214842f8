"""Access control of the page's server.

The address that the command prints contains a random token. The first request with it sets the token as a cookie, which
no script can read and no other site can send, and is redirected to the page without the token. Every other request, and
the WebSocket before it is accepted, needs the cookie, a Host header of this server (another site's name may resolve to
127.0.0.1) and, where the browser sends it, an Origin header of the page itself.
"""

from __future__ import annotations

import os
import secrets
import socket as sockets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

SHORTEST = 22
"""Smallest length of a token set by the environment, in characters."""
COOKIE = "space_camera_twin_{port}"
"""Name of the cookie. Browsers share cookies among all ports of a host, so that the name contains the port."""
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
"""Host addresses that stand for all interfaces of this machine."""
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
"""HTTP security headers that every answer contains."""


class BadToken(ValueError):
    """Error that the token set by the user is too easy to guess or has forbidden characters."""


def new_token(variable: str) -> str:
    """Return the token of a server: random, or set by the environment.

    Parameters
    ----------
    variable : str
        Environment variable with a token that stays valid when the server is restarted.

    Raises
    ------
    BadToken
        The token of the environment is too short, or has characters that a cookie cannot have.
    """
    token = os.environ.get(variable, "")
    if not token:
        return secrets.token_urlsafe(24)
    if len(token) < SHORTEST or not all(c.isascii() and (c.isalnum() or c in "-_") for c in token):
        raise BadToken(f"{variable} needs {SHORTEST} or more characters of A-Z, a-z, 0-9, - and _")
    return token


@dataclass(frozen=True)
class Guard:
    """Access control: conditions that a request must meet to be accepted.

    Attributes
    ----------
    token : str
        The secret token.
    hosts : tuple[str, ...]
        Host names of the server, with its port.
    port : int
        Port of the server.
    """

    token: str
    hosts: tuple[str, ...]
    port: int

    @classmethod
    def of(cls, token: str, host: str, port: int) -> Guard:
        """Return the guard of a server that listens on a host and a port."""
        named = f"[{host}]" if ":" in host else host.lower()
        names = LOOPBACK if host in ("127.0.0.1", "localhost", "::1") else (named, *LOOPBACK)
        if host in EVERYWHERE:
            names = (*names, *(name.lower() for name in names_of_this_machine()))
        return cls(token, tuple(_host_text(name, port) for name in names), port)

    @property
    def cookie_name(self) -> str:
        """Name of the cookie with the token."""
        return COOKIE.format(port=self.port)

    @property
    def cookie(self) -> str:
        """Set-Cookie header; it has no expiry date, since every server has a new token."""
        return f"{self.cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def is_token(self, token: str) -> bool:
        """Return whether a text equals the token; the comparison takes the same time for every text."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def has_token_cookie(self, headers: Mapping[str, str]) -> bool:
        """Return whether a request has the token as its cookie.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        """
        return any(map(self.is_token, _cookies(headers.get("cookie", ""), self.cookie_name)))

    def host_refusal(self, headers: Mapping[str, str], local_address: str = "") -> str:
        """Return why a request's host or origin is not the server's own; empty if it is.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        local_address : str
            Address of this machine at which the request arrived, which is accepted as a host name. A page of another
            site whose name resolves to it sends that name instead.
        """
        host = headers.get("host", "").lower()
        plain = local_address.removeprefix("::ffff:")
        own = _host_text(f"[{plain}]" if ":" in plain else plain, self.port)
        if host not in self.hosts and not (plain and host == own):
            return "the Host header does not name this server"
        origin = headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}":
            return "the request comes from another site"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "the request comes from another site"
        return ""

    def refusal(self, headers: Mapping[str, str], socket: bool = False, local_address: str = "") -> str:
        """Return why a request is refused; empty if it is accepted.

        Parameters
        ----------
        headers : Mapping[str, str]
            Headers of the request, names in lower case.
        socket : bool
            Whether it requests a WebSocket, for which browsers always send the origin.
        local_address : str
            Address of this machine at which the request arrived, which is accepted as a host name.
        """
        why = self.host_refusal(headers, local_address)
        if not why and socket and "origin" not in headers:
            why = "the Origin header is missing"
        if not why and not self.has_token_cookie(headers):
            why = "open the address that the command printed"
        return why


def _host_text(name: str, port: int) -> str:
    """Return a host as browsers write it: without the default port of HTTP."""
    return name if port == 80 else f"{name}:{port}"


def names_of_this_machine() -> tuple[str, ...]:
    """Return the host names of this machine, the shortest first."""
    return tuple(sorted({name for name in (sockets.gethostname(), sockets.getfqdn()) if name}, key=len))


def _cookies(header: str, name: str) -> Iterator[str]:
    """Yield the values of all cookies of a name; cookies of other programs on this host may have any form."""
    for part in header.split(";"):
        key, _, value = part.strip().partition("=")
        if key == name:
            yield value
