"""Studies: what canprobe reaches, measured, each with a table, CSV, JSON and a picture.

`harness` is what a study is, its files and the store of its finished cells; `sweep` runs many independent cells on
all cores or on a cluster, and takes the rest up again after an interruption. `figure` has what the pictures of
studies share.

Estimators: `estimators` (error against run time), `bound` (error and coverage over the Cramér–Rao bound), `pipeline`
(coverage with the whole sensor). Plant and loop: `workprec`, `workprec_cell`, `stability` with `stability_runs`.
Robustness: `faults` with `fault_scores`, `faults_vcan`. Real time: `realtime` with `realtime_cases`, `soak`.
`array_calibration` calibrates the emulated array.

Every study runs as `canprobe study NAME`, with `--quick` for a first look. Nothing in the package imports a study.
"""
