"""Every file with numbers says in which frames they are, and says it right."""

import json

import pytest

from scenes.specs.procedures import PROCEDURES
from twin.run.reference_frames import FRAMES, described, frames_text, schema


def test_every_kind_of_result_has_frames():
    assert len(PROCEDURES) >= 8
    assert {procedure.kind for procedure in PROCEDURES.values() if not procedure.frames} <= set(FRAMES)
    with pytest.raises(KeyError):
        described("unheard-of", {})


def test_statements_are_whole():
    for kind, statement in FRAMES.items():
        found = described(kind, {"seed": 1})
        assert list(found) == ["schema", "reference_frames", "seed"]
        assert found["schema"] == schema(kind)
        assert statement
        for quantity, frame in statement.items():
            assert len(frame) > 10, (kind, quantity)
            assert frame in frames_text(kind)
        json.dumps(found, allow_nan=False)
