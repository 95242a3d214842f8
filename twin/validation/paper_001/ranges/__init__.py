"""How far paper 001's monitoring formulas hold: size, combination, defocus, pupil offset, field and kind of return."""

from twin.validation.paper_001.ranges.ranges_group import GROUP

__all__ = ["GROUP"]
