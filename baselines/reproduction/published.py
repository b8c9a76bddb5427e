"""Numbers printed in the dissertation, tables 4.1 and 4.2."""

from __future__ import annotations

from typing import NamedTuple


class Printed(NamedTuple):
    """A row of a printed table."""

    task: str
    horizon: int
    lmpc: float
    nmpc: float


# Average position RMS, m.
TABLE_4_1 = (
    Printed("helix", 10, 0.8075, 0.5663),
    Printed("helix", 15, 0.8348, 0.5824),
    Printed("helix", 25, 0.8484, 0.5831),
    Printed("helix", 35, 0.8364, 0.5757),
    Printed("helix", 45, 0.8334, 0.5832),
    Printed("spiral", 10, 1.4984, 1.4739),
    Printed("spiral", 15, 1.5000, 1.4725),
    Printed("spiral", 25, 1.5016, 1.4725),
    Printed("spiral", 35, 1.5009, 1.4720),
    Printed("spiral", 45, 1.5009, 1.4726),
    Printed("lines", 10, 0.3722, 0.3112),
    Printed("lines", 15, 0.3575, 0.3020),
    Printed("lines", 25, 0.3633, 0.3169),
    Printed("lines", 35, 0.3612, 0.3160),
    Printed("lines", 45, 0.3603, 0.3155),
)

# Average input effort, N^2.
TABLE_4_2 = (
    Printed("helix", 10, 0.4205, 0.3838),
    Printed("helix", 15, 0.4107, 0.3724),
    Printed("helix", 25, 0.4057, 0.3652),
    Printed("helix", 35, 0.4084, 0.3665),
    Printed("helix", 45, 0.4114, 0.3674),
    Printed("spiral", 10, 0.1910, 0.1687),
    Printed("spiral", 15, 0.1913, 0.1689),
    Printed("spiral", 25, 0.1914, 0.1700),
    Printed("spiral", 35, 0.1913, 0.1707),
    Printed("spiral", 45, 0.1913, 0.1710),
    Printed("lines", 10, 0.2245, 0.2125),
    Printed("lines", 15, 0.1593, 0.1433),
    Printed("lines", 25, 0.1388, 0.1282),
    Printed("lines", 35, 0.1379, 0.1280),
    Printed("lines", 45, 0.1367, 0.1296),
)
