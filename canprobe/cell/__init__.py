"""A robot cell: `fieldbus` and `mechanics` put together by what a scene file says.

    cell file  ┐
    scene file ┴ scene.load ─► Scene ─ scene.resolve ─► Setup ─ planning ─► Plan ─ session ─► Cell ─ Cycle ─► results

- `scene` reads files and resolves them once into a `Setup` in SI units, in which nothing is optional that a task needs.
- `planning` decides what is on the bus, and refuses what the devices, the arm or the bus cannot do.
- `master` is the master's side: bring-up, cycle, drives, array, supervision, lift-off. `tasks` are its controllers.
- `plant` is the model of arm, contact and taxels; `emulated` are the nodes of a cell on it.
- `session` opens one cell with everything round it: ports, emulated nodes, log, interrupts.
- `results` makes summary, files and figures of a run; `recorded` makes measurements of a recorded bus.

Invariants: `master` and `tasks` never see `plant` or `emulated`, nor the reverse: they know each other by the bus
alone, and `session.direct` joins them where there is none. Behind `planning` nobody reads a scene, a millimetre or a
degree. Whatever ends a cell leaves its drives disabled, its log written and its bus closed.

Start reading at `session.session`, which walks the path above, then `master.cell`.
"""
