"""Studies: accuracy, limits, faults and timing of canprobe, each with a table, CSV, JSON and a picture.

`canprobe study NAME` imports the module of that name and calls `run(quick=…, sweep=…) → StudyResult`. A study lists its
cases; the sweep measures each case once, in any process; the study makes rows and findings from the answers, and a
function that draws them. `--quick` takes fewer cases and repeats. No other room imports a study.

    sweep       lists the studies; computes cells on processes of this machine, keeps what is finished
    cell_store  finished cells on disk, with a digest of the code behind them
    result      the result of a study: columns, rows, findings, picture; its files; facts and intervals
    figure      a figure that many studies have
    many        many runs of one scene, for `canprobe.run_many`; no study

    estimators  error against run time, on `ground`; `bound`: error and coverage over the Cramér–Rao bound
    regions     coverage with the whole sensor on `random_scenes`; `region_scores`
    calibration  of unseen arrays by `array_presses`, their force, and foreign calibrations
    surfaces    whole surfaces of `drawn_shapes` beside those of `surface_methods`, and the paths of `exploration`
    workprec    error of the dynamic plant against its run time
    stability   `stability_runs`, `stability_extremes`, `linear_loop`
    faults      `fault_cases`, `fault_runs`, `witnessed_run`; `faults_vcan`
    faults --recover  `recover`, `recover_runs`; `recover_vcan`
    realtime    `realtime_soak`; `realtime_link` on `link_setups`; `vcan_cells`: what studies in real time share
"""
