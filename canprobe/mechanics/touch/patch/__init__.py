"""The contact patch in a tactile image: force, centroid, moments, and curvature from them.

An image comes in as counts of a whole array or of the window round the contact; out come, for the servo and the
estimators, a `Patch` (force in N, centroid in m on the pad, what makes it doubtful) and second moments.

- `image` sums and centres the pressure, carries a patch on that the window or a dead taxel cuts, and undoes the
  array's hysteresis lag as far as it is calibrated.
- `moments` takes second moments of an image, and knows what the pad remembers.
- `image_model` is the forward model, physical, of five parameters: how curvature, force and the array make force and
  moments of an image; its inverse is Gauss-Newton on K.
- `curvature` inverts it over several images into a likelihood of K, and fuses that with what the motion has shown: a
  straight path leaves the curvature across it open, and one touch with its image closes it.
- `array_calibration` is what is known of one array; `calibrate` fits it to touches of known things, with
  `image_fit` and `pad_fit`.

The emulated array (`canprobe.cell.plant.taxels`) shares no formula with this room: the model that makes the data
is finer than the one that reads them.
"""
