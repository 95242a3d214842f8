"""Families of paths are named by how they differ from the nominal one."""

import pytest

from twin.path_tracing.path_families import MARKS, SurfaceEvent, family_name

HERE = "base/forward/monitor/left"
OUT = (
    "forward/M2",
    "forward/M1",
    f"{HERE}/prism_180/window>",
    f"{HERE}/prism_180/mirror",
    f"{HERE}/prism_180/window>",
    f"{HERE}/prism_0/entry>",
    f"{HERE}/prism_0/mirror_a",
    f"{HERE}/prism_0/exit>",
)
FACET = "base/central_prism/facet_forward_left"
GLASS = (f"{HERE}/prism_0/exit", f"{HERE}/prism_0/mirror_a", f"{HERE}/prism_0/entry", f"{HERE}/prism_0/mirror_a")
EVENTS = sorted(((mark, event) for event, mark in MARKS.items()), key=lambda pair: -len(pair[0]))


def family(*names: str) -> tuple[SurfaceEvent, ...]:
    """Events from their texts, the inverse of ``str``."""
    out = []
    for name in names:
        outside, text = name.endswith("!"), name.removesuffix("!")
        mark, event = next((mark, event) for mark, event in EVENTS if text.endswith(mark))
        out.append(SurfaceEvent(text.removesuffix(mark), event, outside))
        assert str(out[-1]) == name
    return tuple(out)


NOMINAL = family(*OUT, FACET, *OUT[::-1])


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((*OUT[:7], *GLASS, f"{HERE}/prism_0/exit>", FACET, *OUT[::-1]), "prism_0 exit, entry: double, on the way out"),
        ((*OUT[:2], f"{HERE}/prism_180/window", *OUT[1::-1]), "prism_180 window: single, without central_prism facet"),
        ((*OUT, FACET, *OUT[:0:-1], "forward/M2*"), "scattered by M2, on the way back"),
        ((*OUT, f"{FACET}*", *OUT[::-1]), "scattered by central_prism facet_forward_left"),
        ((*OUT, FACET, *OUT[:1:-1], "forward/M1!", "forward/M2"), "off M1 outside its aperture, on the way back"),
        ((*OUT[:2], "board~", *OUT[1::-1]), "diffused by board, without central_prism facet_forward_left"),
        ((*OUT, FACET, *OUT[:1:-1], "backward/M1", *OUT[1::-1]), "off backward M1, on the way back"),
        ((*OUT[:2], *OUT, FACET, *OUT[::-1]), "the nominal surfaces in another order"),
        ((), "not identified"),
    ],
)
def test_names(names, said) -> None:
    found = family_name(family(*names), NOMINAL)
    assert found == said or (said.endswith("facet") and found == f"{said}_forward_left")
    assert len(found.split()) < 16
    assert HERE not in found


def test_many_reflections_are_counted() -> None:
    window = f"{HERE}/prism_180/window"
    inside = (window, f"{HERE}/prism_180/mirror")
    for count, word in ((2, "double"), (3, "triple"), (4, "4-fold")):
        path = (*OUT[:4], *(inside * count), *OUT[4:], FACET, *OUT[::-1])
        said = family_name(family(*path), NOMINAL)
        assert said == f"prism_180 {', '.join(['window'] * count)}: {word}, on the way out"


def test_the_other_channel_keeps_its_names_apart() -> None:
    """A prism of the other side is not taken for the channel's own."""
    other = f"{HERE.replace('left', 'right')}/prism_0/top"
    said = family_name(family(*OUT[:2], f"{other}~", *OUT[1::-1]), NOMINAL)
    assert "right" in said
