"""A cell in three dimensions: live in a browser, a recorded run with a time slider, one file to share.

- What is shown: `instants` from samples, with their curves over time, and `recorded` from a run's folder.
- How it looks: `links` of an arm, `array_dome` of the probe, `object_sheet` of the true object, `path` and `surface` of
  what was touched; with `meshes`, by trimesh, and `colours`.
- Where it is shown, by viser: `stage` is the scene, with `path` and `panel`, on a `server`; `browser` is the
  bridge of a live cell, `replay` a recorded run, `page` one HTML file.

The extra `view` installs viser and trimesh.
"""
