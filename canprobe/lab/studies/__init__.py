"""Studies: accuracy, limits, faults and timing of canprobe, each with a table, CSV, JSON and a picture.

`canprobe study NAME` imports the module of that name and calls `run(quick=…, sweep=…) → StudyResult`. A study lists its
cases; the sweep measures each case once, in any process; the study makes rows and findings from the answers, and a
function that draws them. `--quick` takes fewer cases and repeats. No other room imports a study.

    sweep         lists the studies; computes cells, keeps what is finished
    executors     where cells are computed: processes of this machine, or a Dask cluster
    cell_store    finished cells on disk, with a digest of the code behind them
    harness       the result of a study: columns, rows, findings, picture
    result_files  the result as text, CSV, JSON and picture
    many          many runs of one scene, for `canprobe.run_many`; no study

Estimators: `estimators` (error against run time) and `bound` (error and coverage over the Cramér–Rao bound) stand on
`ground`, `bound` also on `bound_cases`, `bound_scores` and `bound_figure`; `regions` measures coverage with the whole
sensor on `random_scenes`, with `region_scores` and `region_figure`; `shapes` compares whole surfaces with those of
other methods; `arrays` calibrates unseen arrays, and with `array_forces` scores their force; `calibrations`
counts the scans that notice a calibration of another array.
Plant and loop: `workprec`, with `workprec_cell` (`workprec_cell_choice`, `workprec_cell_figure`) on `no_bus`;
`stability` with `stability_runs`, `stability_extremes` and `linear_loop`.
Exploration: `explore`, on the shapes of `shapes`.
Robustness: `faults` with `fault_cases`, `fault_runs`, `witnessed_run`; `faults_vcan`.
Link: `link` with `link_setups` and `link_rates`; `recover` with `recover_cases`, `recover_runs` and `recover_vcan`.
Real time: `realtime` with `realtime_cases`, `cycle_times` and `plain_canopen`; `realtime_soak`.
"""
