"""Results of a run: summary, scores against the truth, files, tables and figures.

`open_cell.OpenCell` holds a session. When its block is left it scores the measurements, and makes the `RunData` of the
run once, complete. Files are written and figures are drawn from `RunData`; `RunResult` hands it to the user, and
refuses to be read before. All files of a run count time from the 0 of its `bus.log`, and each is whole or not there.

    open_cell      a cell for controllers, from its bring-up to its results
    run_data       all data of a finished run
    result         the data for Python users: tables, figures, scores and the page that replays a run, on request
    summary        the document of `summary.json` (versioned by `schema`; what does not apply is null), and the files
    scores         comparison with the plant's truth, where there is one; a map and estimates as columns; the contacts
                   of a scan, and the errors of estimators on them
    text           a summary as text
    expected       the figures to expect of a packaged scene
    traffic        a recorded bus beside the plan
    run_files      the files of a run's folder, checked when they are read; tables of them with their units
    surface_file   a surface map as a file, with all of S of the answers of its scan
    recording      images as a CSV file, with poses of the probe where there are some
    tool_file      a calibrated tool centre as a file
    array_report   text and picture of an array's calibration
    figures, plan_figure, surface_figure   pictures, all in the style of `picture`

Matplotlib is imported only where pictures are drawn.
"""
