"""Channels of a camera's monitor as a file gives them: where they may not stand, and where the file is told so."""

import copy
import random
import re
from typing import Any

import pytest

from scenes.models.obstruction import check_beams, find_obstructions
from scenes.yaml.errors import InputError
from tests.scenes import monitor_layouts
from tests.tiers import quick

NAMES = ("left", "right", "left_2", "right_2")


@pytest.fixture(scope="module")
def model(backend, tmp_path_factory):
    return monitor_layouts.built(monitor_layouts.two_beams(), tmp_path_factory.mktemp("two"), backend)


def changed(*changes: tuple[tuple[str, ...], Any]) -> dict[str, Any]:
    """The layout of two beams with other values at some keys; None takes a key away."""
    data = copy.deepcopy(monitor_layouts.two_beams())
    for key, value in changes:
        place = data
        for name in key[:-1]:
            place = place[name]
        if value is None:
            del place[key[-1]]
        else:
            place[key[-1]] = value
    return data


SECOND = ("cameras", "forward", "channels", "left_2")
BACKWARD = ("cameras", "backward", "channels", "left_2")


def test_two_beams_stand_clear(model, backend) -> None:
    assert [c.key for c in model.channels] == [f"{c}/{name}" for c in ("forward", "backward") for name in NAMES]
    check_beams(model, backend)
    found = find_obstructions(model, backend)
    assert {o.beam for o in found} == {"forward/imaging", "backward/imaging"}
    # what is not in the monitor's own part of the pupil is only just touched
    prisms = {c.prism_body("prism_180") for c in model.channels}
    assert prisms <= {o.body for o in found}
    assert all(o.body in prisms or o.share < 0.01 for o in found)
    # each 180-deg prism stands where its own channel says
    for channel in model.channels:
        given = model.spec.channels_of(channel.camera)[channel.name]
        window = model.assembly.nominal_pose(f"{channel.prism_body('prism_180')}/window/entry").translation
        home = model.assembly.nominal_pose(f"base/{channel.camera}")
        assert home.inverse().apply(window)[2] == pytest.approx(given.prism_180.distance, abs=0.01)
        assert model.assembly.elements[f"{channel.key}/return_face"].aperture.radius == 0.5 * channel.aperture


REFUSED = [
    # in each other: the later one is told, at its own key
    (
        [((*SECOND, "prism_180", "distance"), "2.41 m")],
        "cameras.forward.channels.left_2.prism_180.distance",
        ["base/forward/monitor/left/prism_180 reaches", "into base/forward/monitor/left_2/prism_180"],
    ),
    (
        [((*BACKWARD, "prism_0", "distance"), "10 mm")],
        "cameras.backward.channels.left_2.prism_0.distance",
        ["base/backward/monitor/left_2/prism_0", "base/central_prism"],
    ),
    # the same, where the monitor says it for all
    (
        [(("monitor", "prism_0", "distance"), "10 mm")],
        "monitor.prism_0.distance",
        ["base/forward/monitor/left/prism_0", "base/central_prism"],
    ),
    # cut by the pupil, by a narrow prism
    (
        [((*SECOND, "pupil_offset"), ["-295 mm", "0 mm"])],
        "cameras.forward.channels.left_2",
        ["forward/left_2"],
    ),
    (
        [((*SECOND, "prism_180", "width"), "30 mm")],
        "cameras.forward.channels.left_2.prism_180.width",
        ["narrower than the beam"],
    ),
    (
        [((*SECOND, "prism_180", "width"), "34 mm")],
        "cameras.forward.channels.left_2.prism_180.width",
        ["the beam forward/left_2 is cut at forward/left_2/prism_180/", "mm beyond the clear aperture"],
    ),
    (
        [((*SECOND, "return_face"), {"aperture": "39.9 mm"})],
        "cameras.forward.channels.left_2.prism_180.width",
        ["the beam forward/left_2 is cut at"],
    ),
    # a body in a beam that is not its own: the camera's own board
    (
        [(("monitor", "prism_0", "shift"), "200 mm")],
        "monitor.prism_0.shift",
        ["base/backward/focal_plane stands in the beam backward/left and takes 145 of its 145 rays"],
    ),
    (
        [(("baffles", "forward_housing", "length"), "800 mm")],
        "baffles.forward_housing",
        ["a plate of forward_housing stands in the beam forward/left"],
    ),
    # facets
    (
        [((*SECOND, "spread"), None)],
        "central_prism.spread",
        ["the facets of forward/left_2 and forward/left overlap"],
    ),
    (
        [((*SECOND, "spread"), ["60 mm", "80 mm"])],
        "cameras.forward.channels.left_2.spread",
        ["the facets of forward/left_2 and forward/left overlap", "at least 3"],
    ),
    (
        [((*SECOND, "spread"), ["20 mm", "50 mm"])],
        "cameras.forward.channels.left_2.spread",
        ["hide one another"],
    ),
    # boards
    (
        [((*SECOND, "field"), "1.22 deg")],
        "cameras.forward.channels.left_2.field",
        ["the boards of forward/left and forward/left_2 stand in each other", "0 mm apart"],
    ),
    (
        [((*SECOND, "field"), "1.225 deg")],
        "cameras.forward.channels.left_2.field",
        ["the boards of forward/left and forward/left_2 stand in each other"],
    ),
    ([((*SECOND, "field"), "44 deg")], "cameras.forward.channels.left_2.field", ["forward/left_2"]),
    # another kind in one channel
    (
        [((*SECOND, "prism_0"), monitor_layouts.HOLLOW_0)],
        "cameras.forward.channels.left_2.prism_0.kind",
        ["forward/left_2 has another kind of reflector", "found 'periscope'"],
    ),
    # as text
    ([((*SECOND, "field"), None)], "cameras.forward.channels.left_2.field", ["missing"]),
    ([((*SECOND, "prism_0", "material"), "N-BK77")], "cameras.forward.channels.left_2.prism_0.material", ["N-BK7"]),
    ([((*SECOND, "photons_per_frame"), 0)], "cameras.forward.channels.left_2.photons_per_frame", []),
    ([(("cameras", "forward", "channels"), {})], "cameras.forward.channels", []),
    ([(("cameras", "forward", "pupil_offset"), ["1 mm", "0 mm"])], "cameras.forward", ["both", "one of pupil_offset"]),
    ([(("cameras", "forward", "channels"), None)], "cameras.forward", ["neither", "one of pupil_offset and channels"]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "key", "words"), quick(5, REFUSED), ids=[f"{k}-{i}" for i, (_, k, _) in enumerate(REFUSED)]
)
def test_what_cannot_stand_is_told_at_its_line(changes, key, words, backend, tmp_path) -> None:
    """At the channel's own key where the file says it there; the line is that of the key, or of what holds it."""
    data = changed(*changes)
    with pytest.raises(InputError) as caught:
        monitor_layouts.built(data, tmp_path, backend)
    own = [i for i in caught.value.issues if ".".join(map(str, i.key)).startswith(key)]
    assert own, str(caught.value)
    text = str(caught.value)
    for word in words:
        assert word in text
    lines = (tmp_path / "own.yaml").read_text("utf-8").splitlines()
    issue = own[0]
    assert issue.line is not None
    assert re.match(rf"\s*(- )?({'|'.join(map(str, issue.key))})\b", lines[issue.line - 1])


JUNK = [
    *(None, "", "x", 0, -1, 1e300, True, [], {}, "0 mm", "-5 mm", "1 um", "10 m", "1e9 m", "5 deg", "-5 deg", "nan mm"),
    *("1 kg", "left", ["1 mm"], ["1 mm", "2 mm"], ["1 m", "1 m"], ["0 mm", "0 mm"], "hollow_transfer", "SiC"),
]


def edited(data: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """Something else, nothing, or another value of the file at one or two places."""
    data = copy.deepcopy(data)
    for _ in range(rng.randint(1, 2)):
        places = [(place, key) for place, key in _places(data) if place is not data or key == "cameras"]
        place, key = rng.choice(places)
        do = rng.random()
        if do < 0.2:
            del place[key]
        elif do < 0.45:
            other, name = rng.choice(places)
            place[key] = copy.deepcopy(other[name])
        elif do < 0.6 and isinstance(place[key], str) and place[key][:1] in "-123456789":
            number, _, unit = place[key].partition(" ")
            place[key] = f"{float(number) * rng.choice([-1.0, 0.5, 0.9, 1.02, 1.3, 3.0]):.6g} {unit}"
        else:
            place[key] = rng.choice(JUNK)
    return data


def _places(place: Any) -> list[tuple[Any, Any]]:
    keys = list(place) if isinstance(place, dict) else list(range(len(place))) if isinstance(place, list) else []
    return [found for key in keys for found in ((place, key), *_places(place[key]))]


def _edit(count: int, seed: int, backend, folder) -> list[str]:
    """What is said of edits that are refused; every other one is of a layout with mirrors in place of prisms."""
    rng, said = random.Random(seed), []
    glass, hollow = monitor_layouts.two_beams(), monitor_layouts.two_beams()
    for place in (hollow["monitor"], *(c for s in hollow["cameras"].values() for c in s["channels"].values())):
        for prism, kind in (("prism_180", "hollow_transfer"), ("prism_0", "periscope")):
            if prism in place:
                place[prism] = {**place[prism], "kind": kind, "material": "CFRP"}
    for base in (glass, hollow):
        monitor_layouts.built(base, folder, backend)
    for k in range(count):
        try:
            monitor_layouts.built(edited((glass, hollow)[k % 2], rng), folder, backend)
        except InputError as error:
            said.append(str(error))
    return said


@pytest.mark.second
def test_random_edits_are_refused_in_words(backend, tmp_path) -> None:
    said = _edit(20, 1, backend, tmp_path)
    assert 8 < len(said) < 20
    assert all("own.yaml" in text for text in said)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_many_random_edits_are_refused_in_words(seed, backend, tmp_path) -> None:
    said = _edit(100, 100 + seed, backend, tmp_path)
    assert all("own.yaml" in text for text in said)
