"""Motors that do not speak CANopen: the frames of their makers, and a motor that answers them. Damiao's so far.

A master of such motors has no SYNC, no PDO mapping and no heartbeat. It sends one command to each motor, and each
answers once, with feedback; nothing else is ever sent by a motor. So a cycle is n commands and n answers, and a motor
that is not asked is silent:

    command, ESC_ID       five numbers: torque = kp (p - q) + kd (v - q') + t until the next command comes
    special, ESC_ID       seven bytes FFh, and one that enables, disables, clears a fault or sets the zero
    target, 100h + ESC_ID and 200h, 300h: of position, velocity, limited torque, where register 10 has that mode
    request, 7FFh         reads, writes or stores a register, or asks for feedback
    answer, MST_ID        status, position, velocity, torque, temperatures; or a register

    protocol     bytes and numbers, both ways; `damiao.toml` has the ranges of all types, and all registers
    joint        what a motor turns: inertia and friction, stable at any step
    damiao       the motor: frames and time in, frames and the next deadline out
    search       which motors there are, found by reading registers
    on_bus       several motors and CANopen nodes on one bus: whose identifiers are whose

What masters trip over: numbers are places in ranges which no frame names (registers 21 to 23 have them). A motor in a
fault answers every command and stands still, and only the status, the high nibble of the first byte, shows it. The
watchdog (register 9, ticks of 50 µs) is off as the factory leaves it, and any frame to the motor feeds it. The answer
to a request has the identifier of feedback. MST_ID is 000h at the factory, which is NMT beside CANopen nodes: `on_bus`
refuses that.

Invariants: a decoder raises `ProtocolError` and nothing else; a motor never sleeps, opens, waits or raises, whatever is
on the bus, and computes everything when a frame comes: only a flash that is being written gives it a deadline. So it
runs on a lockstep bus and behind a real interface (`node.serve`), beside CANopen nodes, with the faults of
`tools.faults`. Time is integer nanoseconds on the bus, and seconds in the joint.

Not one byte here was tried on a motor. The sources are public drivers, and one unofficial firmware; docs/motors.md says
where they disagree, and what was decided where they are silent. Start reading at `protocol`, then `damiao`.
"""
