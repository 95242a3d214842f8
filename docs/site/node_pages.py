"""The page of the nodes: every body of the shipped instruments, what may be done to it, about which points it turns."""

from __future__ import annotations

from collections.abc import Mapping

import twin
from docs.site.markdown import anchor, code, table
from scenes.specs.load import INSTRUMENTS, library_names
from scenes.specs.perturbation import NodeInfo

ACTIONS = ("rotate", "shift", "scale", "figure", "radius", "conic", "index", "abbe", "temperature")
"""Columns of the tables, as they are written in a job."""


def node_page() -> str:
    """Markdown of the page."""
    parts = [
        """# Nodes of the shipped instruments

What stands under `perturb:` in a job, `base/forward/M2`, is the path of a body in the tree of parts: what is done to
a body happens to all that it carries. `rotate` and `scale` act about a *pivot*, `origin` where none is named. Axes
and signs are those of [conventions](../docs/conventions.md); keys and limits those of [a job](files/job.md).

In a script the same table is `twin.load("gf7_pair").nodes`. An instrument of your own has the nodes of its own
cameras: their names are those of its file, mirrors those of the camera's file.
"""
    ]
    for name in library_names(INSTRUMENTS):
        nodes = twin.load(name).experiment.instrument.nodes
        parts.append(f"## {code(name)}\n\n{len(nodes)} nodes.\n\n{node_table(name, nodes)}")
    return "\n".join(parts)


def node_table(name: str, nodes: Mapping[str, NodeInfo]) -> str:
    """The table of one instrument: path of a node -> what may be done to it, in the order of the paths."""
    rows = [
        [
            f"{anchor(f'{name}-{path}')}{code(path)}",
            *("✓" if action in info.allows else "" for action in ACTIONS),
            ", ".join(code(pivot) for pivot in dict.fromkeys(("origin", *info.pivots))),
        ]
        for path, info in sorted(nodes.items())
    ]
    return table(["Node", *map(code, ACTIONS), "Pivots"], rows, "nodes")
