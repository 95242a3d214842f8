"""How far paper 001's monitoring formulas hold: size, combination, defocus, pupil offset, field and kind of return."""
