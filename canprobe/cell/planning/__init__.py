"""Setup → plan: which nodes and PDOs are needed, whether they fit the bus, what is left out and why.

What comes in is a `Setup`; what goes out is a frozen `Plan`, or a `PlanError` with every reason at once and the
changes that would fit. Nothing is opened or sent here.

1. `devices` reads each device's EDS file: which objects, PDOs, mappings and bit rates it really has. `operation` finds
   the mode of each drive and the period as it can express it, `units` compares counts, `pdos` finds the PDOs that carry
   what is needed, and `configuration` what is written. What a device lacks and what cannot be done without is a reason;
   what can be done without is listed as not available, with what that means.
2. `choices` has every decision with its reason: what the setup leaves open ("auto"), the cheapest first; what would
   make it fit; what is left out; warnings. For each candidate `make` plans PDOs and identifiers, and `traffic` checks
   SYNC, load, the peak behind one SYNC and the worst-case response time of every message. `window` compares the window
   of the array with the contact patch.
3. `motion` follows the task's path with the arm: reach, stops, speeds, the shape under the probe. `contact` reckons
   there with the layer: whether the joints' counts hold the force, and whether the array shows it.
4. `make.make_plan` puts the answer together: `model.Plan` carries the closed setup, nodes, PDOs, buses, choices, what
   is left out, warnings. Bring-up, cycle, emulator and command line work from it alone.

`report` writes a plan for people and as JSON, `measured` sets a recorded bus beside it, `bridges` is the table of the
tools that can be fed. Start reading at `model`, then `make`.
"""
