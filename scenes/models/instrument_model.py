"""Instrument ready to be perturbed and traced: its assembly, cameras, monitor channels and solids."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from optics.geometry.solid import Solid
from optics.geometry.tree import PlacedBodies, State
from optics.numerics.array_math import PhysicalError
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly
from scenes.models.camera_model import CameraModel
from scenes.specs.baffle import Plate
from scenes.specs.instrument import BASE, CENTRAL_KEY, CENTRAL_PRISM, SIDES, Channel, InstrumentSpec, prism_of
from scenes.specs.perturbation import NodeInfo
from scenes.yaml.errors import KeyPath


@dataclass(frozen=True, eq=False)
class Instrument:
    """Instrument ready to be perturbed and traced.

    Attributes
    ----------
    spec : InstrumentSpec
        Content of the instrument's file.
    assembly : Assembly
        Tree of rigid bodies, optical elements on them, and sequences in which light meets the elements.
    cameras : Mapping[str, CameraModel]
        Name of a camera -> its traced model.
    channels : tuple[Channel, ...]
        All monitor channels, camera by camera, left before right.
    nodes : Mapping[str, NodeInfo]
        Body path -> motions and changes that the body allows.
    solids : tuple[Solid, ...]
        The prisms of all channels, camera by camera, and the central prism.
    glass_path : Mapping[str, Mapping[str, float]]
        Channel key -> prism -> length of the beam inside its glass, one way, in metres.
    baffles : tuple[Plate, ...]
        Black plates, used by the path tracer, the shadows and the pictures.
    as_built : State
        Departures of positions and shapes from the design. The assembly includes them, so that the nominal state, {},
        is the instrument as built.
    """

    spec: InstrumentSpec
    assembly: Assembly
    cameras: Mapping[str, CameraModel]
    channels: tuple[Channel, ...]
    nodes: Mapping[str, NodeInfo]
    solids: tuple[Solid, ...]
    glass_path: Mapping[str, Mapping[str, float]]
    baffles: tuple[Plate, ...] = ()
    as_built: State = field(default_factory=FrozenMap)

    def camera_axes(self, camera: str) -> np.ndarray:
        """Return the nominal X, Y, Z of a camera in the base frame as columns, (3, 3)."""
        return self.assembly.nominal_pose(f"{BASE}/{camera}").rotation

    def toward_optics(self, placed: PlacedBodies, camera: str) -> np.ndarray:
        """Return unit vectors from the line's centre back along its chief ray, in each of S states.

        Rays that start at the focal plane are first sent along them; they rotate with the focal plane.

        Parameters
        ----------
        placed : PlacedBodies
            Poses of the bodies in S states.
        camera : str
            Name of the camera.

        Returns
        -------
        (S, 3) ndarray
            Unit vectors in the world.
        """
        model = self.cameras[camera]
        return model.toward_optics(placed.rotation[:, placed.index[f"{BASE}/{camera}/focal_plane"]].real)

    @property
    def separation(self) -> Mapping[str, float]:
        """Camera -> distance between the centres of its left and right area CCD, in metres.

        The papers listed in docs/conventions.md call it L. It is the largest distance between any two area CCDs of the
        camera if it has no such pair. Empty without a monitor.
        """
        out: dict[str, float] = {}
        for name in self.cameras if self.channels else ():
            positions = {c.name: c.ccd[1] for c in self.channels if c.camera == name}
            pair = [positions[side] for side in SIDES] if set(SIDES) <= set(positions) else list(positions.values())
            out[name] = abs(max(pair) - min(pair))
        return out

    def channels_of(self, camera: str) -> tuple[int, ...]:
        """Return the indices of a camera's channels in ``channels``."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.camera == camera)

    def coordinates_of(self, camera: str) -> list[int]:
        """Return the indices of a camera's spot coordinates in the vector of all spots' rows and columns."""
        return [2 * i + axis for i in self.channels_of(camera) for axis in (0, 1)]


class MisplacedError(PhysicalError, ValueError):
    """Error of a monitor part that cannot be placed as the instrument's file says.

    Attributes
    ----------
    key : KeyPath
        Key of the file to change, in its form for all channels.
    remedy : str
        Advice on the value to choose there.
    channel : tuple[str, str] or None
        Camera and name of the channel concerned: where the file has a key for this channel, that is the one to change.
        None if no single channel is concerned.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str, channel: tuple[str, str] | None = None) -> None:
        super().__init__(problem)
        self.key, self.remedy, self.channel = key, remedy, channel


def key_of(path: str) -> KeyPath:
    """Return the key of the instrument's file that defines a body; for parts of channels the key for all channels."""
    if path.startswith(CENTRAL_PRISM):
        return (CENTRAL_KEY,)
    prism = prism_of(path)
    return ("monitor", prism) if prism is not None else ("cameras", path.split("/")[1], "pupil_offset")
