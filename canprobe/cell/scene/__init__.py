"""A scene: the words of a file, checked, and the setup that they mean.

What comes in is TOML text; what goes out is a `Scene` (the user's words and units) and from that a `Setup` (SI units,
whole for its task).

    cell file  ┐
    scene file ┴ load ──► Scene ── resolve ──► Setup

- `model` is the scene as frozen dataclasses: one field a key, its type and checks in the annotation, its meaning
  below. `checks` has the checks, `rules` what goes together across keys, and which sections a task needs.
- `hardware` has sections of a cell file: bus, bring-up, chain, joints and drives, emulated difficulties. A scene
  names a cell and takes from it what it does not say itself; a scene with a section `[cell]` is whole.
- `load` reads a scene with the files that it names, and writes one back: scenes cross processes as text. `reader`
  checks section by section and reports every mistake at once; `toml_files` has the text of TOML; `units` says what the
  end of a key means, on the page of keys, in hints and in SI.
- `resolve` is the only place where millimetres, degrees and kilopascals become SI and defaults become values. `setup`
  is its result; `arms` makes chain, joints and drive units. Planning, cell, tasks and emulator read a `Setup` and
  never a `Scene`.
- `plugins` finds cells, scenes, arrays and estimators of other packages by their entry points.
- `calibrations` reads and writes calibration files of arrays, which `sensor.calibration` names.
- `geometry` turns the object, whose surface may be in a file, the probe and the path of a scene into frames and
  surfaces; it is used by `resolve` and by those who show a scene. `urdf_solids` reads the meshes of an arm, and puts
  spheres round its links.

Invariant: behind `resolve` there is no optional part that "must be there"; a task's setup holds exactly what that
task needs. To add a key: a field in `model`, a line in `resolve`, and its user. Start reading at `model`, then
`resolve`.
"""
