"""Pure mathematics of touch: from a tactile image to the local shape of the object, and the servo that follows it.

    image ─► Patch, moments ─► ContactSample ─┬► motion ─► stages ─► SurfaceEstimate ─► curvature ─► servo
       image/                   contact       │  estimate/  online/   estimate/answer
                                              └► SurfaceMap ─► Mesh
                                                  map/         meshing

Reading a touch:

    pad               where the taxels are, and what their counts mean
    image/            images: force, centroid, moments, and the model of an array
    array_calibration/   the calibration of an array by touches of known objects, and its check
    contact           from the centroid on the wrapped pad to the object's point and normal in base
    layer_stiffness   the stiffness of the layer: from a push, and as a state of a scan
    stops             the limits at which a touch is stopped, and why a touch at rest must not go on

Shape:

    surface           second-order surfaces in one gauge: XᵀSX = 0 with S symmetric (4, 4), f < 0 inside
    estimate/         local shape from contacts, one by one and in batches, with what was not observed
    online/           the estimator in the loop: the stages that refine an answer, and what widens its region
    map/              one surface from all contacts of a scan, with its uncertainty
    meshing           triangles of any surface that gives the closest point to a place
    linear_algebra, tangent_frames   small matrices, input checks, frames on a tangent plane

Motion:

    servo             a local surface that the samples correct, and the next pose of the probe
    strategies        where the contact goes next
    probe_motion      ways between poses, and the joint steps that follow them

True objects, which no estimator sees: `shapes` (a shape at a pose; bowl, wave, fillet, torus), `objects` (all shapes by
name, and the quadrics), `heights` (a spline over a grid), `mesh_fit` (such a spline from a mesh).

Invariants: SI units, base frame unless a name says otherwise. z of a contact frame is the inward normal; in its own
contact frame a surface has c14 = c24 = c44 = 0 and c34 = −½, so that K = 2 [[c11, c12], [c12, c22]] is the curvature;
κ > 0 is convex. Source: Chen, Rink, Zhang, "Local Object Shape From Tactile Sensing", with the corrections that the
docstrings name. Start reading at `contact`, then `estimate/` and `online/`.
"""
