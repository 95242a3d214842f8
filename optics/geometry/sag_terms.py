"""Terms of a surface's sag in addition to the conic and the even powers of the radius, of several kinds.

A kind of term (``XYPolynomial``, ``ZernikeSag``) is a frozen dataclass whose fields are numbers: floats in a
``Surface``, arrays over systems in a batch, Dr.Jit arrays in a kernel. They are 0 by default, and a term of zeros adds
exactly nothing, so that all surfaces of a batch or scene share the code of all their terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class XYPolynomial:
    """Freeform sag: sum of c_ab x^a y^b over 2 <= a + b <= 4, with x, y and the sag in metres.

    The field ``x2y`` is the coefficient of x^2 y; units are 1/m, 1/m^2 and 1/m^3 for degrees a + b of 2, 3 and 4.
    """

    POWERS: ClassVar[Mapping[str, int]] = FrozenMap(
        **dict.fromkeys(("x2", "xy", "y2"), -1),
        **dict.fromkeys(("x3", "x2y", "xy2", "y3"), -2),
        **dict.fromkeys(("x4", "x3y", "x2y2", "xy3", "y4"), -3),
    )
    x2: Any = 0.0
    xy: Any = 0.0
    y2: Any = 0.0
    x3: Any = 0.0
    x2y: Any = 0.0
    xy2: Any = 0.0
    y3: Any = 0.0
    x4: Any = 0.0
    x3y: Any = 0.0
    x2y2: Any = 0.0
    xy3: Any = 0.0
    y4: Any = 0.0

    def _terms(self) -> dict[tuple[int, int], Any]:
        """Return the mapping from exponents (a, b) to the coefficient of x^a y^b."""
        return {
            (2, 0): self.x2,
            (1, 1): self.xy,
            (0, 2): self.y2,
            (3, 0): self.x3,
            (2, 1): self.x2y,
            (1, 2): self.xy2,
            (0, 3): self.y3,
            (4, 0): self.x4,
            (3, 1): self.x3y,
            (2, 2): self.x2y2,
            (1, 3): self.xy3,
            (0, 4): self.y4,
        }

    def sag(self, x: Any, y: Any) -> Any:
        """Return the height at points x, y, in metres (NumPy arrays)."""
        return np.asarray(sum(c * x**a * y**b for (a, b), c in self._terms().items()))

    def height(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the height at points x, y, in metres, and its derivatives along x and y (Dr.Jit arrays)."""
        coefficients: list[Any] = [0.0] * zernike.triangle_size(4)
        for (a, b), c in self._terms().items():
            coefficients[zernike.triangle_index(a, b)] = c
        return zernike.triangle_polynomial(x, y, coefficients, 4)


LAST_NOLL = 36
"""Highest Noll index of Zernike sag terms: all terms to radial order 7."""


@dataclass(frozen=True)
class ZernikeSag:
    """Freeform sag as designed: a sum of Zernike polynomials, a_j Z_j((x - x0)/radius, (y - y0)/radius).

    j is the Noll index and the amplitude a_j the rms over the disk of ``radius`` about (x0, y0), in metres. A mirror's
    figure error is not part of it; that belongs to the state (``Motion.figure``).
    """

    POWERS: ClassVar[Mapping[str, int]] = FrozenMap(
        dict.fromkeys(("radius", "x0", "y0", *(f"Z{j}" for j in range(1, LAST_NOLL + 1))), 1)
    )
    radius: Any = 0.0
    x0: Any = 0.0
    y0: Any = 0.0
    Z1: Any = 0.0
    Z2: Any = 0.0
    Z3: Any = 0.0
    Z4: Any = 0.0
    Z5: Any = 0.0
    Z6: Any = 0.0
    Z7: Any = 0.0
    Z8: Any = 0.0
    Z9: Any = 0.0
    Z10: Any = 0.0
    Z11: Any = 0.0
    Z12: Any = 0.0
    Z13: Any = 0.0
    Z14: Any = 0.0
    Z15: Any = 0.0
    Z16: Any = 0.0
    Z17: Any = 0.0
    Z18: Any = 0.0
    Z19: Any = 0.0
    Z20: Any = 0.0
    Z21: Any = 0.0
    Z22: Any = 0.0
    Z23: Any = 0.0
    Z24: Any = 0.0
    Z25: Any = 0.0
    Z26: Any = 0.0
    Z27: Any = 0.0
    Z28: Any = 0.0
    Z29: Any = 0.0
    Z30: Any = 0.0
    Z31: Any = 0.0
    Z32: Any = 0.0
    Z33: Any = 0.0
    Z34: Any = 0.0
    Z35: Any = 0.0
    Z36: Any = 0.0

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
