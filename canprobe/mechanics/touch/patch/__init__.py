"""The contact patch in a tactile image: force, centroid, moments, and curvature from them.

An image comes in as counts of a whole array or of the window round the contact; out come, for the servo and the
estimators, a `Patch` (force in N, centroid in m on the pad, what makes it doubtful) and second moments.

From an image:

    image               sums and centres the pressure
    beyond_window       carries a patch on that the window cuts
    dead_taxels         finds dead taxels and bridges them by their neighbours
    pad_lag             takes off by how much the centroid trails the contact
    moments             second moments of an image
    creep               what an array that creeps remembers of earlier places

Curvature:

    image_model         the forward model: force and moments of an image, from curvature, force and five parameters
    curvature           its inverse over several images: a likelihood of K, fused with what the motion has shown
    fused_answer        the answer of patch and motion together
    fused_estimator     an estimator of motion with the patch as its second sensor

Calibration:

    array_calibration   what is known of one array
    array_models        from a calibration to the models of its array
    calibrate           fits a calibration to touches of known objects, and holds errors out
    image_fit           those touches, and what their images show
    parameter_fit       the parameters of the image model
    pad_fit             how centroids trail and scatter
    taxel_gains         the gain of each taxel, and dead ones
    layer_fit           the stiffness of the layer, by the arm's way into the object

A straight path leaves the curvature across it open, and one touch with its image closes it. The emulated array
(`canprobe.cell.plant.taxels`) shares no formula with this room: the model that makes the data is finer than the one
that reads them. Start reading at `image`, then `image_model`.
"""
