"""Channels of a camera's monitor as a file gives them: where they may not stand, and where the file is told so."""

import copy
import random
from typing import Any

import pytest

from scenes.models.obstruction import check_beams, find_obstructions
from scenes.yaml.errors import InputError
from tests.scenes import monitor_layouts

NAMES = ("left", "right", "left_2", "right_2")


@pytest.fixture(scope="module")
def model(backend, tmp_path_factory):
    return monitor_layouts.built(monitor_layouts.two_beams(), tmp_path_factory.mktemp("two"), backend)


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
