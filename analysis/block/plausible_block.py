"""What is plainly wrong with a block before it is adjusted: points elsewhere than their images, points seen once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.block.block import Block
from analysis.block.processes import BlockError

FAR = 0.02
"""Radians between where a point is said to be and where its image looks: 10 km below 500 km. Orbits and attitudes are
known a hundred times better."""
_NAMED = 8


def pruned(block: Block) -> Block:
    """The block without observations of points that they do not determine: fewer than three rows at a point.

    Raises:
        BlockError: nothing is left.
    """
    rows = np.zeros(len(block.points.ids), np.intp)
    for scene in block.scenes:
        np.add.at(rows, scene.rays.point, 2)
    for one in block.footprints:
        np.add.at(rows, one.point, 3)
    if block.terrain is not None:
        np.add.at(rows, block.terrain.point, 1)
    rows[block.points.role == "control"] += 3
    good = rows >= 3
    if not np.any(good):
        raise BlockError("block: no point is seen by two scenes, and none is control")
    scenes = tuple(replace(s, rays=s.rays.taken(good[s.rays.point])) for s in block.scenes)
    terrain = block.terrain
    if terrain is not None:
        terrain = terrain.taken(good[terrain.point])
    return replace(block, scenes=scenes, terrain=terrain)


def check_places(block: Block) -> None:
    """Whether every point lies about where its images look.

    Raises:
        BlockError: points that do not, by name.
    """
    wrong: list[str] = []
    control: list[bool] = []
    for scene in block.scenes:
        rays = scene.rays
        if not len(rays.point):
            continue
        arm = block.points.start[rays.point] - rays.station
        away = np.linalg.norm(arm, axis=1, keepdims=True)
        look = np.einsum("nij,nj->ni", rays.attitude, block.cameras[scene.camera].directions(rays.image))
        apart = np.linalg.norm(np.cross(look, arm / np.maximum(away, 1.0)), axis=1)
        bad = (apart > FAR) | (np.sum(look * arm, axis=1) <= 0)
        names = block.points.ids[rays.point[bad]].tolist()
        wrong += [f"{name} in {scene.name}" for name in names]
        control += _are_control(block, rays.point[bad])
    if not wrong:
        return
    shown = ", ".join(wrong[:_NAMED]) + (f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
    hint = "are their coordinates geocentric (ITRS), in metres and in the order x, y, z?" if all(control) else (
        "are their images those of the scenes named?"
    )  # fmt: skip
    raise BlockError(f"block: these points lie more than {FAR:g} rad from where their images look: {shown}; {hint}")


def _are_control(block: Block, points: NDArray[np.intp]) -> list[bool]:
    return [bool(v) for v in (block.points.role[points] == "control").tolist()]
