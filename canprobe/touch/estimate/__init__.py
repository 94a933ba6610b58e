"""Local shape from contacts: the model, what is assumed, batch fits, online estimators, their answers and their bound.

Points and outward normals come in, each with its noise; a `SurfaceEstimate` goes out: S in the contact frame, K with
its covariance, which combinations of curvature the data observed, and what a reader should know. What is not observed
is NaN with a flag, never a number.

- `quadric` is the nine-parameter model near the origin of a working frame (c34 = −½) and the rank decision; `noise`
  the errors of points and normals, correlated along the path, and the prior.
- `nonlinear` is Gauss–Newton on it, robust, with the terms that a quadric leaves out; `likelihood` the `ml` fit and
  the Cramér–Rao bound; `window` the estimators over the last samples: `ml`, `chord` and `chen1996`, the paper's.
- `recursive` is what runs in the loop: a square-root information filter (`information`) whose first stretch is solved
  as a whole (`start`), which forgets per millimetre travelled and starts afresh where the surface changes.
- `online` is the interface of all of them (`add`, `estimate`, `reset`) and the gate that every sample passes;
  `answer` makes the estimate; `fit` is the entry for recorded points.

An answer is computed in one piece: 0.4 ms, after the cycle's commands are out. Start reading at `quadric`, then
`fit`.
"""
