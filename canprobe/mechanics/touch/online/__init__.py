"""The way of an answer in the loop: an estimator of the motion, and the stages that refine its answer, one by one.

    contact ─► motion ─► PatchFusion ─► NoiseLevel ─► SystematicErrors ─► MapFusion ─► SurfaceEstimate
               estimate/  patch_fusion   noise_level   systematic_errors   map_fusion

One `OnlineEstimator` holds the motion (`recursive` or `ml`) and the stages; a stage takes every contact that the motion
has used, and refines every answer. A stage that works long is a step by itself: a cycle carries one step of the work.
There is one answer object: a stage changes some fields of it and leaves the rest, `with_solution` where the curvature
changes, `regions` where its errors do.

    estimator           the estimator, the interface of a stage, and the path from answer to answer
    patch_fusion        the contact patch as a second sensor; before the contact moves, the patch's answer alone
    patch_curvature     what the images of a contact say about curvature, fused with what the motion has shown
    noise_level         variances by the level of the innovations
    systematic_errors   errors that no path averages: lag, scale, tool, pad
    map_fusion          ground that was touched before
    regions             changes of an answer's covariance, and the list of what widens a region
    beyond              forces and speeds that neither calibration nor settings have seen

Start reading at `estimator`, then `regions`.
"""
