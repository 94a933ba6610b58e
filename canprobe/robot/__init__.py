"""The arm as mathematics: geometry, kinematics, inverse kinematics, dynamics, tool calibration. Pure functions.

- `kinematics` holds the arm's numbers (links, limits, motor counts per radian with the wrist's coupling) as a frozen
  model, and forward kinematics and Jacobian on plain floats: a 2.5 ms cycle cannot pay for small numpy calls.
- `inverse` goes from poses to joints: all closed-form branches, the branch near a known posture, damped steps of the
  Jacobian near singular poses, and postures that put the probe on a surface.
- `dynamics` has masses, mass matrix and bias torques of the arm with its probe; `straight_line` writes such
  arithmetic down as one compiled function, which the dynamic plant steps through.
- `tool_calibration` finds the probe's centre on the flange from touches of a ball.

Frames are spelled in names: `T_base_flange` takes flange coordinates to base. Joint vectors are rad, lengths m. What
no posture can reach is a `PlanError` that says why. Nothing here knows a scene, a bus or a time.
"""
