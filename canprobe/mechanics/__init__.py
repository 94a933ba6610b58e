"""The mathematics of the cell, which stands alone: arms, touch, surfaces. It needs numpy and scipy.

Nothing here knows a bus, a file of a scene or a clock. A list of contacts is enough for a surface:

    from canprobe.mechanics.touch.estimate.fit import fit_surface
    estimate = fit_surface(points, normals, sigma_point=20e-6, sigma_normal=2e-3)
    estimate.kappa                                             principal curvatures, 1/m, with their covariance

- `robot` is any serial arm of 1 to 8 joints: geometry, kinematics and their inverse, dynamics, calibration of the tool.
- `touch` goes from a tactile image to the local shape of the object, to the map of a whole scan, and to the servo that
  follows a surface. It also holds the true objects of an emulation.

Invariants: SI units throughout; frames are spelled in names (`T_base_flange` takes flange coordinates to base);
functions are pure, and an algorithm with a state is a small class with one `step`; what was not observed is said to be
unobserved, never zero.

Of the rest of the package only `canprobe.errors` is seen. Start reading at `touch`, whose text shows the path of a
contact.
"""
