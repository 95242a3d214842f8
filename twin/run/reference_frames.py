"""In which frames the numbers of a file are: stated in the file itself.

Every JSON file of a run begins with ``schema``, its kind and version, and ``reference_frames``, what its positions,
velocities, directions, angles and times refer to and, where a table or an image beside it cannot say so itself, what
those refer to. netCDF files have the latter among their attributes. Axes and signs are those of docs/conventions.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from optics.numerics.number_tree import FrozenMap
from scenes.specs.procedures import PROCEDURES

_VERSION = 2
"""Version of the files' keys; 1 had no statement of frames."""
_LATER: Mapping[str, int] = FrozenMap(
    {"angle": 4, "calibration": 4, "recovered": 4, "course": 3, "monitor": 4}
    | dict.fromkeys(("camera", "crosstalk", "design", "distortion", "layouts", "match"), 3)
    | dict.fromkeys(("mtf", "optics", "simulate", "truth", "turntable"), 3)
)
"""Kind of file -> version, where keys went, changed their meaning or got another name since then: what a paper prints
and whether it holds; sigmas, which were those of the noise alone; names of keys."""
_CAMERA = (
    "d_alpha, d_beta and d_gamma turn the camera about Y, X and Z of its own nominal axes (Z the line of sight toward "
    "the scene, Y along the line CCD, X = Y x Z), right-handed; changes are perturbed minus nominal"
)
_ANGLE = "between the cameras' lines of sight, unsigned; its change is positive where they open"
_SPOT = "row and column of the area CCD, (0, 0) the centre of the first pixel; columns along detector x, rows along y"
_DETECTOR = "x and y from the centre of the area CCD's pixel grid, along its columns and rows"
_ITRS = "ITRS, geocentric and Earth-fixed, metres"
_GEODETIC = "geodetic on the WGS84 ellipsoid: latitude, longitude positive to the east, height above the ellipsoid"
_SECONDS = "seconds from the epoch in UTC that stands beside them"
_BODY = "X along the flight direction, Z toward the scene, Y = Z x X; true attitude = measured attitude times the bias"
_FOCAL = "camera axes, x along the track, y along the line; the image is the real one, +y sees the scene at -Y"
_GROUND = "along the track, across it to the right, and up; found with the nominal cameras minus true"
_CHANGES = {"cameras": _CAMERA, "intersection_angle": _ANGLE, "ground": _GROUND}
_LOOK = (
    "look: between the lines' central rays, unsigned; along the track: its part about the lines' mean direction, "
    "positive where the first line looks ahead; planes: dihedral angle of the lines' planes"
)

FRAMES: Mapping[str, Mapping[str, str]] = FrozenMap(
    {
        "truth": _CHANGES,
        "recovered": {**_CHANGES, "spots": _SPOT},
        "course": {
            **_CHANGES,
            "times_s": "seconds from the beginning of the course",
            "motions": "in the moved body's own nominal axes, about its pivot",
        },
        "life": {
            **_CHANGES,
            "times_us": "microseconds of TAI since 2000-01-01T00:00:00 TAI",
            "steps": "in the moved body's own nominal axes, about its pivot",
        },
        "judged": {"quantities": f"{_CAMERA}; {_ANGLE}; ground: {_GROUND}"},
        "uncertainty": {
            **_CHANGES,
            "motion": "in the moved body's own nominal axes",
            "spots_px": "left before right spot of every camera, of each row and column",
        },
        "crosstalk": {"rows and columns": _CAMERA, "motions": "in the moved body's own nominal axes"},
        "deformation": {
            "motions": "in the body's own nominal axes, rotate before shift, both about its origin",
            "figure": "sag along the surface's +z where the node now stands, Noll's terms, rms over the disk",
        },
        "temperature": {
            "linear": "change at the body's origin, gradient in its own nominal axes",
            "faces": "in the face's own nominal axes about its origin, beyond the linear field; figure: sag along z, "
            "Noll's terms, rms over the disk",
        },
        "stray": {"sources": "shares of light, of no frame", "detector": "by the name of the channel"},
        "quality": {"fields": "shares of half the line, +1 at its left end, +Y of the focal plane"},
        "mtf": {
            "along_mm": "along the line CCD from its centre, focal-plane Y",
            "across_mm": "across it, focal-plane X",
            "columns": "of the line CCD, the centre of the first pixel is 0",
            "image_shift_um": "focal-plane Y and X, perturbed minus nominal",
        },
        "irradiance": {"x, y": _DETECTOR},
        "focus": {
            "defocus_um": "along the focal plane's Z, toward the scene positive",
            "rotation_arcmin, shift_um": "of the focal-plane assembly about and along its own nominal axes",
            "field": "along the line, focal-plane Y",
        },
        "distortion": {
            "reading_deg": "of the turntable's circle, as it reads",
            "field_deg": "about the turntable's axis, from the camera's zero that is in the estimate",
            "position_mm": "along the line CCD in the image, from its centre",
            "axis_tilt_arcsec": "of the turntable's axis against square to camera axes X and Z",
        },
        "turntable": {"angles": "readings of the turntable's circle about its axis; errors: reading minus true angle"},
        "design": {"prescription": "vertex of M1; light enters toward +z, y in the symmetry plane, x along the line"},
        "layouts": {
            "pupil_x, pupil_y": "in the entrance pupil: toward the central prism, and along the line toward the beam's "
            "own end of it",
            "spread_x, spread_y": "base frame, from the central prism's apex",
            "field": "from the visual axis along the line; the beam stands at both ends",
            "forward, backward, cameras": _CAMERA,
            "angle": _ANGLE,
            "height": "up, at the middle of the line",
        },
        "tolerance": {
            "motions": "in the moved body's own nominal axes; turns about its pivot; of several bodies in the first's",
            "fields": "shares of the half field, along the line (+Y of the focal plane) and along the track (+X)",
            "boresight, roll, principal_distance": "of the line of sight, against the designed camera's",
        },
        "asbuilt": {
            "motions": "in the moved body's own nominal axes; turns about its centre, or its origin where it has none",
            "fields": "shares of the half field, along the line (+Y of the focal plane) and along the track (+X)",
            "merits": "of the line of sight, against the designed camera's",
        },
        "orientation": {
            "readings": "what has to be done to a map for the stop's axes: x along the line, y along the track"
        },
        "optics": {
            "fields": "shares of the half field: along the line, positive at the end at +Y of the focal plane (left), "
            "and along the track, positive at its +X",
            "wavefront, zernike_waves": "over the stop in units of its radius, x along the line, y along the track; "
            "positive where the wavefront is ahead",
            "place_mm, principal_point": "on the focal plane from the line's middle, along Y and along X",
            "image, z": "prescription: vertex of M1; light enters toward +z; tilt about x",
            "focus, defocus": "of the detector, positive downstream, away from the optics",
        },
        "angle": {
            "planes, look, along_track, truth": _LOOK,
            "frames": "axes in which the planes are fitted: each row names its own",
            "time_s": _SECONDS + " in config.yaml; of the exposure",
        },
        "calibration": {
            "f, x, y": _FOCAL,
            "roll, pitch, yaw": f"of the body, in this order Rx Ry Rz; {_BODY}",
            "offset along, across, down": "true minus measured station in the field's mean body axes",
            "latitude_rad": _GEODETIC,
            "shift_east_north_up_m": "local horizon at the field's middle",
            "orbit_third_difference_rms_m": _ITRS,
            "attitude_third_difference_rms_rad": "measured body axes against the orbital frame: roll, pitch, yaw",
            "plan_rms_m, height_rms_m": "local horizon of each check point: east and north together, and up",
            "change of d_alpha": _CAMERA,
            "rates": "of the bias in body axes, per second of UTC",
        },
        "jitter": {
            "amplitude, phase": "about the body's own axes: roll X forward, pitch Y = Z x X, yaw Z toward the scene; "
            "sin(2 pi f t + p), t from the epoch",
            "artefacts/attitude": "the same, less what is slow; seconds from the epoch in UTC of the pass",
        },
        "block": {
            "ce90_m, le90_m": "local horizon of each check point: east and north together, and up",
            "cameras": _CAMERA,
            "east_m, north_m, up_m, sigma_m": "local horizon at the middle of the control points: given minus all else",
            "roll, pitch, yaw": f"rotation vector of the body from measured to true; {_BODY}",
            "offset along, across, down": "true minus measured station in the mean body axes of the pass",
        },
        "monitor": {
            "times_s, reference_time_s, monitored_times_s, held_s": "seconds from the epoch in UTC of the orbit in "
            "config.yaml",
            "cameras, quantity, positions": _CAMERA,
            "intersection_angle, angle": _ANGLE,
            "height, plan": "local horizon of each point: up, and east and north together; found minus true",
            "defocus, told_um": "best focus less line CCD along the light, positive downstream",
        },
        "simulate": {
            "longitude_deg, latitude_deg": _GEODETIC,
            "times": _SECONDS,
            "line, pixel": "of each line CCD's image; pixel 0 and line 0 are the centres of the first; images begin at "
            "first_line, first_pixel",
            "orthophoto, dem": f"rows to the south, columns to the east; heights of the dem and degrees: {_GEODETIC}",
            "artefacts/points.csv": f"degrees, height: {_GEODETIC}; x, y, z: {_ITRS}; line and pixel as here",
        },
        "camera": {
            "camera_to_body": f"rotation of camera axes into body axes; body: {_BODY}",
            "position_m": "of the projection centre in body axes from the body's origin",
            "principal_point_m": _FOCAL,
        },
        "trajectory": {
            "position_m": f"of the body's origin, {_ITRS}",
            "velocity_m_per_s": "against the turning Earth, in axes of the ITRS: the derivative of position_m",
            "inertial_velocity_m_per_s": "against the stars, in axes of the ITRS: with the Earth's rotation",
            "quaternion": f"(x, y, z, w), x_itrs = R x_body; {_BODY}",
            "orbit_s, attitude_s": _SECONDS,
        },
        "georeference": {"longitude, latitude": _GEODETIC, "rows, columns": "to the south, to the east"},
        "export": {
            "times": _SECONDS,
            "heights_m, height_m": "above the ellipsoid",
            "coefficients_px, covariance_px2": "of line and sample, measured minus predicted",
            "artefacts/accuracy_map.csv": f"longitude and latitude: {_GEODETIC}; sigmas in the local horizon",
            "models/*.json": f"{_ITRS}; lines and samples count from the image's corner, pixel centres are at halves",
            "models/*_RPC.TXT, models/*.tif": f"{_GEODETIC}; line 0 and sample 0 are the centres of the first pixel",
        },
        "products": {
            **_CHANGES,
            "changes, covariance": _CAMERA,
            "bias_east_m, bias_north_m": "local horizon of each point, located minus true",
            "models/*.json": f"{_ITRS}; lines and samples count from the image's corner, pixel centres are at halves",
            "models/*_RPC.TXT": f"{_GEODETIC}; line 0 and sample 0 are the centres of the first pixel",
        },
        "simulate-truth": {
            "itrs_m": _ITRS,
            "camera, trajectory": "each states its own",
            "line, pixel": "of the line CCD: the centre of the first is 0",
            "east_m, north_m": "local horizon at the middle of the patch",
        },
        "check": {
            "rms_m, moves_points_by_m": "in plan, at the heights of the ground points",
            "rms_px": "along the line and along the track together, of each line's own image",
            "longitude_deg, latitude_deg": _GEODETIC,
            "east_m, north_m": "local horizon of each ground point: where the reading puts it minus where it is",
            "line_origin, pixel_origin": "image coordinates of the middle of line 0 of the table of times, "
            "and of the first pixel",
            "body_axes": "what x, y and z of the attitude's body point to in flight",
        },
        "match": {
            "line, pixel": "of each line CCD's image; pixel 0 is the one that sees farthest to the right of the track",
            "displacement": "from where camera and platform have a point to where it is found",
            "longitude_deg, latitude_deg": _GEODETIC,
            "artefacts/points.csv": f"degrees, height: {_GEODETIC}; x, y, z: {_ITRS}; line and pixel as here",
        },
        "study": {"truth, recovered": f"{_CAMERA}; {_ANGLE}", "responses": "as in the base's file that the key names"},
        "compare": {"numbers, arrays": "as in the compared files, each of which states its own"},
        "files": {
            "images/*.fits, expected_photons.fits": "row 0 is the first row stored (NAXIS2 = 1), column 0 the first "
            "pixel of a row, (0, 0) the centre of the first pixel; columns along detector x, rows along y",
            "tables": "as in the file of the run that the table was made of, which states its own",
        },
        "gradient": {"responses": f"{_CAMERA}; {_ANGLE}", "factors": "motions in the moved body's own nominal axes"},
    }
)
"""Kind of file -> quantity -> what it refers to."""


def schema(kind: str) -> str:
    """Kind and version of a file's keys."""
    return f"{kind} {_LATER.get(kind, _VERSION)}"


def described(kind: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """The data of a file with its schema and its frames before them.

    Args:
        kind: of the file.
        data: its contents, plain data.

    Raises:
        KeyError: a kind without an entry in `FRAMES` or a test's `frames` of its own.
    """
    own = {procedure.kind: procedure.frames for procedure in PROCEDURES.values()}
    return {"schema": schema(kind), "reference_frames": dict(FRAMES[kind] if kind in FRAMES else own[kind]), **data}


def frames_text(kind: str) -> str:
    """The statement in one line, for an attribute."""
    return "; ".join(f"{quantity}: {frame}" for quantity, frame in FRAMES[kind].items())
