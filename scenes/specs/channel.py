"""A monitor channel and the names of its bodies."""

from __future__ import annotations

from dataclasses import dataclass

BASE = "base"
SIDES = ("left", "right")
CENTRAL_PRISM = f"{BASE}/central_prism"


@dataclass(frozen=True)
class Channel:
    """One monitor channel of one camera.

    Attributes:
        camera, side: e.g. ``forward``, ``left`` (left = the +Y end of the line).
        pinhole, ccd: positions in the focal plane's X, Y, metres.
    """

    camera: str
    side: str
    pinhole: tuple[float, float]
    ccd: tuple[float, float]

    @property
    def key(self) -> str:
        """``<camera>/<side>``, the prefix of the channel's elements and sequences."""
        return f"{self.camera}/{self.side}"

    @property
    def reticle_body(self) -> str:
        """Body path of the pinhole."""
        return f"{BASE}/{self.camera}/focal_plane/{self.side}/reticle"

    @property
    def ccd_body(self) -> str:
        """Body path of the area CCD."""
        return f"{BASE}/{self.camera}/focal_plane/{self.side}/area_ccd"

    def prism_body(self, prism: str) -> str:
        """Body path of ``prism_180`` or ``prism_0``."""
        return f"{BASE}/{self.camera}/monitor/{self.side}/{prism}"

    @property
    def face_body(self) -> str:
        """Body path of the return face."""
        return f"{CENTRAL_PRISM}/{self.camera}_{self.side}"
