"""The map: one surface from all contacts of a scan, with its uncertainty; it grows contact by contact.

    contacts ─► nodes ─► discs round cells ─► quartics, common errors ─► solved cells ─► one surface ─► mesh
                nodes    discs                local_fits, quartic         cells,          surface_map    meshing
                                                                          stiffness

`fit.fit_map` makes a map of points and normals; `SurfaceMap.add_samples` takes the contacts of a cell's pad. Read
`surface_map` first, then `cells`, then `local_fits`, where the model stands.

Contacts become nodes, means over a millimetre of path. Round the middle of every occupied cell of 3 mm a quartic is
fitted to the nodes of one sheet within 5.5 to 12 mm, whichever pass they are from: heights and slopes with the noise of
`noise`, a prior on curvature and its changes, and evidence to choose how much the surface changes. The errors that a
whole scan has in common (lag, scale and offsets of the pad, stiffness of its layer) are found by all discs together, so
that passes that seem to disagree by them agree. A place asks the four nearest cells.

Invariants: SI units, one frame for all contacts (base). κ > 0 is convex. What was not observed is NaN and never a
number that only the prior knows. Memory grows with the ground, not with time: ground that is scanned again is averaged
into its nodes.
"""
