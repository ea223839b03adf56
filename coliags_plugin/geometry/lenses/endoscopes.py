"""Lens and lamp of the 18 endoscopes of EndoMapper (Azagra et al., Scientific Data 2023, arXiv 2204.14240), by name.

The numbers are those of the dataset's geometric and photometric calibrations, as JmeesInc/CLiMB26-jmees (commit
c286e1f0) unifies the latter: the intensity of an image falls off with a power of the cosine of the angle to the lamp's
axis. It has no term for the lens's vignetting, and the table leaves out where the lamps are.
"""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.core.errors import check_name
from coliags_plugin.geometry.lenses.models import FisheyeLens

#: Per endoscope: number; fx fy cx cy (pixel centres at integers) k1 k2 k3 k4 of the lens; power, and x and y of the
#: axis, of the lamp.
_TABLE = """
1 717.6911 718.0214 734.7278 552.0724 -0.1396589 -0.0003139987 0.001505504 -0.0001316715 2.110566 0 0
2 731.4255 732.5445 737.7475 528.234 -0.1266367 -0.007181695 0.001811004 -8.435985e-05 2.746439 0.003184 0
3 726.7941 727.7907 742.7416 542.1428 -0.1289632 -0.006051189 0.001660961 -7.847858e-05 3.321255 0 0
4 733.0653 734.3432 743.3353 539.6794 -0.1273872 -0.006822601 0.001757994 -8.190911e-05 3.069096 0.01028 0.0115
5 725.0401 725.4004 732.6413 532.2588 -0.1243021 -0.009060777 0.002216455 -0.0001106586 2.842822 0.008585 0.002695
6 732.05 733.627 750.7783 540.2329 -0.1227168 -0.008291064 0.001918722 -8.79486e-05 2.872022 0.042791 0
7 727.1851 728.5954 738.1817 537.4003 -0.1311029 -0.005149247 0.001512357 -6.998448e-05 2.962054 0 0
8 732.1237 732.2724 744.0782 533.7642 -0.1234479 -0.009313484 0.002108185 -9.557961e-05 3.045062 -0.034194 1e-05
9 722.4501 724.7698 733.9647 531.8775 -0.1239732 -0.008013424 0.001897534 -8.726712e-05 2.818881 0.079933 0.116518
10 732.4306 734.353 738.311 539.3893 -0.1212004 -0.006871399 -0.002413982 0.0003381683 2.445281 0 0
11 779.7726 781.3549 732.8386 542.7877 -0.1173549 -0.01065752 0.002246621 -0.0001026692 2.035694 0 0
12 798.7009 800.8594 762.7805 534.0589 -0.1226875 -0.008255254 0.001903445 -8.668923e-05 2.165829 0.012746 0
13 785.2939 786.5119 735.3552 527.0021 -0.11391 -0.01307144 0.002729462 -0.0001323343 1.999644 0.129175 0
14 778.093 779.8972 758.6881 522.723 -0.1163844 -0.01293961 0.002741617 -0.0001316264 2.801683 0 0
15 785.2521 786.6768 741.1905 542.8783 -0.1234686 -0.008368 0.001964611 -9.119877e-05 1.859262 0.056558 0.004425
16 781.8292 783.2562 749.186 546.9903 -0.1196276 -0.009985036 0.002201601 -0.0001030625 1.944821 0.038344 0
17 784.9731 787.4725 768.3014 525.7337 -0.1152314 -0.01349485 0.002825019 -0.000135791 2.295218 0 0
18 792.4682 793.8657 752.0146 538.7447 -0.1225753 -0.008555882 0.001950166 -8.838763e-05 2.052345 0.05892 0.006524
"""


@dataclass(frozen=True)
class Endoscope:
    """A calibrated endoscope."""

    lens: FisheyeLens  # at 1440 x 1080
    power: float  # of the cosine of the angle to the lamp's axis
    axis: tuple[float, float, float]  # of the lamp, unit vector in camera axes


def _endoscope(row: str) -> tuple[str, Endoscope]:
    number, fx, fy, cx, cy, k1, k2, k3, k4, power, x, y = map(float, row.split())
    cx, cy = cx + 0.5, cy + 0.5
    lens = FisheyeLens(width=1440, height=1080, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, k3=k3, k4=k4)
    return f"endomapper-{number:02.0f}", Endoscope(lens, power, (x, y, (1.0 - x * x - y * y) ** 0.5))


#: By name, endomapper-01 to endomapper-18.
ENDOSCOPES = dict(map(_endoscope, _TABLE.strip().splitlines()))


def endoscope(name: str) -> Endoscope:
    """Look up an endoscope.

    Raises:
        InputError: There is none of this name.
    """
    check_name("endoscope", name, ENDOSCOPES)
    return ENDOSCOPES[name]
