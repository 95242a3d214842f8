"""Construction of an instrument from its file: cameras, monitor channels, central prism, and departures as built."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from optics.geometry.pose import Pose, about_axis, rotation_vector, triple
from optics.geometry.solid import Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body, Motion, RigidTree, State
from optics.materials.glass import glass
from optics.materials.material import TemperatureRange, material
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.reflectors import facet_block
from optics.raytrace.system import assemble
from scenes.models import camera_model, monitor_chain
from scenes.models.camera_sharpness import no_cameras
from scenes.models.instrument_model import Instrument, MisplacedError
from scenes.models.monitor_chain import square_facets
from scenes.models.obstruction import check_beams, check_clearance, check_solids
from scenes.specs.baffle import Plate
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import BASE, CENTRAL_PRISM, Channel, InstrumentSpec
from scenes.specs.perturbation import NodeInfo, perturbation_issues, with_full_paths
from scenes.yaml.errors import InputError, Issue, KeyPath, unknown
from scenes.yaml.spec import Spec


def as_built(drawn: Instrument) -> Instrument:
    """Return an instrument with the departures from the design that its file's `as_built` lists, if any.

    Poses of bodies, shapes of surfaces and indices of lenses include them, so that the state {} is the instrument as
    built, and a perturbed state acts on top. What was derived from the design (frames, apertures, first-order numbers,
    orientations of the central prism's facets) stays that of the design.

    Parameters
    ----------
    drawn : Instrument
        The instrument as designed.

    Raises
    ------
    InputError
        A node does not exist, or does not allow the motion or change; one issue for each fault, at its file and line.
    """
    departures = drawn.spec.as_built
    if not departures:
        return drawn
    moved = with_full_paths(departures, drawn.nodes, lambda problem, name: departures[name].issue(problem))
    issues = [issue for path, what in moved.items() for issue in perturbation_issues(what, drawn.nodes, path, what, ())]
    if issues:
        raise InputError(*issues)
    state = FrozenMap({path: what.motion() for path, what in moved.items()})
    return replace(drawn, assembly=drawn.assembly.with_nominal(state), as_built=state)


def facet_alignment(instrument: Instrument, backend: Backend) -> State:
    """Return the rotations of the central prism's facets that return the beams to the middles of the area CCDs.

    In the instrument as designed they are zero. The facets of a built instrument are rotated by them when its monitor
    is mounted, after its cameras were aligned: ``compose`` them with ``as_built`` for the file of such an instrument.

    Parameters
    ----------
    instrument : Instrument
        The instrument as built.
    backend : Backend
        Backend that traces the rays.

    Returns
    -------
    State
        Body path of each facet -> its rotation about its own axes, relative to its present orientation.

    Raises
    ------
    MisplacedError
        A beam misses a mirror or a prism.
    """
    tree = instrument.assembly.tree
    square = square_facets(instrument.assembly, instrument.channels, instrument.cameras, backend).tree
    return {
        channel.face_body: Motion(
            rotate=triple(
                rotation_vector(tree[channel.face_body].pose.rotation.T @ square[channel.face_body].pose.rotation)
            )
        )
        for channel in instrument.channels
    }


_FLIP = np.diag([-1.0, 1.0, -1.0])  # area CCD in the focal plane: columns along -X, rows along +Y, facing the light


def build_instrument(
    spec: InstrumentSpec,
    camera_specs: Mapping[str, object],
    backend: Backend,
    free_beams: bool = True,
    free_bodies: bool = True,
) -> Instrument:
    """Build an instrument.

    Parameters
    ----------
    spec : InstrumentSpec
        The instrument.
    camera_specs : Mapping[str, object]
        Camera file stem -> CameraSpec, for every stem that the instrument names.
    backend : Backend
        Backend that traces the rays.
    free_beams : bool
        Refuse bodies that block monitor beams; False for comparisons of layouts that nobody would build.
    free_bodies : bool
        Refuse bodies that overlap, and apertures that extend over the edges of their faces; False for derivatives of
        layouts at such a limit.

    Raises
    ------
    InputError
        The prisms cannot be placed as the file says, the cameras are too different, or ``as_built`` does not fit the
        instrument.
    """
    cameras = tuple(camera_specs.items())
    sources = tuple((s.source.file, s.source.lines) for s in (spec, *camera_specs.values()) if isinstance(s, Spec))
    try:
        return _built(_BuildArguments(spec, cameras, backend, free_beams, free_bodies, repr((spec, cameras)), sources))
    except MisplacedError as error:
        key = error.key if error.channel is None else spec.key_of(*error.channel, error.key)
        issue = spec.issue(str(error), key, allowed=error.remedy)
        raise InputError(*_no_cameras(camera_specs, backend), issue) from error
    except InputError as error:
        first = _no_cameras(camera_specs, backend)
        if not first:
            raise
        raise InputError(*first, *error.issues) from error


@dataclass(frozen=True)
class _BuildArguments:
    """Arguments of ``build_instrument`` in a hashable form, used as key of a cache.

    Attributes
    ----------
    spec, cameras, backend, free_beams, free_bodies
        Arguments of ``build_instrument``.
    text : str
        Text of the specifications. It makes specifications that are equal but list their parts in another order
        different keys of the cache, since the order determines that of the results.
    read : tuple[tuple[str, Mapping[KeyPath, int]], ...]
        File and lines of each specification, named in later errors; equal specifications may differ in them.
    """

    spec: InstrumentSpec = field(hash=False)
    cameras: tuple[tuple[str, object], ...] = field(hash=False)
    backend: Backend
    free_beams: bool
    free_bodies: bool
    text: str
    read: tuple[tuple[str, Mapping[KeyPath, int]], ...] = field(hash=False)


@lru_cache(maxsize=8)
def _built(built: _BuildArguments) -> Instrument:
    """Return the instrument, from the cache of those built last where possible."""
    return _build(built.spec, FrozenMap(built.cameras), built.backend, built.free_beams, built.free_bodies)


def _no_cameras(camera_specs: Mapping[str, object], backend: Backend) -> tuple[Issue, ...]:
    """Return an issue for each camera of an instrument that forms no image, which explains why the build failed."""
    return no_cameras([spec for spec in camera_specs.values() if isinstance(spec, CameraSpec)], backend)


def _build(
    spec: InstrumentSpec, camera_specs: Mapping[str, object], backend: Backend, free_beams: bool, free_bodies: bool
) -> Instrument:
    """Build an instrument anew, without looking it up in the cache."""
    if spec.monitor is not None:
        monitor_chain.check_prisms(spec)
    derived: dict[str, camera_model.CameraModel] = {}
    for site in spec.cameras.values():
        if site.camera not in derived:
            if spec.monitor is not None:
                camera_specs[site.camera].require_mirrors("a camera with a monitor")  # type: ignore[attr-defined]
            derived[site.camera] = camera_model.derive_camera(camera_specs[site.camera], backend)  # type: ignore[arg-type]
    bodies = [Body(BASE)]
    if spec.central_prism is not None:
        bodies.append(Body(CENTRAL_PRISM, Pose(np.eye(3), np.array(spec.central_prism.position))))
    index: dict[str, float] = {}
    above_d: dict[str, float] = {}
    elements: dict[str, Element] = {}
    sequences: dict[str, tuple[str, ...]] = {}
    channels: list[Channel] = []
    chains: dict[str, monitor_chain.MonitorChain] = {}
    for name, site in spec.cameras.items():
        model = derived[site.camera]
        root = f"{BASE}/{name}"
        to_base = Pose(about_axis(1, site.look), np.array(site.position))
        camera_channels = _channels(spec, name, model)
        bodies += [
            *camera_model.camera_bodies(root, to_base, model),
            *_monitor_bodies(camera_model.focal_plane_body(root), camera_channels),
        ]
        elements.update({**camera_model.camera_elements(name, root, model), **_ccd_elements(camera_channels)})
        sequences.update(camera_model.camera_sequences(name, model))
        index |= {f"{root}/{lens}": n for lens, n in camera_model.glass_indices(model.spec).items()}
        above_d |= {f"{root}/{lens}": step for lens, step in camera_model.above_d_line(model.spec).items()}
        if not camera_channels:
            continue
        bodies += [Body(f"{root}/monitor"), *(Body(f"{root}/monitor/{channel.name}") for channel in camera_channels)]
        specs = spec.channels_of(name)
        distances = {channel: specs[channel.name].prism_180.distance for channel in camera_channels}
        beams = monitor_chain.leaving_beams(model, distances, to_base, backend)
        facets = monitor_chain.facet_positions(spec, beams)
        for channel in camera_channels:
            chain = monitor_chain.monitor_chain(
                spec, channel, specs[channel.name], beams[channel], facets[channel], to_base
            )
            bodies += chain.bodies
            elements.update({e.name: e for e in chain.elements})
            names = tuple(e.name for e in chain.elements)
            forward = tuple(f"{name}/{m}" for m in model.mirrors)
            sequences[f"{channel.key}/outgoing"] = (*forward[::-1], *names)
            there, back = (*forward[::-1], *names), (*names[-2::-1], *forward, f"{channel.key}/area_ccd")
            sequences[f"{channel.key}/monitor"] = (*there, *back)
            chains[channel.key] = chain
        channels += camera_channels
    solids = tuple(solid for chain in chains.values() for solid in chain.solids)
    if (block := spec.central_prism) is not None:
        mirrors = {f"facet_{c.camera}_{c.name}": c.face_body for c in channels}
        farthest = [channel_spec.spread for name in spec.cameras for channel_spec in spec.channels_of(name).values()]
        spread = max(x for x, _ in farthest), max(y for _, y in farthest)
        solids = (*solids, facet_block(CENTRAL_PRISM, block.material, mirrors, spread, block.height))
    _check_temperature(spec, solids)
    for solid in (solid for solid in solids if solid.transparent):
        index[solid.path] = glass(solid.material).vacuum_index(spec.autocollimator.wavelength)
    cameras = FrozenMap({name: derived[site.camera] for name, site in spec.cameras.items()})
    assembly = Assembly(RigidTree(tuple(bodies)), elements, sequences, index, above_d)
    _check_alike(spec, assembly)
    if channels:
        assembly = monitor_chain.square_facets(assembly, channels, cameras, backend)
    nodes = _nodes(assembly, cameras, solids)
    lengths = {key: chain.glass for key, chain in chains.items()}
    parts = (FrozenMap(nodes), solids, FrozenMap(lengths), _baffles(spec, assembly.tree))
    drawn = Instrument(spec, assembly, cameras, tuple(channels), *parts)
    instrument = as_built(drawn)
    try:
        _check_room(instrument, backend, free_beams, free_bodies)
    except (MisplacedError, InputError) as error:
        if not instrument.as_built:
            raise
        _check_room(drawn, backend, free_beams, free_bodies)
        raise InputError(_collision_issue(spec, error)) from error
    return instrument


def _check_room(instrument: Instrument, backend: Backend, free_beams: bool, free_bodies: bool) -> None:
    """Raise an error if bodies overlap or block monitor beams; the two flags select these checks."""
    if free_bodies:
        check_solids(instrument.assembly, instrument.solids)
        check_clearance(instrument)
    if free_beams and instrument.channels:
        check_beams(instrument, backend)


def _collision_issue(spec: InstrumentSpec, error: MisplacedError | InputError) -> Issue:
    """Return the issue of an instrument whose bodies collide as built but not as designed."""
    problem = error.issues[0].problem if isinstance(error, InputError) else str(error)
    first = next(iter((spec.as_built or {}).values()))
    return first.issue(
        f"the instrument fits as drawn, but as built {problem}", allowed="smaller departures from the drawing"
    )


def _check_temperature(spec: InstrumentSpec, solids: Sequence[Solid]) -> None:
    """Raise InputError if the data of a material do not cover the instrument's reference temperature."""
    named = {name: f"materials.{name}" for name in type(spec.materials).model_fields}
    used = {material(getattr(spec.materials, name)): where for name, where in named.items()}
    used |= {material(solid.material): solid.path for solid in solids}
    unknown = [stuff for stuff in used if not stuff.known.contains(spec.temperature, spec.temperature)]
    if unknown:
        least = min(unknown, key=lambda stuff: stuff.known.hottest - stuff.known.coldest)
        ends = max(stuff.known.coldest for stuff in used), min(stuff.known.hottest for stuff in used)
        all_of_them = TemperatureRange(*ends, "all materials").text
        raise spec.error(
            f"the thermal expansion of {least.name} ({used[least]}) is known only for {least.known.text}"
            f" ({least.known.source})",
            ("temperature",),
            value=f"{spec.temperature:.6g} K",
            allowed=f"{all_of_them} with these materials, or other materials",
        )


def _check_alike(spec: InstrumentSpec, assembly: Assembly) -> None:
    """Raise InputError if the cameras are too different to be traced in one batch."""
    try:
        for sequence in ("image_to_stop", "image_to_object"):
            assemble(assembly, [f"{name}/{sequence}" for name in spec.cameras], [{}])
    except ValueError as error:
        text = f"these cameras are too different for one instrument ({error})"
        alike = "cameras with the same sequence of mirrors, planes and kinds of apertures"
        raise spec.error(text, ("cameras",), allowed=alike) from error


def _channels(spec: InstrumentSpec, camera: str, model: camera_model.CameraModel) -> list[Channel]:
    """Return the monitor channels of a camera.

    Their reticles and area CCDs are placed at f tan(field) along the line CCD, with the principal distance f and the
    field angle of the file.

    Raises
    ------
    InputError
        Two of them would overlap.
    """
    if spec.monitor is None:
        return []
    ccd = spec.monitor.area_ccd
    dx, dy = ccd.offset
    out = []
    for name, channel_spec in spec.channels_of(camera).items():
        field_height = model.line_principal_distance * float(np.tan(channel_spec.field))
        beam = channel_spec.pupil_offset, channel_spec.return_face.aperture, channel_spec.photons_per_frame
        out.append(Channel(camera, name, (-dx, field_height - dy), (0.0, field_height), *beam))
    half = 0.5 * ccd.pitch * np.array([ccd.columns, ccd.rows])
    edge = 0.5 * spec.monitor.reticle.pinhole
    for first, second in combinations(out, 2):
        chips = np.abs(np.subtract(first.ccd, second.ccd)) < 2.0 * half
        pinholes = [np.abs(np.subtract(a.pinhole, b.ccd)) < half + edge for a, b in permutations((first, second))]
        if not np.all(chips) and np.any(np.all(pinholes, axis=-1)) and edge > max(half):
            raise spec.error(
                f"the pinholes are wider than the CCDs: that of {first.key} or {second.key} overlaps the other CCD",
                ("monitor", "reticle", "pinhole"),
                allowed=f"less than {2e3 * max(half):.4g} mm",
            )
        if np.all(chips) or np.any(np.all(pinholes, axis=-1)):
            apart = 1e3 * abs(second.ccd[1] - first.ccd[1])
            raise spec.error(
                f"the boards of {first.key} and {second.key} overlap: their CCDs are only {apart:.4g} mm apart",
                spec.key_of(camera, second.name, ("monitor", "field")),
                allowed=f"fields that leave room for CCDs of {2e3 * half[1]:.4g} mm and the pinholes beside them",
            )
    return out


def _monitor_bodies(plane_root: str, channels: list[Channel]) -> list[Body]:
    """Return the bodies of the boards at both ends of the line CCD, with their pinholes (reticles) and area CCDs."""
    bodies = []
    for channel in channels:
        bodies.append(Body(f"{plane_root}/{channel.name}", Pose(np.eye(3), np.array([*channel.ccd, 0.0]))))
        offset = np.array([channel.pinhole[0] - channel.ccd[0], channel.pinhole[1] - channel.ccd[1], 0.0])
        bodies.append(Body(channel.reticle_body, Pose(np.eye(3), offset)))
        bodies.append(Body(channel.ccd_body, Pose(_FLIP, np.zeros(3))))
    return bodies


def _ccd_elements(channels: list[Channel]) -> dict[str, Element]:
    """Return name -> optical element of the area CCD of every monitor channel."""
    keys = {channel: f"{channel.key}/area_ccd" for channel in channels}
    return {key: Element(key, channel.ccd_body, plane(), Interaction.PASS) for channel, key in keys.items()}


def _baffles(spec: InstrumentSpec, tree: RigidTree) -> tuple[Plate, ...]:
    """Return the plates of all baffles.

    Raises
    ------
    InputError
        A baffle is mounted on a body that does not exist.
    """
    out: list[Plate] = []
    for name, baffle in spec.baffles.items():
        if baffle.body not in tree.paths:
            raise spec.error(unknown("no such body", baffle.body, tree.paths), ("baffles", name, "body"))
        out += baffle.plates(name)
    return tuple(out)


def _nodes(
    assembly: Assembly, cameras: Mapping[str, camera_model.CameraModel], solids: tuple[Solid, ...]
) -> dict[str, NodeInfo]:
    """Return path of each body -> motions and changes that it allows.

    The base is the reference frame and does not move.
    """
    # A figure belongs to the element's own body: a face that the beam meets twice has one for each passage.
    shaped = {e.body for e in assembly.elements.values() if e.interaction is not Interaction.PASS}
    roots = {f"{BASE}/{name}" for name in cameras}
    cold = _without_heat(cameras)
    reshaped: dict[str, tuple[str, ...]] = {}
    for name, model in cameras.items():
        reshaped |= camera_model.shape_changes(model, f"{BASE}/{name}")
    out = {}
    for body in assembly.tree.bodies:
        if body.path == BASE:
            out[BASE] = NodeInfo(allows=frozenset(() if BASE in cold else ("temperature",)), cold=cold.get(BASE, ""))
            continue
        allows = {"rotate", "shift"}
        if body.path not in cold and not any(body.path.startswith(f"{solid.path}/") for solid in solids):
            allows.add("temperature")
        if body.path in shaped:
            allows.add("figure")
        allows |= {*reshaped.get(body.path, ())}
        if body.path in roots:
            allows.add("scale")
        out[body.path] = NodeInfo(tuple(body.pivots), frozenset(allows), cold.get(body.path, ""))
    return out


def _without_heat(cameras: Mapping[str, camera_model.CameraModel]) -> dict[str, str]:
    """Return path of each body without a temperature of its own -> the reason, in words.

    These are further faces of a lens, which have the temperature of the first; planes that light passes, which belong
    to the structure; lenses whose glass has no thermal data; and the bodies that carry such a lens.
    """
    out: dict[str, str] = {}
    for name, model in cameras.items():
        root, faces = f"{BASE}/{name}", camera_model.lenses(model.spec)
        for face, mirror in model.spec.mirrors.items():
            if mirror.light == "passes":
                out[f"{root}/{face}"] = f"it is part of the structure, {root}"
        for face, lens in faces.items():
            if face != lens:
                out[f"{root}/{face}"] = f"it is a face of the lens {root}/{lens}"
                continue
            try:
                model.spec.warm_glass(lens)
            except ValueError as error:
                out |= dict.fromkeys((f"{root}/{lens}", root, BASE), f"{lens}: {error}")
    return out
