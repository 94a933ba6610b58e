"""The mathematics of the cell, which stands alone: arms, touch, surfaces. It needs numpy and scipy.

Nothing here depends on a bus, a scene file or a clock. A list of contacts is enough for a surface:

    estimate = fit_surface(points, normals, sigma_point=20e-6, sigma_normal=2e-3)
    estimate.kappa, estimate.observed, estimate.covariance

and many contacts, wherever they are, for a whole surface:

    surface = fit_map(points, normals, sigma_point=20e-6, sigma_normal=2e-3)
    surface.distance(places), surface.curvature(places), surface.mesh()

- `robot` is any serial arm of 1 to 8 joints: geometry, kinematics and their inverse, dynamics, calibration of the tool.
- `touch` goes from a tactile image to the local shape of the object, to the map of a whole scan, and to the servo that
  follows a surface. It also holds the true objects of an emulation.

Invariants: SI units throughout; frames are spelled in names (`T_base_flange` takes flange coordinates to base);
functions are pure, and an algorithm with a state is a small class; what was not observed is marked as unobserved, and
never given as zero.

Of the rest of the package only `canprobe.errors` is imported. Start reading at `touch`, whose text shows the path of a
contact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.mechanics.robot.chain import Chain as Chain
    from canprobe.mechanics.robot.chain import forward as forward
    from canprobe.mechanics.robot.denavit_hartenberg import from_dh as from_dh
    from canprobe.mechanics.robot.model import ArmModel as ArmModel
    from canprobe.mechanics.robot.model import Joint as Joint
    from canprobe.mechanics.touch import ContactSample as ContactSample
    from canprobe.mechanics.touch import Prior as Prior
    from canprobe.mechanics.touch import SurfaceEstimate as SurfaceEstimate
    from canprobe.mechanics.touch import SurfaceMap as SurfaceMap
    from canprobe.mechanics.touch import SurfaceMatrix as SurfaceMatrix
    from canprobe.mechanics.touch import cramer_rao as cramer_rao
    from canprobe.mechanics.touch import fit_map as fit_map
    from canprobe.mechanics.touch import fit_surface as fit_surface
    from canprobe.mechanics.touch import make_object as make_object

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "robot.chain": ("Chain", "forward"),
        "robot.denavit_hartenberg": ("from_dh",),
        "robot.model": ("ArmModel", "Joint"),
        "touch": (
            *("ContactSample", "Prior", "SurfaceEstimate", "SurfaceMap", "SurfaceMatrix"),
            *("cramer_rao", "fit_map", "fit_surface", "make_object"),
        ),
    },
)
