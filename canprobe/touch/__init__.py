"""Pure mathematics of touch: surfaces, contact, the servo, and maps of what was felt.

- `surface` is the gauge in which every second-order surface is written: XᵀSX = 0 with S symmetric (4, 4), f < 0
  inside, in its own contact frame c14 = c24 = c44 = 0 and c34 = −½, so that K = 2 [[c11, c12], [c12, c22]] is the
  curvature.
- `objects` and `shapes` are the touchable objects: closest point, normal and curvature, exact or by Newton.
- `contact` places a touch: from taxel coordinates on the wrapped pad to the object's point and normal, the squeezed
  layer included, and what a touch at rest says about the layer's stiffness.
- `servo` follows the surface: a local surface that the samples correct, strategies that lead over it, the next pose.
- `patch/` reads tactile images: force, centroid, moments, and curvature from them. `estimate/` finds the local shape
  from contacts. `surface_map` keeps a scan as local patches, `consistency` compares passes where they cross.

SI units, base frame unless a name says otherwise. z of a contact frame is the inward normal; κ > 0 is convex. Source:
Chen, Rink, Zhang, "Local Object Shape From Tactile Sensing", with the corrections that the docstrings name.
"""
