"""What is checked about the range of paper 001's formulas, and why each tolerance."""

from __future__ import annotations

from twin.validation.check import CONFIRMED, CORRECTED, REFUTED, Check

_INTERPOLATED = "the interpolation of the limit is good to 0.1 %, the first-order prediction to 1 %"
_TABLE_1 = "Table 1, uncertain changes"
_BOX = "the first-order prediction leaves out the distortion and the smaller couplings"
_TABLE_5 = "Table 5 states this as the error of the method"

CHECKS = (
    Check(
        "001.eq2.range", "eq. (2), section 3.3", "(2) reads Δβ within 0.1″ over all that the area CCDs can record: "
        "largest Δβ for which it does", "arcsec", None, 0.05, _INTERPOLATED, "at least",
        tells=2.0, against="a third of the window less",
    ),
    Check(
        "001.eq3.range", "eq. (3), section 3.3", "(3) reads Δα within 0.1″ over all that the area CCDs can record: "
        "largest Δα for which it does", "arcsec", None, 0.05, _INTERPOLATED, "at least", expected=CORRECTED,
        tells=2.0, against="a third of the window less",
    ),
    Check(
        "001.eq5.range", "eq. (5), Table 5", "(5) reads Δγ within Table 5's 2.15″ over all that the area CCDs can "
        "record: largest Δγ for which it does", "arcsec", None, 0.05, _INTERPOLATED, "at least", expected=CORRECTED,
        tells=100.0, against="a sixth of the window",
    ),
    Check(
        "001.eq7.range", "eq. (7), Table 5", "(7) reads Δf within Table 5's 0.04 mm over all that the area CCDs can "
        "record: largest Δf for which it does", "mm", None, 0.05, _INTERPOLATED, "at least",
        tells=2.0, against="half of the window less",
    ),
    Check(
        "001.small_angles.range", "section 2.5", "The angles are small, so tan x ≈ x: largest share by which (2), (3) "
        "and (5) change without their arctangent, over all that the area CCDs can record", "1", None, 0.01,
        "1 % is 0.06″ at the largest Δβ that the area CCDs can record, as much as Table 5 allows", "at most",
        tells=0.03, against="an error as large as that of (3) in this camera",
    ),
    Check(
        "001.eq2.range.field", "eq. (2)", "(2) with its cos²β holds wherever the area CCDs stand: its reading over "
        "the truth at the largest field, divided by the same at the smallest", "1", None, 5e-4,
        "a quarter of what cos²β changes between the two", expected=CORRECTED,
        tells=0.002, against="a factor cos²β too many",
    ),
    Check(
        "001.table1.range.d_beta", _TABLE_1,
        "All four at once, in any combination: Table 1 reads Δβ within 0.1″ over all "
        "that the area CCDs can record: largest box, over the one that fills them",
        "1", None, 0.05, _BOX, "at least",
        tells=0.2, against="four fifths of the box",
    ),
    Check(
        "001.table1.range.d_alpha", _TABLE_1,
        "All four at once, in any combination: Table 1 reads Δα within 0.1″ over all "
        "that the area CCDs can record: largest box, over the one that fills them",
        "1", None, 0.05, _BOX, "at least", expected=CORRECTED,
        tells=0.2, against="four fifths of the box",
    ),
    Check(
        "001.table1.range.d_gamma", _TABLE_1,
        "All four at once, in any combination: Table 1 reads Δγ within Table 5's 2.15″ over all "
        "that the area CCDs can record: largest box, over the one that fills them",
        "1", None, 0.01, _BOX, "at least", expected=CORRECTED,
        tells=0.9, against="a tenth of the box",
    ),
    Check(
        "001.table1.range.d_f", _TABLE_1,
        "All four at once, in any combination: Table 1 reads Δf within Table 5's 0.04 mm over all "
        "that the area CCDs can record: largest box, over the one that fills them",
        "1", None, 0.01, _BOX, "at least", expected=CORRECTED,
        tells=0.9, against="a tenth of the box",
    ),
    Check(
        "001.table1.range.d_alpha.by_d_f", "eqs (8)–(11)", "Δf moves the spots along Y only, so that Δα is read free "
        "of it: error of Δα per Δf", "arcsec/mm", None, 0.01,
        "0.05″, Table 5's, at the largest Δf that the area CCDs can record",
        tells=0.0217, against="an error of 0.1″, section 3.3's, at the largest Δf",
    ),
    Check(
        "001.table1.range.d_beta.by_d_gamma", "eqs (8)–(11)", "Δγ moves the spots along X only, so that Δβ is read "
        "free of it: error of Δβ per Δγ", "1", None, 4e-4,
        "0.05″, Table 5's, at the largest Δγ that the area CCDs can record",
        tells=8.4e-4, against="an error of 0.1″, section 3.3's, at the largest Δγ",
    ),
    Check(
        "001.eq2.defocus", "section 2.4, eq. (2)", "A motion of the line CCD parallel to itself does not change the "
        "visual axis: Δβ read minus true at a defocus of 2λN²", "arcsec", None, 0.05, _TABLE_5, expected=CONFIRMED,
        tells=0.1, against="the accuracy of section 3.3 lost",
    ),
    Check(
        "001.eq3.defocus", "section 2.4, eq. (3)", "A motion of the line CCD parallel to itself does not change the "
        "visual axis: Δα read minus true at a defocus of 2λN²", "arcsec", None, 0.05, _TABLE_5, expected=REFUTED,
        tells=0.1, against="the accuracy of section 3.3 lost",
    ),
    Check(
        "001.eq5.defocus", "section 2.4, eq. (5)", "A motion of the line CCD parallel to itself does not turn the "
        "camera: Δγ read minus true at a defocus of 2λN²", "arcsec", None, 2.15, _TABLE_5, expected=CONFIRMED,
        tells=2.15, against="an error as large as Table 5's",
    ),
    Check(
        "001.eq7.defocus", "section 2.4, eq. (7)", "(7) reads the change of the focal length of a defocused camera: "
        "Δf read minus true change of the principal distance at a defocus of 2λN²", "um", None, 40.0, _TABLE_5,
        expected=CONFIRMED,
        tells=40.0, against="an error as large as Table 5's",
    ),
    Check(
        "001.returns.plane", "section 1.2, eqs (2), (3)", "Return by a plane face: motion of the spots over that of "
        "the line CCD, the axis where it differs more from −2", "1", None, 2e-3,
        "0.1 %: the camera's distortion over the 3 mm from pinhole to area CCD",
        tells=2.0, against="no motion, as after a corner cube",
    ),
    Check(
        "001.returns.roof", "section 1.2, eq. (2)", "Return by a roof prism with its ridge across the line: motion of "
        "the spots over that of the line CCD, along the line", "1", None, 2e-3, "as for the plane face",
        expected=CORRECTED,
        tells=2.0, against="no motion",
    ),
    Check(
        "001.returns.roof_along", "section 1.2, eq. (3)", "Return by a roof prism with its ridge along the line: "
        "motion of the spots over that of the line CCD, across the line", "1", None, 2e-3, "as for the plane face",
        expected=CORRECTED,
        tells=2.0, against="no motion",
    ),
    Check(
        "001.returns.corner", "section 1.2, eqs (2), (3)", "Return by a corner cube, which sends light back on its "
        "own way: motion of the spots over that of the line CCD, the larger of both axes", "1", None, 2e-3,
        "as for the plane face", expected=CORRECTED,
        tells=2.0, against="no motion",
    ),
)  # fmt: skip
