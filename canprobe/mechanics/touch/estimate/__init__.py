"""Local shape from contacts: the model, what is assumed, batch fits, online estimators, their answers and their bound.

Points and outward normals come in, each with its noise; a `SurfaceEstimate` goes out: S in the contact frame, K with
its covariance, which combinations of curvature the data observed, and notes for a reader. What was not observed is NaN
with a flag, never a number.

Model and assumptions:

    quadric             the nine parameters near the origin of a working frame, the cubic and quartic terms beside them,
                        their gradients, and changes of the origin
    residuals           residuals of samples and their Jacobian, from which every fit starts
    noise, prior        errors of points and normals, correlated along the path; the surface before it is touched
    path_length         how far a contact has moved beyond its noise, and how its places spread

Fits of a batch:

    nonlinear           robust Gauss–Newton on the model
    likelihood          the `ml` fit and the Cramér–Rao bound
    differences         linear estimates from differences of points and normals
    misfit              the terms that a quadric leaves out, found in the residuals or allowed for

Estimators, one sample after another:

    estimator           their interface: `add`, `estimate`, `reset`, and the first two in steps
    gate                the gate of every sample, and its errors behind it
    window              over the last samples: `ml`, `chord`, and `chen1996`, the scheme of the paper
    recursive           what runs in the loop: forgets per millimetre, starts afresh where the surface changes
    information         the square-root information filter under it
    start               its first stretch, solved as a whole by single Gauss–Newton steps
    omitted_terms       the terms of `misfit`, in constant time and memory
    sandwich            the covariance of weighted and correlated rows
    change              the test for a changed surface

Answers:

    observed            what one source says about curvature, and which combinations of it count as observed
    answer              a solution carried to the contact frame: the estimate
    matrix              all ten unknowns of S of an estimate with their covariance, in any frame
    fit                 the entry: `fit_surface` for recorded points, `make_estimator` by name

An answer takes 0.4 ms. In the loop the stages of `touch.online` refine it, and the work is cut into steps, of which a
cycle carries one after its commands are out (`estimator`). Start reading at `quadric`, then `fit`.
"""
