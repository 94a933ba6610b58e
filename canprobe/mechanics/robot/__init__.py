"""The arm as mathematics: geometry, kinematics, inverse kinematics, dynamics, tool calibration. Pure functions.

- `chain` is the geometry of any serial arm of 1 to 8 joints, revolute or prismatic: poses, Jacobians and velocities
  from one evaluation on plain floats. Chains come from Denavit-Hartenberg rows, or by `urdf` out of a file.
- `model` puts the joints to a chain (stops, speeds, motors, friction, bodies) and how drive units follow from them.
- `inverse` goes from poses to joints numerically: what n joints can hold of a pose, the joints for a pose from a known
  posture on, damped steps of the Jacobian near singular poses, and postures that put the probe on a surface.
- `dynamics` has mass matrix and bias torques of an arm with what it carries, computed by MuJoCo.
- `tool_calibration` finds the probe's centre on the flange from touches of a ball.

Frames are spelled in names: `T_base_flange` takes flange coordinates to base. Joint vectors are rad, of
prismatic joints m; lengths are m. What no posture can reach is a `PlanError` that says why. Nothing here knows a scene,
a bus or a time.
"""
