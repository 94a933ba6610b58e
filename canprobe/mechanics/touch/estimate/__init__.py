"""Local shape from contacts: the model, what is assumed, batch fits, online estimators, their answers and their bound.

Points and outward normals come in, each with its noise; a `SurfaceEstimate` goes out: S in the contact frame, K with
its covariance, which combinations of curvature the data observed, and what a reader should know. What is not observed
is NaN with a flag, never a number.

- `noise` holds what is assumed: errors of points and normals, correlated along the path, and the prior.
- `quadric` is the model, nine parameters near the origin of a working frame (c34 = −½) and the cubic and quartic terms
  beside them; its residuals and their Jacobian (`linearise`), from which every fit starts; the rank decision.
- `nonlinear` is robust Gauss–Newton on it, and the average over what a quadric leaves out. `likelihood` makes the `ml`
  fit of it and the Cramér–Rao bound; `window` the estimators over the last samples: `ml`, `chord` and the paper's.
- `recursive` is what runs in the loop: a square-root information filter (`information`) whose first stretch is solved
  as a whole (`start`), which forgets per millimetre travelled and starts afresh where the surface changes.
- `answer` carries a solution to the contact frame and makes the estimate.
- `online` is the interface of the estimators (`add`, `estimate`, `reset`), the gate that every sample passes, and the
  test for a changed surface; `fit` the entry: `fit_surface` for recorded points, `make_estimator` by name.

An answer is computed in one piece: 0.4 ms, after the cycle's commands are out. Start reading at `quadric`, then
`fit`.
"""
