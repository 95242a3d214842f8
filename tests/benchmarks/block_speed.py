"""A block of a hundred scenes with a million tie points, adjusted at once: time and memory over three sizes.

Each size is adjusted in a process of its own on one thread, as `python -m twin.orbit adjust` does without workers.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

from analysis.block.block import Block, CameraPrior, Pass, Points, Scene, Term
from analysis.block.block_adjustment import adjust_block
from analysis.block.error_processes import Law
from analysis.orbit.three_line_model import LineModel, Rays
from optics.numerics.backend import one_blas_thread
from tests.analysis.drawn_blocks import (
    ALTITUDE,
    ARCSEC,
    CENTRE,
    EAST,
    FOCAL,
    LOOKS,
    NORTH,
    PITCH,
    SPEED,
    UP,
    drawn_process,
    project,
)
from tests.benchmarks.workbench import Number, Speed, Workbench

TIES, QUICK_TIES = 1_000_000, 20_000
"""Of the largest of three sizes; the others have a quarter and a half."""
ROWS, COLUMNS = 5, 10
"""Passes along and across: each takes two scenes."""
SWATH, LENGTH = 30e3, 30e3
ACROSS, ALONG = 15e3, 25e3
"""Between neighbouring passes: half of a scene is seen by the next beside it, a sixth by the next after it."""
CONTROL, IMAGE = 40, 0.3 * PITCH
LAWS = (
    Term(Law("mounting", "constant", (3 * ARCSEC,) * 3)),
    Term(Law("readings", "white", (0.5 * ARCSEC,) * 3, 0.5)),
    Term(Law("gyro", "walk", (0.1 * ARCSEC,) * 3, 1.0)),
)
ORBIT = (Term(Law("orbit", "constant", (0.5, 0.5, 0.5))),)
CAMERA = np.array([2 * ARCSEC, 2 * ARCSEC, 4 * ARCSEC, 30e-6])


def large_block(ties: int, seed: int = 1) -> tuple[Block, np.ndarray]:
    """A block of 100 scenes of 30 km, and its true points (m, 3), ITRS, metres.

    Args:
        ties: tie points, evenly over 165 km by 130 km; most are seen by four scenes.
        seed: of all that is drawn.
    """
    random = np.random.default_rng(seed)
    count = ties + CONTROL
    half = 0.5 * np.array([(COLUMNS - 1) * ACROSS + SWATH, (ROWS - 1) * ALONG + LENGTH])
    level = np.column_stack([random.uniform(-half, half, (count, 2)), random.uniform(-300.0, 300.0, count)])
    ground = CENTRE + level @ np.stack([EAST, NORTH, UP])
    own = np.full((count, 3, 3), 0.0)
    own[:CONTROL] = 0.3**2 * np.eye(3)
    start = ground + 20.0 * random.standard_normal((count, 3))
    start[:CONTROL] = ground[:CONTROL] + 0.3 * random.standard_normal((CONTROL, 3))
    passes, scenes = [], []
    body = np.stack([-NORTH, -EAST, -UP], axis=1)
    for k in range(ROWS * COLUMNS):
        column, row = divmod(k, ROWS)
        place = np.array([(column + 0.5) * ACROSS + 0.5 * (SWATH - ACROSS), row * ALONG + 0.5 * LENGTH]) - half
        turned = (
            body @ Rotation.from_euler("ZX", [random.uniform(-0.02, 0.02), random.uniform(-0.02, 0.02)]).as_matrix()
        )
        along = turned[:, 0] - UP * (turned[:, 0] @ UP)
        along = along / np.linalg.norm(along)
        # where body Z looks at the middle of the pass
        middle = CENTRE + place @ np.stack([EAST, NORTH]) - ALTITUDE * turned[:, 2] / (turned[:, 2] @ -UP)
        begin = 5900.0 * k
        near = np.abs(level[:, :2] - place)
        seen = np.flatnonzero((near[:, 0] < 0.5 * SWATH) & (near[:, 1] < 0.5 * LENGTH))
        arm = ground[seen] - middle
        times = {}
        for name, look in LOOKS.items():
            aim = turned @ Rotation.from_euler("Y", look).as_matrix()[:, 2]
            times[name] = begin + (arm @ along - aim @ along / (aim @ -UP) * (arm @ -UP)) / SPEED
        every = np.concatenate(list(times.values()))
        turns = [drawn_process(term.law, every, random) for term in LAWS]
        shift = drawn_process(ORBIT[0].law, every, random)
        name = f"P{k:02d}"
        passes.append(Pass(name, name))
        for camera, when in times.items():
            station = middle + SPEED * (when - begin)[:, None] * along
            bodies = np.broadcast_to(turned, (len(when), 3, 3))
            true = bodies @ Rotation.from_rotvec(sum(one(when) for one in turns)).as_matrix()
            seen_from = ground[seen] - station - shift(when) @ turned.T
            image = project(LOOKS[camera], CAMERA * random.standard_normal(4), np.einsum("nji,nj->ni", true, seen_from))
            image = image + IMAGE * random.standard_normal(image.shape)
            # readings as tables give them: an array of their own for each image point
            rays = Rays.of(seen, image, station, bodies, when)
            scenes.append(Scene(f"{name}/{camera}", name, camera, rays))
    role = np.array(["control"] * CONTROL + ["tie"] * ties, object)
    points = Points(np.array([f"{r[0]}{k}" for k, r in enumerate(role)], object), start, role, own)
    law = np.kron(np.eye(len(passes)), np.diag(CAMERA**2))
    known = {name: CameraPrior(np.zeros((len(passes), 4)), law) for name in LOOKS}
    cameras = {
        name: LineModel.of(Rotation.from_euler("Y", look).as_matrix(), (FOCAL, 0, 0)) for name, look in LOOKS.items()
    }
    return Block(tuple(passes), tuple(scenes), cameras, known, LAWS, ORBIT, IMAGE, points), ground


def measured(ties: int) -> dict[str, float]:
    """Seconds, by the clock and of the processor, to adjust a block here; largest memory, GiB, of the process
    and of the block alone; and what was adjusted.
    """
    block, ground = large_block(ties)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    wall, clock = time.perf_counter(), time.process_time()
    with one_blas_thread():
        found = adjust_block(block)
    wall, clock = time.perf_counter() - wall, time.process_time() - clock
    some = np.arange(CONTROL, CONTROL + 1000)
    error = found.ground[some] - ground[some]
    spread = found.point_covariance(some)
    seen = np.isfinite(error[:, 0])
    square = np.einsum("ni,nij,nj->n", error[seen], np.linalg.inv(spread[seen]), error[seen])
    return {
        "wall_s": wall,
        "cpu_s": clock,
        "memory_GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "block_GiB": before,
        "unknowns": len(found.x),
        "images": sum(len(scene.rays.point) for scene in block.scenes),
        "p_value": found.p_value,
        "agreement": float(np.mean(square)) / 3.0,
    }


def measure(bench: Workbench, quick: bool) -> Speed:
    """Seconds by wall clock and of the processor; memory of the whole process, the drawn block included."""
    sizes = (QUICK_TIES,) if quick else (TIES // 4, TIES // 2, TIES)
    numbers, results = [], []
    for ties in sizes:
        command = [sys.executable, "-m", "tests.benchmarks.block_speed", str(ties)]
        made = subprocess.run(command, check=True, capture_output=True, text=True)
        one = json.loads(made.stdout)
        results.append(one)
        assert one["p_value"] > 1e-4
        # a point's errors are those of its covariance; 1000 points of one block err alike in parts
        assert 0.7 < one["agreement"] < 1.4
        what = (
            f"{ties:,} tie points in 100 scenes, {int(one['images']):,} image points, {int(one['unknowns'])} unknowns"
        )
        numbers += [
            Number(f"ties_{ties}_s", one["wall_s"], what, "s"),
            Number(f"ties_{ties}_cpu_s", one["cpu_s"], "  of the processor", "s"),
            Number(f"ties_{ties}_GiB", one["memory_GiB"], "  memory of the process", "GiB"),
        ]
    if not quick:
        for key, text in (("cpu_s", "time of the processor"), ("memory_GiB", "memory")):
            a, b, c = (one[key] for one in results)
            # the second half of a million points against the quarter before it: 2 where the growth is linear
            grows = (c - b) / (b - a)
            numbers.append(Number(f"{key}_grows", grows, f"  growth of the {text}, 2 is linear"))
    return Speed(tuple(numbers))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measured(int(sys.argv[1]))))
