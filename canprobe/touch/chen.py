"""The scheme of Chen, Rink and Zhang (1996), (24)–(35), as printed.

From a stretch of contact, in the contact frame of its last sample: `x_i = −S y_i` (27) with
`x_i = ω × n_f + S_f v_f` (28), `y_i = V + v` (29), assembled to `A c = b` (30)–(34) with the boundary row. What is not
in print, and had to be settled:

- S in (27)–(28) means 2S (of both bodies): as printed, (28) drops the factor 2 on S' and κ would be wrong by it.
- All y_i4 are 0, so the columns of c14, c24, c34, c44 vanish: A has rank 7 at most, (35) is singular for every motion.
  Solved by SVD (least norm), then put into the gauge c14 = c24 = c44 = 0, c34 = −½.
- Rates are differences of samples `lag` apart.

Known faults, reproduced: a bias of some percent where |∇f| is not constant, and noise in y that draws κ towards 0.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing", section 4.1.2.
"""

from __future__ import annotations

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.batch import Touches
from canprobe.touch.differences import Pairs, estimate_from, pseudo_inverse, three_rows
from canprobe.touch.estimate import SurfaceEstimate

_SIX = (0, 1, 2, 4, 5, 7)
"""Places of c11 c12 c13 c22 c23 c33 in the ten of (31)."""


def paper_system(x: Array, y: Array) -> tuple[Array, Array]:
    """A ((3N+1), 10) and b ((3N+1),) of (30)–(34).

    Args:
        x, y: (N, 3) rows of (28) and (29); their fourth components are 0.
    """
    A = np.zeros((3 * len(y) + 1, 10))
    A[:-1, list(_SIX)] = three_rows(y)
    A[-1, 9] = 1.0  # the boundary condition f = 0 at the origin
    return A, np.append(-x.reshape(-1), 0.0)


def solve_paper(touches: Touches, data: Pairs) -> SurfaceEstimate:
    """The scheme's estimate from y = `data.points` and −x = `data.normals`."""
    A, _ = paper_system(-data.normals, data.points)
    return estimate_from(touches, data, pseudo_inverse(A)[list(_SIX), :-1], "chen1996")


def usable_lag(n: int, lag: int) -> int:
    """The lag that n samples allow: at most half of them."""
    return max(1, min(lag, (n - 1) // 2))
