"""The contact patch in a tactile image: force, centroid, moments, and curvature from them.

An image comes in as counts of a whole array or of the window round the contact. A `Patch` (force in N, centroid in m on
the pad, doubts) and second moments go out, for the servo and the estimators.

From an image:

    image               sums and centres the pressure
    beyond_window       extrapolates a patch that the window cuts
    dead_taxels         finds dead taxels in one image and bridges them by their neighbours
    silent_taxels       finds rows, columns and taxels that do not measure, by several images, and interpolates them
    pad_lag             corrects the lag of the centroid behind the contact
    moments             second moments of an image
    force_reading       the force of each image in its order, without creep, with its standard deviation
    force_creep         corrects the creep of the force by two relaxations
    force_errors        the errors of the force that a calibration states
    blur_fit            the blur of the array, by one image
    calibration_check   whether the array behaves as its calibration says
    creep               traces of earlier places of the patch in the image of an array that creeps

Curvature:

    image_model         the forward model: force and moments of an image, from curvature, force and five parameters
                        its inverse over several images, fused with the motion, is a stage of `touch.online`

Calibration:

    array_calibration   the calibration of one array
    array_models        from a calibration to the models of its array
    calibrate           fits a calibration to touches of known objects, with held-out errors
    image_fit           those touches, and what their images show
    parameter_fit       the parameters of the image model
    pad_fit             lag and scatter of centroids
    taxel_gains         the gain of each taxel, and dead ones
    force_fit           creep, and the scatter of the force against the arm's way
    layer_fit           the stiffness of the layer, by the arm's way into the object

A straight path does not observe the curvature across it; the image of one touch does. The emulated array
(`canprobe.cell.plant.taxels`) shares no formula with this room: the model that makes the data is finer than the one
that reads them. Start reading at `image`, then `image_model`.
"""
