"""Terms of a surface's sag in addition to the conic and the even powers of the radius, of several kinds.

A kind of term (``XYPolynomial``, ``ZernikeSag``) is a frozen dataclass whose fields are numbers: floats in a
``Surface``, arrays over systems in a batch, Dr.Jit arrays in a kernel. They are 0 by default, and a term of zeros adds
exactly nothing, so that all surfaces of a batch or scene share the code of all their terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from functools import cache
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from optics.geometry import zernike
from optics.numerics.backend import Backend
from optics.numerics.extension_table import EntryPointError, ExtensionTable
from optics.numerics.number_tree import FrozenMap


@runtime_checkable
class SagTerm(Protocol):
    """Interface of every kind of sag term: a frozen dataclass of numbers, without a ``__post_init__``.

    Attributes
    ----------
    POWERS : mapping of str to int
        Name of each field, in the order of the fields -> power of the metre in its unit (-3 for 1/m^3). Files are read
        with it, and the numbers of an expanded body are scaled with it.
    """

    POWERS: ClassVar[Mapping[str, int]]

    def sag(self, x: Any, y: Any) -> Any:
        """Return the height in metres at points x, y (metres), NumPy arrays; NaN outside the term's domain."""
        ...

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the height (metres) at points x, y and its derivatives along x and y, as Dr.Jit arrays.

        They are finite also outside the domain of ``sag``.
        """
        ...


def scaled_term(term: SagTerm, scale: Any) -> SagTerm:
    """Return the term on a body whose lengths are multiplied by ``scale``; the factor may be an array, also complex."""
    kind = type(term)
    return kind(**{name: getattr(term, name) * scale**power for name, power in kind.POWERS.items()})


def of_kinds(terms: Sequence[SagTerm], kinds: Sequence[type[SagTerm]]) -> tuple[SagTerm, ...]:
    """Return one term of each kind, in the order of ``kinds``: that in ``terms``, else a term of zeros."""
    by_kind: Mapping[Any, SagTerm] = {type(term): term for term in terms}
    return tuple(by_kind[kind] if kind in by_kind else kind() for kind in kinds)


def kinds_of(terms: Sequence[SagTerm]) -> tuple[type[SagTerm], ...]:
    """Return the kinds of the terms, each once, in an order that depends on the kinds alone."""
    return tuple(sorted({type(term) for term in terms}, key=lambda kind: (kind.__module__, kind.__qualname__)))


@cache
def check_height(kind: type[SagTerm], backend: Backend) -> None:
    """Check that the ``height`` of a kind computes with Dr.Jit alone, before it becomes part of a kernel.

    NumPy in it would evaluate arrays while the kernel is recorded, which ends the process. Here they are the variables
    of a symbolic loop, whose evaluation is an error.

    Parameters
    ----------
    kind : type[SagTerm]
        Kind of sag term.
    backend : Backend
        Backend of the kernel.

    Raises
    ------
    EntryPointError
        ``height`` evaluates an array, fails, or returns something else than three numbers.
    """
    import drjit as dr

    def once(n: Any, x: Any, y: Any, total: Any) -> tuple[Any, ...]:
        height, along_x, along_y = kind(**dict.fromkeys(kind.POWERS, x)).height(x, y)
        return n + 1, x, y, total + height + along_x + along_y

    x, y, total = (backend.Float(number) for number in (0.01, 0.02, 0.0))
    try:
        dr.while_loop((backend.UInt(0), x, y, total), lambda n, *_: n < 1, once, mode="symbolic")
    except RuntimeError as error:
        reason = str(error.__cause__ or error).strip().partition("\n")[0]
        raise EntryPointError(
            f"the sag term {kind.__name__} of {kind.__module__}: its height cannot become part of a kernel ({reason}); "
            "it has to return the height and its two slopes by functions of drjit, such as drjit.cos, without numpy"
        ) from error


def _numbers(**powers: int) -> Any:
    """Return a frozen dataclass of numbers, 0 by default, from the power of the metre in the unit of each."""
    fields = [(name, Any, 0.0) for name in powers]
    return make_dataclass("_Numbers", fields, frozen=True, namespace={"POWERS": FrozenMap(powers)})


_EXPONENTS: Mapping[str, tuple[int, int]] = FrozenMap(
    **{"x2": (2, 0), "xy": (1, 1), "y2": (0, 2), "x3": (3, 0), "x2y": (2, 1), "xy2": (1, 2), "y3": (0, 3)},
    **{"x4": (4, 0), "x3y": (3, 1), "x2y2": (2, 2), "xy3": (1, 3), "y4": (0, 4)},
)
"""Exponents (a, b) of x^a y^b by the name of its coefficient."""

_Coefficients: Any = _numbers(**{name: 1 - a - b for name, (a, b) in _EXPONENTS.items()})


class XYPolynomial(_Coefficients):
    """Freeform sag: sum of c_ab x^a y^b over 2 <= a + b <= 4, with x, y and the sag in metres.

    The field ``x2y`` is the coefficient of x^2 y; units are 1/m, 1/m^2 and 1/m^3 for degrees a + b of 2, 3 and 4.
    """

    def sag(self, x: Any, y: Any) -> Any:
        """Return the height at points x, y, in metres (NumPy arrays)."""
        return np.asarray(sum(getattr(self, name) * x**a * y**b for name, (a, b) in _EXPONENTS.items()))

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the height at points x, y, in metres, and its derivatives along x and y (Dr.Jit arrays)."""
        coefficients: list[Any] = [0.0] * zernike.triangle_size(4)
        for name, (a, b) in _EXPONENTS.items():
            coefficients[zernike.triangle_index(a, b)] = getattr(self, name)
        return zernike.triangle_polynomial(x, y, coefficients, 4)


LAST_NOLL = 36
"""Highest Noll index of Zernike sag terms: all terms to radial order 7."""

_Amplitudes: Any = _numbers(**dict.fromkeys(("radius", "x0", "y0", *(f"Z{j}" for j in range(1, LAST_NOLL + 1))), 1))


class ZernikeSag(_Amplitudes):
    """Freeform sag as designed: a sum of Zernike polynomials, a_j Z_j((x - x0)/radius, (y - y0)/radius).

    j is the Noll index and the amplitude a_j the rms over the disk of ``radius`` about (x0, y0), in metres. A mirror's
    figure error is not part of it; that belongs to the state (``Motion.figure``).
    """

    @property
    def amplitudes(self) -> dict[int, Any]:
        """Noll index -> amplitude a_j, in metres rms."""
        return {j: getattr(self, f"Z{j}") for j in range(1, LAST_NOLL + 1)}

    def sag(self, x: Any, y: Any) -> Any:
        """Return the height at points x, y, in metres (NumPy arrays)."""
        if not self.radius:
            return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        u, v = (np.asarray(x) - self.x0) / self.radius, (np.asarray(y) - self.y0) / self.radius
        return np.asarray(sum(a * zernike.zernike(j, u, v) for j, a in self.amplitudes.items()))

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the height at points x, y, in metres, and its derivatives along x and y (Dr.Jit arrays)."""
        import drjit as dr

        is_zero = self.radius == 0.0
        scale = dr.select(is_zero, 0.0, 1.0 / dr.select(is_zero, 1.0, self.radius))
        order = zernike.order_of(range(1, LAST_NOLL + 1))
        coefficients: list[Any] = [0.0] * zernike.triangle_size(order)
        for j, amplitude in self.amplitudes.items():
            for a, b, c in zernike.cartesian_terms(j):
                index = zernike.triangle_index(a, b)
                coefficients[index] = coefficients[index] + c * amplitude
        height, slope_x, slope_y = zernike.triangle_polynomial(
            (x - self.x0) * scale, (y - self.y0) * scale, coefficients, order
        )
        return height, slope_x * scale, slope_y * scale


SAG_TERMS = ExtensionTable[type[SagTerm]]("sag_terms", {"polynomial": XYPolynomial, "zernike": ZernikeSag}, SagTerm)
"""Kinds of sag terms by the name that a mirror's file writes under ``sag``; the numbers follow there by field name.

A new kind is added here: the traces, their derivatives, the path tracer, meshes and the file readers use this table.
"""
