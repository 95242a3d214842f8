"""Tolerances: ten thousand cameras with nine fields and three compensators, every one traced exactly and adjusted; and
cameras of a telescope with a refocus beside optiland's tolerancing of it, in turns.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from scenes.specs.tolerance import resolve_tolerance
from scenes.yaml.yaml_file import dump_yaml
from tests.benchmarks.number import Number, Speed
from tests.benchmarks.stopwatch import Work, in_turns
from tests.benchmarks.workbench import Workbench, absent, installed
from twin.run.memory import largest_memory
from twin.tolerance.merit_models import sensitivities
from twin.tolerance.samples import Workforce, draw_samples
from twin.tolerance.tolerance_bench import ToleranceBench

CAMERAS, QUICK_CAMERAS = 10_000, 400
PEERS = ("batoid", "optiland")
"""What the comparison needs: optiland, and batoid for the rays that it is given."""
REFOCUSED, THEIRS, ROUNDS = 1200, 40, 3
MOTIONS = ("shift x", "shift y", "shift z", "rotate x", "rotate y", "radius")
LIMITS = {"shift": "10 um", "rotate": "5 arcsec", "radius": "20 ppm"}
BUDGET = {
    "instrument": "gf7",
    "tolerances": {
        f"{mirror}_{motion.replace(' ', '_')}": {"motion": f"{mirror} {motion}", "limit": LIMITS[motion.split()[0]]}
        for mirror in ("M1", "M2", "M3")
        for motion in MOTIONS
    },
    "compensators": {
        "focus": {"motion": "focal_plane shift z", "range": "1 mm"},
        "turn_x": {"motion": "M2 rotate x", "range": "2 arcmin"},
        "turn_y": {"motion": "M2 rotate y", "range": "2 arcmin"},
    },
    "merits": {
        "wavefront": {"kind": "wavefront", "at_most": 0.0714},
        "mtf": {"kind": "mtf", "at_least": 0.38},
        "principal_distance": {"kind": "principal_distance", "at_most": "0.5 mm"},
    },
}


def beside_optiland(bench: Workbench, quick: bool) -> tuple[Number, ...]:
    """How many times the twin's processor time of a camera optiland's is: where one operand traces the rays of all
    fields at once, and where each field is an operand of optiland's own wavefront.
    """
    from tests.oracles.tolerance_optiland import BUDGET as TWENTY
    from tests.oracles.tolerance_optiland import Peer, twin_budget

    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numba's remarks on optiland's code
        camera = ToleranceBench(twin_budget(Path(name)), bench.backend)
        peer = Peer(camera.optics.model, camera.fields)
        peer.register()
        drawn = np.random.default_rng(1).uniform(-1.0, 1.0, (REFOCUSED, len(camera.numbers))) * camera.sizes
        untilted = [key for key in TWENTY if "tilt" not in key]  # optiland's pupil is paraxial
        counts = {"twin": REFOCUSED, "optiland": THEIRS, "optiland_own_wavefronts": 2}

        def twin(_: Any) -> Any:
            return camera.try_out(drawn)

        works = {
            "twin": Work(twin),
            "optiland": Work(lambda _: peer.drawn(peer.tolerancing(), list(TWENTY), THEIRS)),
            "optiland_own_wavefronts": Work(lambda _: peer.drawn(peer.tolerancing(own=True), untilted, 2)),
        }
        twin(None)
        spent = in_turns(works, 1 if quick else ROUNDS)
    each = {key: 1e3 * one.cpu_s / counts[key] for key, one in spent.items()}
    words = {"optiland": "one operand of all fields", "optiland_own_wavefronts": "its own wavefronts"}
    out = [Number("refocused_ms", each["twin"], "processor time of a camera of three mirrors, refocused", "ms")]
    for key, what in words.items():
        text = f"  times as much in optiland, {what}"
        out.append(Number(f"times_{key}", each[key] / each["twin"], text))
    return tuple(out)


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds from the start of two workers to the last camera; processor time of a camera; of all derivatives."""
    count = QUICK_CAMERAS if quick else CAMERAS
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "budget.yaml"
        file.write_text(dump_yaml(BUDGET), "utf-8")
        setup = resolve_tolerance(file)
        camera = ToleranceBench(setup, bench.backend)
        sensitivities(camera)  # compiles
        start = time.process_time()
        sensitivities(camera)
        derived = time.process_time() - start
        start = time.monotonic()
        drawn = draw_samples(setup, camera, bench.backend, count, 1, Workforce(2, None, Path(name) / "journal"))
        spent = time.monotonic() - start
    assert not any(drawn.problems)
    assert np.all(np.isfinite(drawn.values))
    text = f"{count} cameras with nine fields and three compensators, two workers"
    missing = [peer for peer in PEERS if not installed(peer)]
    each = 1e3 * drawn.seconds / count
    return Speed(
        (
            Number("seconds", spent, text, "s"),
            Number("camera_ms", each, "  processor time of a camera", "ms"),
            Number("derivatives_ms", 1e3 * derived, f"  first and second derivatives by {len(camera.numbers)}", "ms"),
            Number("memory_mb", 1e-6 * largest_memory(), "  memory of this process", "MB"),
            *(() if missing else beside_optiland(bench, quick)),
        ),
        tuple(absent(peer) for peer in missing),
    )
