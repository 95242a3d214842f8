"""An instrument ready to be perturbed and traced: its assembly, cameras, monitor channels and solids."""

from __future__ import annotations

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
    """An instrument ready to be perturbed and traced.

    Attributes
    ----------
    spec : InstrumentSpec
        What the YAML says.
    assembly : Assembly
        Bodies, elements, sequences.
    cameras : Mapping[str, CameraModel]
        Name -> model.
    channels : tuple[Channel, ...]
        All monitor channels, camera by camera, left before right.
    nodes : Mapping[str, NodeInfo]
        Body path -> what may be done to it.
    solids : tuple[Solid, ...]
        The prisms of all channels, camera by camera, and the central prism.
    glass_path : Mapping[str, Mapping[str, float]]
        Channel key -> prism -> length of the beam inside its glass, one way, metres.
    baffles : tuple[Plate, ...]
        Black plates that only the path tracer and pictures know.
    as_built : State
        How it stands and is shaped against the drawing; the assembly has it in it, so that nominal and the state {} are
        the instrument as built.
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
        """Nominal camera X, Y, Z in the base frame as columns, (3, 3)."""
        return self.assembly.nominal_pose(f"{BASE}/{camera}").rotation

    def toward_optics(self, placed: PlacedBodies, camera: str) -> np.ndarray:
        """Direction from the line's centre along its chief ray, upstream, in each state, world, (S, 3).

        Where rays that start at the focal plane are first sent; it rides on the focal plane.
        """
        model = self.cameras[camera]
        return model.toward_optics(placed.rotation[:, placed.index[f"{BASE}/{camera}/focal_plane"]].real)

    @property
    def separation(self) -> Mapping[str, float]:
        """Camera -> distance of its pair of area CCDs (the papers' L), metres; without a pair the largest of two.
        Empty without a monitor.
        """
        out: dict[str, float] = {}
        for name in self.cameras if self.channels else ():
            places = {c.name: c.ccd[1] for c in self.channels if c.camera == name}
            pair = [places[side] for side in SIDES] if set(SIDES) <= set(places) else list(places.values())
            out[name] = abs(max(pair) - min(pair))
        return out

    def channels_of(self, camera: str) -> tuple[int, ...]:
        """Numbers of a camera's channels among ``channels``."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.camera == camera)

    def coordinates_of(self, camera: str) -> list[int]:
        """Numbers of the rows and columns of a camera's spots among the coordinates of all."""
        return [2 * i + axis for i in self.channels_of(camera) for axis in (0, 1)]


class MisplacedError(PhysicalError, ValueError):
    """A part of the monitor cannot stand as the instrument's file says.

    Attributes
    ----------
    key
        Of the file, what to change, as it is for all channels.
    remedy
        What to choose there.
    channel
        Camera and name of the channel that it is about, which may say it itself; None for none.
    """

    def __init__(self, problem: str, key: KeyPath, remedy: str, channel: tuple[str, str] | None = None) -> None:
        super().__init__(problem)
        self.key, self.remedy, self.channel = key, remedy, channel


def key_of(path: str) -> KeyPath:
    """Key of the instrument's file that a body comes from, as it is for all channels."""
    if path.startswith(CENTRAL_PRISM):
        return (CENTRAL_KEY,)
    prism = prism_of(path)
    return ("monitor", prism) if prism is not None else ("cameras", path.split("/")[1], "pupil_offset")
