"""Pure mathematics of touch: from a tactile image to the local shape of the object, and the servo that follows it.

    image ─► Patch, moments ─► ContactSample ─► estimator ─► SurfaceEstimate ─► LocalPatch ─► SurfaceMap ─► Consistency
       patch/image, moments     contact          estimate/    estimate/answer      surface_map            consistency
                                   └──────────────────────────────► servo ◄─ curvature

- `patch/` reads images: force, centroid, moments, and curvature from them.
- `contact` places a touch: from the centroid on the wrapped pad to the object's point and normal in base, through the
  squeezed layer; it finds the layer's stiffness from a push.
- `estimate/` finds the local shape from contacts, online and in batches, with what was not observed.
- `probe_motion` has the ways between poses of the probe, and the joint steps that follow them.
- `servo` follows the surface: a local surface that the samples correct, strategies that lead over it, the next pose.
- `surface_map` keeps a scan as local patches, `blend` makes one surface of them, `meshing` triangles of that;
  `consistency` compares passes where they cross.
- `surface` is the gauge in which every second-order surface is written: XᵀSX = 0 with S symmetric (4, 4), f < 0
  inside, in its own contact frame c14 = c24 = c44 = 0 and c34 = −½, so that K = 2 [[c11, c12], [c12, c22]] is the
  curvature.
- `objects` and `shapes` are the true objects of the emulation and of scores: closest point, normal and curvature. No
  estimator knows them.

SI units, base frame unless a name says otherwise. z of a contact frame is the inward normal; κ > 0 is convex. Source:
Chen, Rink, Zhang, "Local Object Shape From Tactile Sensing", with the corrections that the docstrings name.
"""
