"""What a run leaves behind: summary, scores against the truth, files, tables and figures.

`summary.summarise` makes the document of `summary.json` (versioned by `schema`; what does not apply is null) of a
session and of the `TaskRecord` of its task; `scores` compares with the plant's truth, where there is one. `files`
writes and reads tables and surface maps with their units. All files of a run count time from the 0 of its `bus.log`,
and each is whole or not there.

`array_report` says what a calibration of an array found. `figures` and `surface_figure` draw a run, a plan and a map in
the one look of `picture`; matplotlib is imported there only.
"""
