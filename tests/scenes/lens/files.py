"""Prescriptions written for the tests, in the words of the programs that they are of."""

from tests.scenes.refusals.tables import good

TMA, CODEV, BATOID = good("zemax"), good("codev"), good("batoid")
"""An off-axis three-mirror camera with a third mirror out of place, and a statement that nobody knows; an off-axis
mirror with a bend behind it; two mirrors and a window.
"""

SINGLET = """MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 10
FTYP 0 0 2 1 0 0 0
XFLN 0 0
YFLN 0 2
WAVM 1 0.5875618 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.02
  DISZ 4
  GLAS N-BK7 0 0 1.5168 64.17
SURF 2
  CURV -0.02
  DISZ 47.5
SURF 3
  DISZ 0
"""

AGF = """CC catalogue of two
NM GLASSY 2 517642.251 1.5168 64.17 0 0 -1
ED 7.1 8.3 2.51 -0.0009 0
CD 1.03961212 0.00600069867 0.231792344 0.0200179144 1.01046945 103.560653 0 0 0 0
TD 1.86E-06 1.31E-08 -1.37E-11 4.34E-07 6.27E-10 0.17 20
LD 0.3 2.5
NM OLD-SCHOTT 1 0 1.5168 64.17 0 0
CD 2.2718929 -1.0108077e-2 1.0592509e-2 2.0816965e-4 -7.6472538e-6 4.9240991e-7
LD 0.365 1.014
"""
