"""The mathematics of an arm: geometry, kinematics, inverse kinematics, dynamics, tool calibration. Pure functions.

Joint positions come in, and poses, Jacobians and torques go out; or poses come in, and joint positions go out.

    chain                any serial arm of 1 to 8 joints: poses, Jacobians and velocities from one evaluation
    denavit_hartenberg   chains from Denavit-Hartenberg rows
    urdf, urdf_tree      an arm from a URDF, and the links and joints of that file
    urdf_visuals         solids and meshes of the links, for a view
    model                joints of a chain with stops, speeds, motors, friction, bodies; units of its drives, and motor
                         coordinates
    inverse              from poses to joints: rows of a pose that n joints can hold, joints near a known posture, and
                         one step of the inverse Jacobian
    probe_poses          poses and postures that put a probe on a surface
    dynamics             mass matrix and bias torques, computed by MuJoCo
    tool_calibration     the probe's centre on the flange, from touches of a ball

Invariants: frames are spelled in names (`T_base_flange` takes flange coordinates to base). Joint vectors are in rad, or
in m for prismatic joints. A pose that no posture reaches raises a `PlanError` that says why. Start reading at `chain`.
"""
