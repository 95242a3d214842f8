"""Prescriptions written for the tests, in the words of the programs that they are of."""

TMA = """VERS 161019 0 0
MODE SEQ
NAME "three mirrors"
UNIT MM X W X CM MR CPMM
ENPD 100
FTYP 0 0 3 1 0 0 0
XFLN 0 1 -1
YFLN 6 6.1 5.9
WAVM 1 0.65 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
SURF 1
  COMM frame
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
SURF 2
  TYPE EVENASPH
  CURV -1.4825007227597654E-03 0 0 0 0 ""
  CONI -1.5146420994346
  PARM 1 0
  PARM 2 -4.917e-11
  DISZ -201.593
  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0
  DIAM 90 1 0 0 1 ""
  SQAP 70 65 0
  OBDC 0 -54.0
SURF 3
  STOP
  TYPE STANDARD
  CURV -3.7703604697192816E-03 0 0 0 0 ""
  CONI -1.78965940473169
  DISZ 216.2998
  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0
SURF 4
  TYPE COORDBRK
  CURV 0.0 0 0.0 0.0 0
  PARM 1 0
  PARM 2 0.5
  PARM 3 0.25
  PARM 4 0
  PARM 5 0
  PARM 6 0
  DISZ 0
SURF 5
  TYPE STANDARD
  CURV -2.2932203175511623E-03 0 0 0 0 ""
  CONI -0.448918835734448
  DISZ 0
  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0
SURF 6
  TYPE COORDBRK
  CURV 0.0 0 0.0 0.0 0
  PARM 1 0
  PARM 2 -0.5
  PARM 3 -0.25
  PARM 4 0
  PARM 5 0
  PARM 6 1
  DISZ -226.08
SURF 7
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
XYZZY 1 2 3
"""
"""An off-axis three-mirror camera with a third mirror out of place, and a statement that nobody knows."""

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

CODEV = """! off-axis mirror with a bend behind it
RDM Y; LEN
TITLE 'folded'
EPD 50.0
DIM M
WL 700.0 650.0 600.0
REF 2
XAN 0.0 1.0
YAN 0.0 -1.0
SO 0.0 1e13
S 0.0 100.0
  STO
S -1000.0 -300.0 REFL
  CON
  K -1.0
  DAR
  YDE 5.0; ADE 2.0
S -1000.0 &
  400.0 REFL
  ASP
  K 0.5; A 1.0E-9; B 2.0E-15
  ADE 3.0
  BEN
  CIR 60.0
SI 0.0 0.25
  ADE 1.5
FROB 7
GO
"""

BATOID = """# two mirrors and a window
opticalSystem:
  type: CompoundOptic
  name: two mirrors
  inMedium: &vacuum 1.0
  items:
    - type: Mirror
      name: M1
      surface: {type: Quadric, R: 20.0, conic: -1.0}
      obscuration: {type: ClearAnnulus, inner: 0.3, outer: 1.2}
    - {type: Mirror, name: M2, surface: {type: Asphere, R: 6.0, conic: -2.5, coefs: [1.0e-5]}, coordSys: {z: 7.5}}
    -
      type: Lens
      name: window
      medium: {type: ConstMedium, n: 1.46}
      coordSys: {z: -0.2, rotX: 0.01}
      items:
        - {type: RefractiveInterface, name: front, surface: {type: Plane}}
        - {type: RefractiveInterface, name: back, surface: {type: Plane}, coordSys: {z: -0.02}, outMedium: *vacuum}
    - {type: Detector, name: image, surface: {type: Plane}, coordSys: {z: -1.5}}
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
