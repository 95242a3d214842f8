"""Transfer functions by lines: closed forms, the way by pieces of shadows, and what it refuses."""

import numpy as np
import pytest

from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.waves.edge_shadow import StopOutlines
from optics.waves.line_transfer import VignettedPupil, line_transfers, unvignetted_at, vignetted_pupils
from optics.waves.optical_transfer import transfer
from optics.waves.pupil_shadow import PupilShadow, separate
from optics.waves.pupil_stack import PupilFunction, circular_pupil

WAVELENGTH, F_NUMBER = 650e-9, 10.0
CUTOFF = 1.0 / (F_NUMBER * WAVELENGTH)
COUNT = 65
STEP = CUTOFF / (COUNT - 1)
ALONG = np.array([1.0, 0.0])
AGREE = 2e-5
"""What lines are right to: they stop where a third of them tells 1e-4 else, and errors fall with their square."""


def disk(radius: float, centre: complex = 0.0, sides: int = 512) -> np.ndarray:
    """A polygon with the area of a disk."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return centre + radius * np.sqrt(angle[1] / np.sin(angle[1])) * np.exp(1j * angle)


def vane(turn: float, width: float = 0.016) -> np.ndarray:
    return np.array([0.0 - 0.5j * width, 2.0 - 0.5j * width, 2.0 + 0.5j * width, 0.5j * width]) * np.exp(1j * turn)


def shared(first: float, second: float, distance: np.ndarray) -> np.ndarray:
    """Area that two disks share."""
    large, small = max(first, second), min(first, second)
    between = np.clip(distance, large - small + 1e-12, large + small)
    x = (between**2 + large**2 - small**2) / (2.0 * between)
    y = np.sqrt(np.maximum(large**2 - x**2, 0.0))
    lens = (
        large**2 * np.arccos(np.clip(x / large, -1.0, 1.0))
        + small**2 * np.arccos(np.clip((between - x) / small, -1.0, 1.0))
        - between * y
    )
    return np.where(distance <= large - small, np.pi * small**2, lens)


def aberrated(waves: float) -> PupilFunction:
    """Astigmatism, coma and spherical aberration."""
    terms = np.zeros((5, 5))
    terms[2, 0], terms[0, 2], terms[2, 1], terms[4, 0], terms[1, 3] = 0.6, -0.3, 0.5, 0.4, 0.2
    return circular_pupil(F_NUMBER, waves * WAVELENGTH * terms)


def by_lines(cut: VignettedPupil, direction: np.ndarray = ALONG, step: float = STEP, count: int = COUNT, lines=()):
    ((told,),) = line_transfers([cut], [WAVELENGTH], direction[None], step, count, lines)
    return told


@pytest.mark.parametrize("hole", [0.2, 0.35, 0.7])
def test_a_ring_as_in_closed_form(hole: float) -> None:
    told = by_lines(VignettedPupil(circular_pupil(F_NUMBER), (), (disk(hole),)))
    shift = 2.0 * np.arange(COUNT) / (COUNT - 1)
    exact = shared(1.0, 1.0, shift) - 2.0 * shared(1.0, hole, shift) + shared(hole, hole, shift)
    np.testing.assert_allclose(told.perfect, exact / (np.pi * (1.0 - hole**2)), rtol=0, atol=AGREE)
    np.testing.assert_allclose(told.values, told.perfect, rtol=0, atol=1e-12)  # without a wavefront error
    assert told.error < 1e-4
    assert np.max(np.abs(told.perfect * np.pi * (1.0 - hole**2) - exact)) < np.pi * told.error


def test_a_clear_edge_is_a_smaller_pupil() -> None:
    told = by_lines(VignettedPupil(circular_pupil(F_NUMBER), (disk(0.8, 0.1j),), ()))
    shift = 2.0 * np.arange(COUNT) / (COUNT - 1)
    np.testing.assert_allclose(told.perfect, shared(0.8, 0.8, shift) / (np.pi * 0.64), rtol=0, atol=AGREE)
    assert np.max(np.abs(told.values[shift > 1.6])) < 1e-12


@pytest.mark.second
@pytest.mark.parametrize("turn", [0.0, 0.4, 0.5 * np.pi])
def test_disk_and_vanes_as_by_pieces_of_shadows(turn: float) -> None:
    """The shadows in ``optics.waves.optical_transfer`` are cut from the same outlines."""
    pupil = aberrated(0.4)
    dark = [disk(0.35, 0.02 + 0.01j, 64), *(vane(0.3 + k * np.pi / 2.0) for k in range(4))]
    pieces, _ = separate([np.stack([p.real, p.imag], axis=-1)[None] for p in dark], fewest=True)
    shadow = PupilShadow.within(pieces, pupil.edge.harmonics[:, None])
    other = PupilFunction(
        pupil.centre, pupil.axes, pupil.edge, pupil.eikonal_terms, pupil.amplitude_terms, shadow=shadow, finer=8
    )
    direction = np.array([np.cos(turn), np.sin(turn)])
    told = by_lines(VignettedPupil(pupil, (), tuple(dark)), direction)
    frequency = STEP * np.arange(COUNT)[:, None] * direction
    theirs = transfer(other, frequency, WAVELENGTH, np.zeros(1))[0]
    np.testing.assert_allclose(told.values, theirs, rtol=0, atol=AGREE)
    assert np.max(np.abs(np.abs(told.values) - told.perfect)) > 0.1  # the wavefront matters


def test_too_few_lines_are_refused() -> None:
    with pytest.raises(UnphysicalError, match=r"still changes by .* with more lines"):
        by_lines(VignettedPupil(circular_pupil(F_NUMBER), (), (disk(0.35), vane(0.7), vane(2.3))), lines=(12,))


def test_outlines_come_from_the_stop_and_tell_what_is_lit() -> None:
    nodes = quadrature.disk(8)
    pupil = circular_pupil(F_NUMBER)
    # the light's directions are those of the stop mirrored: what goes around counterclockwise does no more
    u, v = (0.5 / F_NUMBER * part[None] for part in (nodes.x, -nodes.y))
    dark = disk(0.35, 0.1 + 0.2j)
    on_stop = np.stack([dark.real, dark.imag], axis=-1)[None]
    smooth = PupilFunction(pupil.centre, pupil.axes, pupil.edge, np.zeros((9, 9)), np.eye(9))
    lit = np.abs(nodes.x + 1j * nodes.y - (0.1 + 0.2j))[None] > 0.35
    (cut,) = vignetted_pupils([smooth], u, v, nodes, StopOutlines((), (on_stop,)), lit)
    np.testing.assert_allclose(cut.blocked[0][::-1], np.conj(dark), atol=1e-12)
    points = nodes.x - 1j * nodes.y
    np.testing.assert_array_equal(unvignetted_at(cut, points), np.abs(points - (0.1 - 0.2j)) > 0.35)
    nothing = np.zeros((1, 3, 2))
    with pytest.raises(UnphysicalError, match="blocks all light in the pupil of image 0"):
        vignetted_pupils([cut.pupil], u, v, nodes, StopOutlines((nothing,), ()), lit)
