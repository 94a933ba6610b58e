"""Calibrate a tactile array by touches of known objects, and find out while it scans that a calibration is another's.

    touches ─► what is shown ─► image model ─► errors that are left, held out ─► ArrayCalibration
    touches    touches          parameter_fit  calibrate                         image/calibration

    calibrate           fits a calibration to touches of a plane and a ball, with held-out errors
    touches             those touches, and what their images show
    parameter_fit       parameters of the image model, gains of taxels, and dead ones
    pad_fit             lag and scatter of centroids
    push_fit            stiffness, creep and scatter of the force by the arm's way into the object
    calibration_check   whether an array behaves as its calibration says
    blur_fit            the blur of the array, by one image

Images alone do not show newtons, so a calibration names its reference of force. Start reading at `calibrate`.
"""
