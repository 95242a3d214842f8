"""Why a point was not matched."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["Reason"]


class Reason(IntEnum):
    """Code of a verdict; `text` says it in words."""

    ACCEPTED = 0
    TEMPLATE = 1
    OUTSIDE = 2
    IMAGE = 3
    SATURATED = 4
    FLAT = 5
    BORDER = 6
    WEAK = 7
    AMBIGUOUS = 8
    DIVERGED = 9
    MOVED = 10
    DISTORTED = 11
    UNCERTAIN = 12
    RELIEF = 13
    UNTESTED = 14

    @property
    def text(self) -> str:
        """Reason in words."""
        return _TEXTS[self]


_TEXTS = {
    Reason.ACCEPTED: "accepted",
    Reason.TEMPLATE: "the template or its predicted place is not finite",
    Reason.OUTSIDE: "the template does not fit into the image at its predicted place",
    Reason.IMAGE: "pixels of the image under the template are not finite",
    Reason.SATURATED: "pixels of the image under the template are saturated",
    Reason.FLAT: "too little texture",
    Reason.BORDER: "the best correlation lies on the border of the search window",
    Reason.WEAK: "the correlation is too low",
    Reason.AMBIGUOUS: "another place correlates nearly as well",
    Reason.DIVERGED: "least squares matching did not converge",
    Reason.MOVED: "least squares matching left the correlation's peak",
    Reason.DISTORTED: "the affine change is too large",
    Reason.UNCERTAIN: "the standard deviation is too large",
    Reason.RELIEF: "parts of the window are displaced against each other",
    Reason.UNTESTED: "windows have steps of displacement here, and this one is too weak to show one",
}
