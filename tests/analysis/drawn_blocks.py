"""Blocks of scenes drawn from a stated truth, written from the physics and without the program's own models.

The ground is a plane with relief at 40 degrees north, the satellite flies straight on at 500 km. What a camera sees
follows from rotation matrices of scipy; errors of readings are drawn as what they are: readings through which scipy's
cubic spline runs, sums of steps, amplitudes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from analysis.block.block import Block, CameraPrior, Footprints, Pass, Points, Scene, Term, Terrain, TrackerAngle
from analysis.block.error_processes import Law
from analysis.orbit.three_line_model import LineModel, Rays

ARCSEC = np.pi / 648000.0
LAT, LON = np.radians(40.0), np.radians(116.0)
UP = np.array([np.cos(LAT) * np.cos(LON), np.cos(LAT) * np.sin(LON), np.sin(LAT)])
EAST = np.array([-np.sin(LON), np.cos(LON), 0.0])
NORTH = np.cross(UP, EAST)
CENTRE = 6.369e6 * UP
ALTITUDE, SPEED, FOCAL, PITCH = 500e3, 7.1e3, 5.5, 7e-6
LOOKS = {"fore": np.radians(26.0), "back": np.radians(-5.0)}
BEYOND = 30
"""Readings beyond the ends of a pass: a cubic spline forgets its ends by a factor of 0.27 a reading."""


@dataclass(frozen=True)
class Plan:
    """What is drawn.

    Attributes:
        passes: number of passes. cameras: of LOOKS, in each.
        ties, control, check: points of each role.
        attitude, station: laws of the readings' errors, as (law, scope).
        image: sigma in x and y, metres. control_sigma: plan and height, metres.
        camera: sigma of d_alpha, d_beta, d_gamma (radians) and d_f (metres), constant in all passes and of each.
        monitor: sigma of a reading of these; None for none.
        footprints: of each pass; laser: sigma of range, metres, and pointing, radians.
        terrain: sigma of a height and of all heights, metres; None for none.
        angle: sigma of the angles between two trackers that the passes have in turn; None for one tracker.
    """

    passes: int = 2
    cameras: tuple[str, ...] = ("fore", "back")
    ties: int = 40
    control: int = 5
    check: int = 10
    attitude: tuple[Term, ...] = (Term(Law("bias", "constant", (3 * ARCSEC,) * 3)),)
    station: tuple[Term, ...] = (Term(Law("orbit", "constant", (0.5, 0.5, 0.5))),)
    image: float = 0.3 * PITCH
    control_sigma: tuple[float, float] = (0.2, 0.3)
    camera: tuple[tuple[float, ...], tuple[float, ...]] = (
        (2 * ARCSEC, 2 * ARCSEC, 4 * ARCSEC, 30e-6),
        (1 * ARCSEC, 1 * ARCSEC, 2 * ARCSEC, 15e-6),
    )
    monitor: tuple[float, ...] | None = (0.3 * ARCSEC, 0.3 * ARCSEC, 2 * ARCSEC, 10e-6)
    footprints: int = 2
    laser: tuple[float, float] = (0.2, 3e-6)
    terrain: tuple[float, float] | None = (4.0, 1.0)
    angle: float | None = 0.5 * ARCSEC
    half: float = 5e3


@dataclass(frozen=True)
class Drawn:
    """A block and the truth.

    Attributes:
        block: what was observed.
        ground: (m, 3) true points.
    """

    block: Block
    ground: np.ndarray


def basis(law: Law, times: np.ndarray, moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values of a law at times from unknowns: matrix (n, k), and the unknowns' covariance (k, k) at unit sigma."""
    first, last = float(moments.min()), float(moments.max())
    middle = 0.5 * (first + last)
    if law.kind == "constant":
        return np.ones((len(times), 1)), np.eye(1)
    if law.kind == "rate":
        return (times - middle)[:, None], np.eye(1)
    if law.kind == "orbital":
        phase = 2 * np.pi * times / law.time
        return np.stack([np.cos(phase), np.sin(phase)], axis=1), np.eye(2)
    h = law.interval
    if law.kind == "white":
        number = np.arange(np.floor(first / h) - BEYOND, np.floor(last / h) + BEYOND + 1)
        return make_interp_spline(h * number, np.eye(len(number)), k=3)(times), np.eye(len(number))
    knots = np.unique(np.concatenate([np.floor(moments / h), np.floor(moments / h) + 1]))
    number = np.arange(knots[0], knots[-1] + 1)
    line = make_interp_spline(h * number, np.eye(len(number)), k=1)(times)
    alike = np.exp(-h * np.abs(number[:, None] - number) / law.time) if law.time else None
    if law.kind == "slow":
        return line, alike
    if law.kind == "jitter":
        # amplitude and phase as a cosine and a sine, each by itself a slow process
        phase = 2 * np.pi * law.frequency * times[:, None]
        return np.concatenate([line * np.cos(phase), line * np.sin(phase)], axis=1), np.kron(np.eye(2), alike)
    # a walk: sums of steps, zero at the knot next to the middle; its variance is sigma^2 of the time from there
    away = h * (number - np.round(middle / h))
    same = np.sign(away)[:, None] * np.sign(away) > 0
    spread = np.where(same, np.minimum(np.abs(away)[:, None], np.abs(away)), 0.0)
    return line[:, away != 0], spread[np.ix_(away != 0, away != 0)]


def drawn_process(law: Law, times: np.ndarray, random: np.random.Generator):
    """A function of time (n,) -> (n, 3): one draw of a law over a span of times."""
    _, spread = basis(law, times[:1], times)
    values = np.linalg.cholesky(spread) @ random.standard_normal((len(spread), 3)) * np.array(law.sigma)
    return lambda t: basis(law, t, times)[0] @ values


def project(look: float, change: np.ndarray, arm_body: np.ndarray) -> np.ndarray:
    """Image (n, 2) of arms (n, 3) in body axes: real image behind the lens."""
    mount = Rotation.from_euler("Y", look).as_matrix()
    d_alpha, d_beta, d_gamma, d_f = change
    own = (
        Rotation.from_rotvec([d_beta, 0, 0])
        * Rotation.from_rotvec([0, d_alpha, 0])
        * Rotation.from_rotvec([0, 0, d_gamma])
    ).as_matrix()
    seen = arm_body @ (mount @ own)
    return -(FOCAL + d_f) * seen[:, :2] / seen[:, 2:]


def draw(plan: Plan, random: np.random.Generator, true: Plan | None = None) -> Drawn:
    """A block of a plan; where `true` is given its laws, and not the stated ones, made the errors of the readings."""
    made = true or plan
    count = plan.control + plan.ties + plan.check
    laser_count = plan.footprints * plan.passes
    total = count + laser_count
    level = np.column_stack([random.uniform(-plan.half, plan.half, (total, 2)), random.uniform(-300.0, 300.0, total)])
    ground = CENTRE + level @ np.stack([EAST, NORTH, UP])
    role = np.array(
        ["control"] * plan.control + ["tie"] * plan.ties + ["check"] * plan.check + ["tie"] * laser_count, object
    )
    trackers = ("A", "B") if plan.angle is not None else ("A",)
    passes = tuple(Pass(f"P{k}", trackers[k % len(trackers)]) for k in range(plan.passes))
    paths, times, order = {}, {}, {}
    for k, one in enumerate(passes):
        heading = np.radians(190.0 + 9.0 * k)
        along = np.sin(heading) * EAST + np.cos(heading) * NORTH
        tilt = np.radians(6.0 * (k % 3 - 1))  # about the track, so that passes see the ground from different sides
        body = np.stack([along, np.cross(-UP, along), -UP], axis=1) @ Rotation.from_euler("X", tilt).as_matrix()
        middle = CENTRE - ALTITUDE * body[:, 2] / (body[:, 2] @ -UP)
        paths[one.name] = (along, body, middle, 5900.0 * k)
        for name in plan.cameras:
            aim = body @ Rotation.from_euler("Y", LOOKS[name]).as_matrix()[:, 2]
            back = aim @ along / (aim @ -UP)
            reach = (ground - middle) @ along - back * ((middle - ground) @ UP)
            times[one.name, name] = 5900.0 * k + reach / SPEED
        down = body[:, 2] @ along / (body[:, 2] @ -UP)
        order[one.name] = 5900.0 * k + ((ground - middle) @ along - down * ((middle - ground) @ UP)) / SPEED
    used = {
        p.name: np.concatenate(
            [times[p.name, c] for c in plan.cameras]
            + ([order[p.name][_hits(plan, k, count)]] if plan.footprints else [])
        )
        for k, p in enumerate(passes)
    }
    turn, shift = ({p.name: [] for p in passes} for _ in range(2))
    constants = {}
    for terms, kept in ((made.attitude, turn), (made.station, shift)):
        for term in terms:
            scopes: dict[str, list[str]] = {}
            for one in passes:
                scope = {"pass": one.name, "tracker": one.tracker, "block": ""}[term.scope]
                scopes.setdefault(scope, []).append(one.name)
            for scope, names in scopes.items():
                process = drawn_process(term.law, np.concatenate([used[n] for n in names]), random)
                if term.scope == "tracker":
                    constants[scope] = process(np.zeros(1))[0]
                for name in names:
                    kept[name].append(process)

    def summed(parts):
        return lambda t: sum((f(t) for f in parts), np.zeros((len(t), 3)))

    turn, shift = ({k: summed(v) for k, v in d.items()} for d in (turn, shift))
    common, own = np.array(plan.camera)
    constant = {c: common * random.standard_normal(4) for c in plan.cameras}
    change = {f"{p.name}/{c}": constant[c] + own * random.standard_normal(4) for p in passes for c in plan.cameras}
    size = len(passes)
    law = np.kron(np.ones((size, size)), np.diag(common**2)) + np.kron(np.eye(size), np.diag(own**2))
    known = {c: CameraPrior(np.zeros((size, 4)), law) for c in plan.cameras}
    monitored = None
    if plan.monitor is not None:
        monitored = {}
        sigma = np.array(plan.monitor)
        noise = np.kron(np.eye(size), np.diag(sigma**2))
        gain = law @ np.linalg.inv(law + noise)
        for c in plan.cameras:
            read = np.array([change[f"{p.name}/{c}"] for p in passes]) + sigma * random.standard_normal((size, 4))
            monitored[c] = CameraPrior((gain @ read.ravel()).reshape(size, 4), law - gain @ law)

    def at(name: str, when: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reading of the station (n, 3), of the attitude (n, 3, 3), and true body axes in place of the latter."""
        along, body, middle, start = paths[name]
        station = middle + SPEED * (when - start)[:, None] * along
        bodies = np.broadcast_to(body, (len(when), 3, 3))
        return station, bodies, bodies @ Rotation.from_rotvec(turn[name](when)).as_matrix()

    scenes, footprints = [], []
    for k, one in enumerate(passes):
        axes = paths[one.name][1]
        hits = _hits(plan, k, count)
        for c in plan.cameras:
            when = times[one.name, c]
            station, body, true_body = at(one.name, when)
            arm = np.einsum("nji,nj->ni", true_body, ground - station - shift[one.name](when) @ axes.T)
            image = project(LOOKS[c], change[f"{one.name}/{c}"], arm)
            image = image + plan.image * random.standard_normal(image.shape)
            rays = Rays.of(np.arange(total), image, station, body, when)
            scenes.append(Scene(f"{one.name}/{c}", one.name, c, rays))
        if plan.footprints:
            when = order[one.name][hits]
            station, body, true_body = at(one.name, when)
            arm = np.einsum("nji,nj->ni", true_body, ground[hits] - station - shift[one.name](when) @ axes.T)
            far = np.linalg.norm(arm, axis=1)
            aim = arm / far[:, None] + plan.laser[1] * random.standard_normal((len(hits), 3))
            aim = aim / np.linalg.norm(aim, axis=1, keepdims=True)
            measured = far + plan.laser[0] * random.standard_normal(len(hits))
            footprints.append(Footprints(one.name, hits, when, station, body, aim, measured, plan.laser))
    frame = np.stack([EAST, NORTH, UP])
    start = ground + random.standard_normal((total, 3)) * 20.0
    flat, high = plan.control_sigma
    spread = frame.T @ np.diag([flat**2, flat**2, high**2]) @ frame
    start[: plan.control] = (
        ground[: plan.control] + random.standard_normal((plan.control, 3)) @ np.linalg.cholesky(spread).T
    )
    terrain = None
    if plan.terrain is not None:
        here = np.arange(plan.control, count)
        error = plan.terrain[0] * random.standard_normal(len(here)) + plan.terrain[1] * random.standard_normal()
        place = ground[here] + error[:, None] * UP
        normal, height = np.broadcast_to(UP, (len(here), 3)), np.full(len(here), plan.terrain[0])
        terrain = Terrain(here, place, normal, height, plan.terrain[1])
    angles: tuple[TrackerAngle, ...] = ()
    if plan.angle is not None and set(constants) == {"A", "B"}:
        value = constants["A"] - constants["B"] + plan.angle * random.standard_normal(3)
        angles = (TrackerAngle(("A", "B"), tuple(value.tolist()), (plan.angle,) * 3),)
    ids = np.array([f"{r[0]}{k}" for k, r in enumerate(role)], object)
    points = Points(ids, start, role, np.broadcast_to(spread, (total, 3, 3)).copy())
    cameras = {c: LineModel.of(Rotation.from_euler("Y", LOOKS[c]).as_matrix(), (FOCAL, 0, 0)) for c in plan.cameras}
    block = Block(
        passes, tuple(scenes), cameras, known, plan.attitude, plan.station, plan.image, points, monitored,
        tuple(footprints), terrain, angles,
    )  # fmt: skip
    return Drawn(block, ground)


def _hits(plan: Plan, k: int, count: int) -> np.ndarray:
    return count + plan.footprints * k + np.arange(plan.footprints)


def without_errors_in_images(drawn: Drawn, scene: str, rows: np.ndarray, shift: np.ndarray) -> Drawn:
    """The block with some image points of a scene moved by (k, 2) metres."""
    (one,) = (s for s in drawn.block.scenes if s.name == scene)
    image = one.rays.image.copy()
    image[rows] += shift
    moved = replace(one, rays=replace(one.rays, image=image))
    scenes = tuple(moved if s is one else s for s in drawn.block.scenes)
    return replace(drawn, block=replace(drawn.block, scenes=scenes))
