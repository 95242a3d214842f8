"""A monitor channel and the names of its bodies."""

from __future__ import annotations

from dataclasses import dataclass

BASE = "base"
SIDES = ("left", "right")
PRISM_180, PRISM_0 = "prism_180", "prism_0"
PRISMS = (PRISM_180, PRISM_0)
"""Prisms of a channel in the order of the light: keys of ``monitor`` in an instrument's file, and the last part of the
paths of their bodies."""
CENTRAL_KEY = "central_prism"
"""Key of the central prism in an instrument's file."""
CENTRAL_PRISM = f"{BASE}/{CENTRAL_KEY}"
"""Body path of the central prism."""


def prism_of(path: str) -> str | None:
    """Which of ``PRISMS`` a body is or belongs to, by its path; None for none."""
    return next((part for part in path.split("/") if part in PRISMS), None)


def channel_of(path: str) -> tuple[str, str] | None:
    """Camera and name of the channel to whose prisms or boards a body belongs, by its path; None for no channel."""
    parts = path.split("/")
    return (parts[1], parts[3]) if len(parts) > 4 and parts[2] in ("monitor", "focal_plane") else None


@dataclass(frozen=True)
class Channel:
    """One monitor channel of one camera.

    Attributes:
        camera, side: e.g. ``forward``, ``left``: the camera's and the channel's name; those of a plain pair are
            ``left`` (the +Y end of the line) and ``right``.
        pinhole, ccd: positions in the focal plane's X, Y, metres.
        pupil_offset: of its beam's middle in the entrance pupil, X and Y, metres.
        aperture: diameter of its return face, metres.
        photons: that its spot gets in a frame.
    """

    camera: str
    side: str
    pinhole: tuple[float, float]
    ccd: tuple[float, float]
    pupil_offset: tuple[float, float]
    aperture: float
    photons: float

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
        """Body path of one of ``PRISMS``."""
        return f"{BASE}/{self.camera}/monitor/{self.side}/{prism}"

    def prism_elements(self, prism: str) -> str:
        """What the names of the elements of one of ``PRISMS`` begin with."""
        return f"{self.key}/{prism}"

    @property
    def face_body(self) -> str:
        """Body path of the return face."""
        return f"{CENTRAL_PRISM}/{self.camera}_{self.side}"
