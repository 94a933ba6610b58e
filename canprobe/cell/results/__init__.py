"""What a run leaves behind: summary, scores against the truth, files, tables and figures.

`open_cell.OpenCell` holds a session. When its block is left it scores what was measured, and makes the `RunData` of the
run once, complete. Files are written and figures are drawn from `RunData`; `RunResult` hands it to the user, and
refuses to be read before. All files of a run count time from the 0 of its `bus.log`, and each is whole or not there.

    open_cell      a cell for controllers, from its bring-up to its results
    run_data       everything that is known of a run when it is over
    result         the same as Python has it: tables, figures, pages and scores on request
    summary        the document of `summary.json` (versioned by `schema`; what does not apply is null), and the files
    scores         comparison with the plant's truth, where there is one
    map_score      the map of a scan and its estimates, as columns and as part of the summary
    contacts       the contacts of a scan, and the errors of estimators on them
    text           a summary as text
    expected       the figures to expect of a packaged scene
    traffic        a recorded bus beside the plan
    run_files      the files of a run's folder, checked when they are read
    files          tables with their units
    surface_file   a surface map as a file
    tool_file      a found tool centre as a file
    array_report   what a calibration of an array found
    figures, plan_figure, surface_figure, surface_sheet, surface_panels   pictures, in the one look of `picture`
    page           a run as a page that replays it

Matplotlib is imported where pictures are drawn only.
"""
