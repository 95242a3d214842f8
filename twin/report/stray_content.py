"""What the report says about ghosts and stray light."""

from __future__ import annotations

from typing import Any

from twin.path_tracing.result import Family
from twin.report.numbers import fixed, significant
from twin.results import RenderRun

STRONGEST = 4
"""Families listed of each source."""


def stray_content(run: RenderRun) -> dict[str, Any] | None:
    """Shares and families of the perturbed state; None when no stray light was asked for."""
    if run.stray is None:
        return None
    after = run.stray.after
    channels = run.experiment.path.channels
    nominal = run.photons_after - after.photons
    shares = after.share(nominal)
    rows = []
    for i, channel in enumerate(channels):
        name = f"{channel.key}/area_ccd"
        families = [pair for pair in after.traced.relative(channel.key) if pair[0].detector == name]
        families.sort(key=lambda pair: -pair[1])
        by_kind = {kind: sum(share for f, share in families if f.kind == kind) for kind in ("ghost", "stray")}
        rows.append(
            {
                "channel": channel.key,
                "share": significant(float(shares[i])),
                "ghosts": significant(by_kind["ghost"]),
                "scattered": significant(by_kind["stray"]),
                "peak": significant(float(after.photons[i].max())),
                "families": [_family(f, share, name) for f, share in families[:STRONGEST]],
            }
        )
    taken = [
        {"body": o.body, "beam": o.beam, "share": fixed(100.0 * o.share, 1), "used": fixed(100.0 * o.used, 1)}
        for o in run.stray.obstructions
    ]
    return {"paths": f"{after.paths:,}".replace(",", "\N{THIN SPACE}"), "rows": rows, "taken": taken}


def _family(family: Family, share: float, detector: str) -> dict[str, str]:
    x, y = (fixed(1e6 * c, 1) for c in family.centroid)
    way = [str(touch) for touch in family.touches]
    common = _common(way)
    text = " \N{RIGHTWARDS ARROW} ".join(step.removeprefix(common) for step in way)
    return {
        "kind": family.kind,
        "share": significant(share),
        "x": x,
        "y": y,
        "way": text or "not looked up",
        "detector": detector,
        "paths": str(family.count),
    }


def _common(way: list[str]) -> str:
    """``base/<camera>/monitor/<side>/`` of the prisms' names, which every step repeats."""
    prisms = [step for step in way if "/monitor/" in step]
    return "/".join(prisms[0].split("/")[:4]) + "/" if prisms else ""
