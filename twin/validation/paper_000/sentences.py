"""What paper 000's text says of its Figs. 3 to 5 (sections 2.3.1 and 2.3.2), sentence by sentence, as data, and the
number that decides each.

The paper's words have no numbers: "far more" is taken as at least twice, "very near" as within a quarter, "little" as
at most a quarter of the largest, and a slope that grows as one that grows by 5 %, the least that shows in a figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from twin.validation.checks.check import CORRECTED, OF_AGREEMENT, REFUTED, Basis, Check, Comparison, Verdict

Kind = Literal["signs", "largest", "far", "alike", "little", "grows", "opposite"]
Angle = Literal["alpha", "beta"]
Rises = Mapping[tuple[str, Angle, str], float]
"""(what is moved, angle, axis) -> change of the angle for 10 m, arcsec."""

AXES = ("x", "y", "z")
FAR, ALIKE, LITTLE, GROWS = 2.0, 1.25, 0.25, 0.05
GREEK: Mapping[str, str] = {"alpha": "α", "beta": "β"}


@dataclass(frozen=True)
class Sentence:
    """One statement: how `angle` answers when `what` is moved.

    Attributes:
        name: of the check, without the paper.
        where: figure and sentence.
        kind: what is said.
        what: "station", or the line whose points move.
        angle: of which it is said.
        axes: of which it is said; for signs those along which the angle rises.
        others: with which they are compared; for signs those along which it falls.
        expected: the verdict, where it is not that of agreement.
        basis: "chosen" where it does not hold everywhere, so that the place of the pass decides; "theory" where it
            cannot fail.
        theory: why it cannot.
    """

    name: str
    where: str
    kind: Kind
    what: str
    angle: Angle
    axes: tuple[str, ...]
    others: tuple[str, ...] = ()
    expected: Verdict = OF_AGREEMENT
    basis: Basis = "chosen"
    theory: str = ""

    @property
    def text(self) -> str:
        """The sentence, with what is measured."""
        moved = "the station" if self.what == "station" else f"the {self.what} points"
        sign, axes, others = GREEK[self.angle], " and ".join(self.axes), " and ".join(self.others)
        return {
            "signs": f"{sign} rises with {axes} and falls with {others} of {moved}: least change that way for 10 m",
            "largest": f"{axes} of {moved} moves {sign} most: its change over that by {others}",
            "far": f"{axes} of {moved} moves {sign} far more than {others}: ratio of the changes",
            "alike": f"{axes} of {moved} move {sign} much alike: larger change over smaller",
            "little": f"{axes} of {moved} moves {sign} little: its change over the largest",
            "grows": f"{sign} changes ever faster with the station's error: least growth of a slope from 0 to 10 m",
            "opposite": "The nadir points move α and β oppositely: −Δβ/Δα of the axis that is farthest from 1",
        }[self.kind]

    def check(self) -> Check:
        """As the validation takes it."""
        compared: dict[Kind, tuple[str, float, str, Comparison, float, str]] = {
            "signs": ("arcsec", 0.01, "less is not seen in a figure of arc seconds", "at least", 0.1,
                      "a change the other way that a figure would show"),
            "largest": ("1", 0.01, "1 %, less is not seen in a figure", "at least", 0.5,
                        "half as much as by another axis"),
            "far": ("1", 0.02, "far more is taken as at least twice; 1 % is not seen in a figure", "at least", 1.0,
                    "as much as by the others"),
            "alike": ("1", 0.02, "much alike is taken as within a quarter; 1 % is not seen in a figure", "at most",
                      0.75, "twice as much by one as by the other"),
            "little": ("1", 0.01, "little is taken as a quarter of the largest; 1 % is not seen", "at most", 0.75,
                       "as much as the largest"),
            "grows": ("1", 1e-3, "a fiftieth of the growth of 5 % that would show in a figure", "at least", 0.05,
                      "a straight line"),
            "opposite": ("1", 0.01, "1 %, less is not seen in a figure", "two-sided", 2.0, "changes the same way"),
        }  # fmt: skip
        unit, tolerance, because, comparison, tells, against = compared[self.kind]
        return Check(
            f"000.{self.name}", self.where, self.text, unit, None, tolerance, because, comparison, self.expected,
            separation=tells, alternative=against, basis=self.basis, theory=self.theory,
        )  # fmt: skip

    @property
    def implied(self) -> float:
        """What the sentence asks of `measure`."""
        return {
            "signs": 0.0, "largest": 1.0, "far": FAR, "alike": ALIKE, "little": LITTLE, "grows": GROWS, "opposite": 1.0,
        }[self.kind]  # fmt: skip

    def measure(self, rises: Rises, growth: Rises) -> float:
        """The number that decides; growth: relative growth of the slopes, by the same keys."""

        def rise(axis: str, angle: Angle = self.angle) -> float:
            return rises[self.what, angle, axis]

        size = {axis: abs(rise(axis)) for axis in AXES}
        if self.kind == "signs":
            return min([rise(axis) for axis in self.axes] + [-rise(axis) for axis in self.others])
        if self.kind in ("largest", "far"):
            return min(size[axis] for axis in self.axes) / max(size[axis] for axis in self.others)
        if self.kind == "alike":
            return max(size[axis] for axis in self.axes) / min(size[axis] for axis in self.axes)
        if self.kind == "little":
            return max(size[axis] for axis in self.axes) / max(size[axis] for axis in self.others)
        if self.kind == "grows":
            return min(growth[self.what, self.angle, axis] for axis in AXES)
        return max((-rise(axis, "beta") / rise(axis, "alpha") for axis in AXES), key=lambda ratio: abs(ratio - 1.0))

    def holds(self, rises: Rises, growth: Rises) -> bool:
        """Whether the number says so, as the check compares it."""
        check = self.check()
        return check.outside(self.measure(rises, growth), self.implied) <= check.tolerance


YZ, XZ, XY = ("y", "z"), ("x", "z"), ("x", "y")

SENTENCES: tuple[Sentence, ...] = (
    Sentence("fig3.alpha_signs", "Fig. 3 (1)", "signs", "station", "alpha", ("x",), YZ),
    Sentence("fig3.beta_signs", "Fig. 3 (1)", "signs", "station", "beta", ("x",), YZ),
    Sentence("fig3.alpha_largest", "Fig. 3 (2)", "largest", "station", "alpha", ("z",), XY, basis="printed"),
    Sentence("fig3.beta_largest", "Fig. 3 (3)", "largest", "station", "beta", ("y",), XZ, basis="printed"),
    Sentence("fig3.alpha_growth", "Fig. 3 (4)", "grows", "station", "alpha", AXES, expected=REFUTED, basis="printed"),
    Sentence("fig3.beta_growth", "Fig. 3 (4)", "grows", "station", "beta", AXES, expected=REFUTED, basis="printed"),
    Sentence("fig4.forward_alike", "Fig. 4 (1)", "alike", "forward", "alpha", XZ, expected=CORRECTED, basis="printed"),
    Sentence("fig4.forward_signs", "Fig. 4 (1)", "signs", "forward", "alpha", ("y",), XZ),
    Sentence("fig4.forward_y", "Fig. 4 (1)", "far", "forward", "alpha", ("y",), XZ),
    Sentence("fig4.nadir_signs", "Fig. 4 (2)", "signs", "nadir", "alpha", XZ, ("y",)),
    Sentence("fig4.nadir_yz", "Fig. 4 (2)", "largest", "nadir", "alpha", YZ, ("x",), basis="printed"),
    Sentence("fig5.nadir_signs", "Fig. 5 (1)", "signs", "nadir", "beta", ("y",), XZ),
    Sentence("fig5.nadir_yz", "Fig. 5 (1)", "far", "nadir", "beta", YZ, ("x",)),
    Sentence("fig5.aft_signs", "Fig. 5 (2)", "signs", "aft", "beta", ("z",), ("y",)),
    Sentence("fig5.aft_x", "Fig. 5 (2)", "little", "aft", "beta", ("x",), YZ),
    Sentence("fig5.aft_largest", "Fig. 5 (2)", "largest", "aft", "beta", ("z",), XY, basis="printed"),
    Sentence("fig5.opposite", "Fig. 5 (3)", "opposite", "nadir", "alpha", AXES, basis="theory",
             theory="an identity: α + β is the angle between forward and aft plane, which no nadir point moves"),
)  # fmt: skip
