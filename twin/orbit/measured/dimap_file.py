"""DIMAP files (versions 2 and 3) of Pléiades, Pléiades Neo and SPOT 6 and 7: rigorous model of a scene.

The product must be one in sensor geometry. Its conventions are:

- Rows and columns of the image count from 1, the centre of the first pixel. Row r is exposed at START + (r - 1)
  LINE_PERIOD; times are UTC.
- Positions and velocities are Earth-fixed. Velocities are relative to the rotating Earth; inertial velocities, as the
  ground segment of Pléiades writes them, are recognised by the term omega x P (Earth's rotation vector, position),
  which is subtracted.
- A quaternion Q0 .. Q3 has its scalar first and rotates the body's axes into the Earth-fixed ones, v_earth = R(q)
  v_body. The attitude is given as samples, or as polynomials of (t - OFFSET) / SCALE, where t is seconds of the day of
  START, which are then normalised.
- In the body X points forward, Z to the scene, Y to the right. The line of sight of a column is
  (tan psi_y, -tan psi_x, 1), where tan psi_x = XLOS_0 + XLOS_1 c + ... and tan psi_y likewise by YLOS, of c = column -
  1 + FIRST_COL - 1.
- Lines of sight are straight outside the atmosphere, whose refraction is part of the model where
  ATMOSPHERIC_REFRACTION_SETTING is true: in a scene of Pleiades Neo, lines of sight derived from the rational
  polynomials at heights of 0 to 8 km agree to 0.03 urad with the refraction of the standard atmosphere, and to 1 urad
  without.

Orders and signs are those with which the Ames Stereo Pipeline reads these files. The formula of the lines of sight is
that of the imagery user guide of Pléiades, but FIRST_COL is added as in the Ames Stereo Pipeline, whereas the guide
subtracts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from analysis.arrays import Array
from optics.numerics.array_math import in_span
from optics.numerics.number_tree import FrozenMap
from scenes.yaml.errors import InputError, Issue, names_text, shown
from twin.orbit.flight.earth import GM
from twin.orbit.flight.platform_table import continuous_quaternions
from twin.orbit.flight.sensor import earth_rotation_velocity
from twin.orbit.measured import orbit_files
from twin.orbit.measured.earth_orientation import Readings, readings, require_increasing
from twin.orbit.measured.xml_file import Element, read_xml

PROFILES = ("PHR_SENSOR", "PNEO_SENSOR", "S6_SENSOR", "S7_SENSOR")
"""Metadata profiles of the products for which a rigorous model can be read."""
_WHAT = "a DIMAP file of a product in sensor geometry"
_VERSIONS = ("2", "3")
_PERIOD: Mapping[str, float] = FrozenMap(
    {"ms": 1e-3, "millisecond": 1e-3, "s": 1.0, "second": 1.0, "us": 1e-6, "microsecond": 1e-6}
)
"""Seconds per unit of a line period; a period without a unit is in milliseconds."""
_LENGTH: Mapping[str, float] = FrozenMap({"micrometer": 1e-6, "um": 1e-6, "mm": 1e-3, "m": 1.0})
"""Metres per unit of a detector's pixel size, by name of the unit."""
_MOST_TERMS = 8
"""Largest number of terms of a polynomial in a DIMAP file."""
_DAY = 86400.0
_SAMPLES = 240
"""Number of samples of an attitude given by polynomials: a cubic spline through them is accurate to 1e-12 rad for a
rotation of 30 deg.
"""
_MARGIN = 0.05
"""Time before the first and after the last image line for which polynomial attitudes are sampled, as a share of the
image's duration.
"""
_NEAR = 0.1
"""Longest extrapolation of an orbit beyond its readings, in seconds: the neglected third derivative of its positions
causes an error of 2 um.
"""
_LINES_OFF = 3.0
"""Largest allowed difference between the number of lines and the image's duration divided by the line period."""


@dataclass(frozen=True, eq=False)
class AttitudePolynomial:
    """Attitude as polynomials of quaternion components over time.

    Attributes
    ----------
    day : int
        Modified Julian day whose seconds are counted.
    offset : float
        Second of the day at which the polynomials' variable is 0.
    scale : float
        Seconds for which the polynomials' variable increases by 1.
    coefficients : (4, K) ndarray for K powers
        Coefficients of Q0, the scalar, to Q3, ascending powers.
    """

    day: int
    offset: float
    scale: float
    coefficients: Array

    def at(self, second: Array) -> Array:
        """Return unit quaternions, scalar first, at N seconds of the day, (N, 4)."""
        values = np.polynomial.polynomial.polyval((second - self.offset) / self.scale, self.coefficients.T).T
        return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class DimapPass:
    """Rigorous model of a pass, read from a DIMAP file.

    Attributes
    ----------
    file : str
        Path of the file.
    profile : str
        Metadata profile of the product, one of `PROFILES`.
    version : str
        Version of the format.
    name : str
        Name of the data set.
    lines, pixels : int
        Size of the image.
    first_line : Readings
        Exposure of the first line, UTC, one reading.
    line_time : float
        Time from one line to the next, seconds.
    orbit : OrbitReadings
        Orbit, ITRS and UTC.
    attitude : AttitudeReadings or AttitudePolynomial
        Attitude, as samples or as polynomials.
    forward, right : (K,) ndarray
        K coefficients of the tangents of a pixel's look angles, forward and to the right, ascending powers of the pixel
        number from 0.
    pitch : float or None
        Pixel pitch of the detector, metres; None where the file does not give it.
    refracted : bool
        True if the model contains atmospheric refraction.
    inertial_velocity : bool
        True if the file's velocities were inertial and have been converted.
    light_speed : bool
        True if the file declares that the speed of light was taken into account (aberration or light time; the format
        does not document which).
    rpc : tuple of str
        Names of the files of the product's rational polynomials.
    """

    file: str
    profile: str
    version: str
    name: str
    lines: int
    pixels: int
    first_line: Readings
    line_time: float
    orbit: orbit_files.OrbitReadings
    attitude: orbit_files.AttitudeReadings | AttitudePolynomial
    forward: Array
    right: Array
    pitch: float | None
    refracted: bool
    inertial_velocity: bool
    light_speed: bool
    rpc: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Time from the first line to the last, seconds."""
        return (self.lines - 1) * self.line_time

    def samples(self) -> orbit_files.AttitudeReadings:
        """Return the attitude as readings; polynomials are sampled over the time of the image.

        Samples that begin and end with the first and the last line do not cover the outer halves of these lines; there
        the spline through them is extrapolated by at most one interval of the samples.
        """
        if isinstance(self.attitude, orbit_files.AttitudeReadings):
            return self._spanning_samples(self.attitude)
        start, span = float(self.first_line.second[0]), max(self.duration, self.line_time)
        second = start + span * np.linspace(-_MARGIN, 1.0 + _MARGIN, _SAMPLES + 1)
        # Half a line beyond the ends is part of the image.
        second[0], second[-1] = min(second[0], start - self.line_time), max(second[-1], start + span + self.line_time)
        day = np.floor(second / _DAY)
        clock = Readings(self.attitude.day + day.astype(np.int64), second - _DAY * day)
        quaternion = self.attitude.at(second)
        return orbit_files.AttitudeReadings(self.file, clock, quaternion, None, "ITRS", "UTC", "first", "body_to_frame")

    def spanning_orbit(self) -> orbit_files.OrbitReadings:
        """Return the orbit's readings, extrapolated by one at each end where the image extends slightly beyond them.

        Raises
        ------
        InputError
            The image extends farther beyond the readings.
        """
        time = self._since(self.orbit.clock)
        assert self.orbit.velocity is not None
        position, velocity = self.orbit.position, self.orbit.velocity
        for at, end in self._ends_beyond(time):
            step = at - time[end]
            if abs(step) > _NEAR:
                problem = f"the image {'begins before' if end == 0 else 'ends after'} the ephemeris"
                value, allowed = f"by {abs(step):.6g} s", f"{_NEAR:g} s at most"
                raise InputError(Issue(problem, self.file, None, ("Ephemeris",), value, allowed))
            other, index = (1, 0) if end == 0 else (-2, len(time))
            rate = (velocity[end] - velocity[other]) / (time[end] - time[other])
            # Velocities a few milliseconds apart are too noisy for an acceleration. That relative to the rotating Earth
            # differs by a seventh from gravity: `_NEAR` seconds beyond the end, 6 mm.
            rate = rate if abs(time[end] - time[other]) > 0.5 else -GM * position[end] / _norm(position[end]) ** 3
            position = np.insert(position, index, position[end] + velocity[end] * step + 0.5 * rate * step**2, axis=0)
            velocity = np.insert(velocity, index, velocity[end] + rate * step, axis=0)
            time = np.insert(time, index, at)
        return orbit_files.OrbitReadings(self.file, self._clock(time), position, velocity, "ITRS", "UTC")

    def _spanning_samples(self, attitude: orbit_files.AttitudeReadings) -> orbit_files.AttitudeReadings:
        """Return the attitude samples, extrapolated by one at each end where the image extends slightly beyond them."""
        assert attitude.quaternion is not None
        time = self._since(attitude.clock)
        far = min(_NEAR, float(np.median(np.diff(time))))
        more = [at for at, end in self._ends_beyond(time) if abs(at - time[end]) <= far]
        if not more:
            return attitude
        # This is the interpolation of the samples everywhere else.
        more_quaternions = CubicSpline(time, continuous_quaternions(attitude.quaternion))(np.array(more))
        order = np.argsort(times := np.concatenate([time, more]))
        quaternion = np.concatenate(
            [attitude.quaternion, more_quaternions / np.linalg.norm(more_quaternions, axis=1, keepdims=True)]
        )
        return replace(attitude, clock=self._clock(times[order]), quaternion=quaternion[order])

    def _ends_beyond(self, time: Array) -> list[tuple[float, int]]:
        """Return the ends of the image, extended by one line, that lie outside of readings at N times.

        Each comes with the index of the nearest reading: 0 or -1.
        """
        ends = ((-self.line_time, 0), (self.duration + self.line_time, -1))
        return [(at, end) for at, end in ends if not in_span(at, time[0], time[-1])]

    def _clock(self, time: Array) -> Readings:
        """Return clock readings at N times, in seconds from the first line."""
        second = time + float(self.first_line.second[0])
        day = np.floor(second / _DAY)
        return Readings(int(self.first_line.day[0]) + day.astype(np.int64), second - _DAY * day)

    def _since(self, clock: Readings) -> Array:
        """Return the times of clock readings in seconds from the first line, (N,) for N readings."""
        return np.asarray((clock.day - self.first_line.day[0]) * _DAY + clock.second - self.first_line.second[0])


def _norm(vector: Array) -> float:
    """Return the length of a vector."""
    return float(np.linalg.norm(vector))


def is_dimap(lines: list[str]) -> bool:
    """Return whether a file that begins with these lines is a DIMAP file."""
    return "<Dimap_Document" in "\n".join(lines)


def read_dimap(path: str | Path, band: str | None = None) -> DimapPass:
    """Read the rigorous model of a product from its DIMAP file.

    Parameters
    ----------
    path : str or Path
        File DIM_*.XML of the product.
    band : str or None
        Band whose lines of sight are read; may be omitted where all bands have the same.

    Raises
    ------
    InputError
        The file cannot be read, or is another product; with file, line and element.
    """
    root = read_xml(path, _WHAT)
    version, profile = _identified(root)
    model = root.maybe("Geometric_Data", "Refined_Model")
    if model is None:
        allowed = "a product in sensor geometry with Geometric_Data/Refined_Model; of other files only the RPC are read"
        raise InputError(Issue("no rigorous model", str(path), root.line, root.path, profile, allowed))
    size = root.single("Raster_Data", "Raster_Dimensions")
    lines, pixels = size.whole("NROWS", most=2_000_000), size.whole("NCOLS", most=200_000)
    first, period = _times(model.single("Time"), lines)
    orbit, inertial = _orbit(model.single("Ephemeris"), str(path))
    attitude = _attitude(model.single("Attitudes"), str(path), int(first.day[0]))
    calibration = model.single("Geometric_Calibration", "Instrument_Calibration")
    forward, right = _looks(calibration, band)
    title = root.maybe("Dataset_Identification", "DATASET_NAME")
    pitch = model.maybe("Instrument_Configuration", "DETECTOR_SIZE_COL")
    settings = root.maybe("Processing_Information", "Product_Settings", "Geometric_Settings")
    components = root.all("Geoposition", "Geoposition_Models", "Rational_Function_Model", "Component", "COMPONENT_PATH")
    return DimapPass(
        str(path),
        profile,
        version,
        title.text if title is not None and title.text else Path(path).stem,
        lines,
        pixels,
        first,
        period,
        orbit,
        attitude,
        forward,
        right,
        None if pitch is None else pitch.number(least=1e-7, most=1e-3, unit=_LENGTH),
        _switch(settings, "ATMOSPHERIC_REFRACTION_SETTING"),
        inertial,
        _switch(settings, "LIGHT_SPEED_SETTING"),
        tuple(element.attributes["href"] for element in components if element.attributes.get("href")),
    )


def _switch(settings: Element | None, name: str) -> bool:
    """Return whether a setting is on; one that the file does not contain is off."""
    element = None if settings is None else settings.maybe(name)
    if element is None:
        return False
    if element.text.lower() not in _SWITCHES:
        element.wrong("neither true nor false", shown(element.text), names_text(_SWITCHES))
    return _SWITCHES[element.text.lower()]


_SWITCHES: Mapping[str, bool] = FrozenMap({"true": True, "1": True, "false": False, "0": False})


def _identified(root: Element) -> tuple[str, str]:
    """Return version and profile, or raise InputError for another format."""
    if root.tag != "Dimap_Document":
        allowed = "<Dimap_Document>; PHR_Dimap_Document is DIMAP_PHR, of the ground segment of Pléiades"
        root.wrong("not a DIMAP file", f"<{root.tag}>", allowed)
    identity = root.single("Metadata_Identification")
    form = identity.single("METADATA_FORMAT")
    version = form.attributes.get("version", "")
    if form.text != "DIMAP" or version.partition(".")[0] not in _VERSIONS:
        allowed = "DIMAP of version 2 or 3; version 1, of SPOT 1 to 5, has another model"
        form.wrong("unsupported format", shown(f"{form.text} {version}"), allowed)
    profile = identity.single("METADATA_PROFILE")
    if profile.text not in PROFILES:
        allowed = f"{names_text(PROFILES)}; of other profiles only the rational polynomials are read"
        profile.wrong("unsupported profile", shown(profile.text), allowed)
    return version, profile.text


def _moment(element: Element) -> Readings:
    """Return the UTC time of an element, whether or not its text ends in Z."""
    try:
        return readings(element.file, [element.text], [element.line])
    except InputError as error:
        issue = error.issues[0]
        element.wrong(issue.problem, issue.value, issue.allowed)


def _times(time: Element, lines: int) -> tuple[Readings, float]:
    """Return the exposure time of the first line, as a clock reading, and the line period in seconds."""
    span = time.single("Time_Range")
    first, last = _moment(span.single("START")), _moment(span.single("END"))
    stamp = time.single("Time_Stamp", "LINE_PERIOD")
    period = stamp.number(least=1e-6, most=0.1, unit=_PERIOD)
    lasted = float((last.day[0] - first.day[0]) * _DAY + last.second[0] - first.second[0])
    off = abs(lasted - (lines - 1) * period)
    if off > max(_LINES_OFF * period, 0.002 * lines * period):
        value = f"{lasted:.6g} s from START to END, and {lines} lines of {period * 1e3:.6g} ms"
        stamp.wrong("line period, number of lines and times do not agree", value, "END at the last line")
    return first, period


def _clock(items: list[Element], file: str) -> Readings:
    """Return the times of XML elements as clock readings; raise InputError unless they increase."""
    moments = [_moment(item.single("TIME")) for item in items]
    clock = Readings(np.array([m.day[0] for m in moments]), np.array([m.second[0] for m in moments]))
    require_increasing(file, clock, [item.line for item in items])
    return clock


def _orbit(ephemeris: Element, file: str) -> tuple[orbit_files.OrbitReadings, bool]:
    """Return the orbit readings, and whether the file's velocities were inertial."""
    points = ephemeris.all("Point_List", "Point")
    if len(points) < 4:
        ephemeris.wrong("too few points of the orbit", str(len(points)), "4 or more in Point_List")
    clock, lines = _clock(points, file), [point.line for point in points]
    position = np.stack([point.single("LOCATION_XYZ").floats(3) for point in points])
    velocity = np.stack([point.single("VELOCITY_XYZ").floats(3) for point in points])
    orbit_files.require_orbit(file, position, lines)
    share, inertial = orbit_files.velocity_misfit((clock.day - clock.day[0]) * _DAY + clock.second, position, velocity)
    if inertial:
        velocity = velocity - earth_rotation_velocity(position)
    elif np.median(share) > orbit_files.SPEED_TOLERANCE:
        value = f"they differ by {100.0 * np.median(share):.3g} % in the median"
        points[0].single("VELOCITY_XYZ").wrong("not the velocity of these positions", value, "Earth-fixed, m/s")
    return orbit_files.OrbitReadings(file, clock, position, velocity, "ITRS", "UTC"), inertial


def _attitude(attitudes: Element, file: str, day: int) -> orbit_files.AttitudeReadings | AttitudePolynomial:
    """Return the attitude, as samples or as polynomials."""
    polynomial = attitudes.maybe("Polynomial_Quaternions")
    samples = attitudes.all("Quaternion_List", "Quaternion")
    if (polynomial is None) == (not samples):
        value = "neither" if polynomial is None else "both"
        attitudes.wrong("the attitude must be given exactly once", value, "Polynomial_Quaternions or Quaternion_List")
    if polynomial is None:
        if len(samples) < 4:
            attitudes.wrong("too few quaternions", str(len(samples)), "4 or more in Quaternion_List")
        clock = _clock(samples, file)
        values = np.array([[sample.number(f"Q{k}") for k in range(4)] for sample in samples])
        orbit_files.require_unit(file, values, [sample.line for sample in samples])
        return orbit_files.AttitudeReadings(file, clock, values, None, "ITRS", "UTC", "first", "body_to_frame")
    offset = polynomial.number("OFFSET", least=0.0, most=2.0 * _DAY)
    scale = polynomial.number("SCALE", least=1e-6, most=1e6)
    rows = []
    for k in range(4):
        part = polynomial.single(f"Q{k}")
        degree = part.whole("DEGREE", least=0, most=_MOST_TERMS - 1)
        rows.append(np.zeros(_MOST_TERMS))
        rows[-1][: degree + 1] = part.single("COEFFICIENTS").floats(degree + 1)
    fitted = AttitudePolynomial(day, offset, scale, np.array(rows))
    # It is normalised where it is used; at the middle of its range it has unit length but for the fit.
    orbit_files.require_unit(file, fitted.coefficients[None, :, 0], [polynomial.line])
    return fitted


def _looks(calibration: Element, band: str | None) -> tuple[Array, Array]:
    """Return coefficients of the look angles' tangents forward and to the right, ascending powers of the pixel."""
    direct = calibration.all("Polynomial_Look_Angles")
    bands = [*calibration.all("Band_Calibration_List", "Band_Calibration"), *calibration.all("Band_Calibration")]
    named = {element.words("BAND_ID"): element.single("Polynomial_Look_Angles") for element in bands}
    if direct and not named:
        named = {"": direct[0]}
    if band is not None:
        if band not in named:
            calibration.wrong(
                "no such band", shown(band), names_text(named) or "none: the look angles are common to all bands"
            )
        named = {band: named[band]}
    if not named:
        calibration.wrong("no look angles", None, "Polynomial_Look_Angles, or Band_Calibration with them")
    start = calibration.maybe("Swath_Range", "FIRST_COL")
    first = 0 if start is None else int(start.number(least=1, most=1e6)) - 1
    tangents = [(_tangent(element, "YLOS", first), -_tangent(element, "XLOS", first)) for element in named.values()]
    for name, other in zip(named, tangents, strict=True):
        if not all(np.array_equal(a, b) for a, b in zip(other, tangents[0], strict=True)):
            named[name].wrong("bands have different look angles", names_text(named), "one of them, as `band`")
    if not tangents[0][1][1:].any():
        next(iter(named.values())).wrong("all pixels have the same look angle", "XLOS_1 of 0", "a slope along the line")
    return tangents[0]


def _tangent(element: Element, name: str, first: int) -> Array:
    """Return the K coefficients of the tangent of a look angle in ascending powers of the pixel number.

    Pixel 0 is the value ``first`` of the file's variable.
    """
    terms = [element.number(f"{name}_0", least=-1.0, most=1.0)]
    if name == "XLOS":
        element.single("XLOS_1")
    while element.maybe(f"{name}_{len(terms)}") is not None and len(terms) < _MOST_TERMS:
        terms.append(element.number(f"{name}_{len(terms)}", least=-1.0, most=1.0))
    moved = np.polynomial.Polynomial(terms)(np.polynomial.Polynomial([float(first), 1.0]))
    return np.asarray(np.pad(moved.coef, (0, len(terms) - len(moved.coef))), np.float64)
