"""Setup → plan: which nodes and PDOs are needed, whether they fit the bus, what is left out and why.

What comes in is a `Setup`; what goes out is a frozen `Plan`, or a `PlanError` with every reason at once and the
changes that would fit. Nothing is opened or sent here.

1. `device_capabilities` reads what each device can from its EDS file (objects, PDOs, mappings, bit rates), and names
   what a device cannot take its part without. `sync` finds the mode of each drive, the SYNC period, the period as each
   drive takes it and the trigger of the array. `units` compares counts, `pdos` finds the messages that carry what is
   needed, `identifiers` gives them their order, and `configuration` has what is written.
   What a device lacks and what cannot be done without is a reason; what can be done without is listed as not
   available, with what that means.
2. `free_parameters` closes what the setup leaves open ("auto"). What costs least is tried first: other mappings and
   priorities before other hardware (CAN FD, a second bus), and less from the array last of all. What a scene writes is
   kept. It also suggests changes that would make a scene fit. `advice` names what a scene does not need, and
   what is carried out and yet said first. For each candidate `make` fills a `BusPlan` step by step: PDOs, identifiers,
   raw frames, traffic; `wire_time` gives the time of a PDO on the wire, and `traffic` checks SYNC, load, the peak
   behind one SYNC and the worst-case response time of every message. `array` states what the taxels support, and
   compares the window of the array with the contact patch.
3. `surface_path` lays the task's path over the object; `motion` follows it with the arm: reach, stops, speeds.
   `contact` reckons there with the layer: whether the joints' counts hold the force, and whether the array shows it
   before the limit is reached.
4. `make.make_plan` puts the answer together: `model.Plan` carries the closed setup, nodes with their configuration,
   PDOs, buses, choices, what is left out, warnings. Bring-up, cycle, emulator and command line work from it alone.

`report` writes a plan for people and as JSON, `timeline` draws its cycles, `measured` sets a recorded bus beside it,
`bridges` is the table of the tools that can be fed. Start reading at `model`, then `make`.
"""
