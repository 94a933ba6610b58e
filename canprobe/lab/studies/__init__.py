"""Studies: accuracy, limits, faults and timing of canprobe, each with a table, CSV, JSON and a picture.

`canprobe study NAME` imports the module of that name and calls `run(quick=…, sweep=…) → StudyResult`. A study lists its
cases; the sweep measures each case once, in any process; the study makes rows and findings of the answers, and a
function that draws them. `--quick` takes fewer cases and repeats. No other room imports a study.

`harness` has the result of a study, its files, and the store of finished cells. `sweep` computes cells on all cores or
on a cluster, keeps what is finished, and lists the studies.

Estimators: `estimators` (error against run time), `bound` (error and coverage over the Cramér–Rao bound), `regions`
(coverage with the whole sensor, packaged and random scenes), `shapes` (whole surfaces beside those of other methods),
`arrays` (calibration of unseen arrays). Plant and loop:
`workprec`, `workprec_cell`, `stability` with `stability_runs`. Robustness: `faults` with `fault_scores`, `faults_vcan`.
Real time: `realtime` with `realtime_cases`, `realtime_soak`.
"""
