"""Tactile images: force, centroid and moments of the contact patch, and the model of the array that shows it.

An image comes in as counts of a whole array or of the window round the contact. A `Patch` (force in N, centroid in m on
the pad, doubts) and second moments go out, for the servo and the estimators.

From an image:

    patch               sums and centres the pressure, also of a patch that the window cuts
    silent_taxels       finds taxels that do not measure, in one image or by several, and bridges them
    pad_lag             corrects the lag of the centroid behind the contact
    moments             second moments of an image, and the traces that creep leaves in them
    force_reading       the force of each image in its order, without creep, with its standard deviation
    force_creep         corrects the creep of the force by two relaxations
    force_errors        the errors of the force that a calibration states

The array:

    calibration         the calibration of one array, which all of these rest on (`touch.array_calibration` finds it)
    image_model         the forward model: force and moments of an image, from curvature, force and five parameters

A straight path does not observe the curvature across it; the image of one touch does (`online.patch_curvature`). The
emulated array (`canprobe.cell.plant.taxels`) shares no formula with this room: the model that makes the data is finer
than the one that reads them. Start reading at `patch`, then `image_model`.
"""
