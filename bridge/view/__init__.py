"""A cell in three dimensions: live in a browser, a recorded run with a time slider, one file to share.

- What is shown: `instants` from samples, with their curves over time, and `recorded` from a run's folder.
- How it looks, in plain numpy: `meshes`, `bodies`, `object_sheet`, `array_dome`, `path`, `surface`, `colours`. `links`
  reads the meshes of a URDF with trimesh.
- Where it is shown, by viser: `stage` is the scene, with `path` and `panel`, on a `server`; `browser` is the
  bridge of a live cell, `replay` a recorded run, `page` one HTML file.

The extra `view` installs viser and trimesh.
"""
