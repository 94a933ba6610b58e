"""A first look at a run as a table: copy this file and go on from here. Needs the extra `data`."""

# %% Run the emulated cell, or load an earlier run: canprobe.load_table("runs/…/log.npz")
import canprobe

result = canprobe.run("cylinder", out="runs/first-look", force=True, duration_s=2.0)
print(result.text())

# %% One row a cycle, by time; every column's unit is in attrs["units"]
log = result.to_pandas()
print(log[["phase", "force_n", "contact_mm_2"]].describe())
print({name: log.attrs["units"][name] for name in ("force_n", "contact_mm_2", "q_rad_0")})

# %% How well the force was held during the scan (phase 3), as the array measured it and as it was in the plant; the
# times of all tables count from one instant, which is 0 in bus.log
scan = log[log.phase == 3]
truth = result.to_pandas("truth").reindex(scan.index, method="nearest")
target = result.summary["contact"]["force_target_n"]
rms = ((truth.force_n - target) ** 2).mean() ** 0.5
print(f"force in the scan: measured {scan.force_n.mean():.3f} ± {scan.force_n.std():.3f} N")
print(
    f"                   true     {truth.force_n.mean():.3f} ± {truth.force_n.std():.3f} N; {rms:.3f} N RMS off target"
)

# %% How the curvature estimate settles along the path
estimates = result.to_pandas("estimates")
estimates["sigma_per_m"] = estimates["K_covariance_per_m2_0_0"] ** 0.5
print(estimates[["travelled_m", "kappa_per_m_0", "kappa_per_m_1", "sigma_per_m"]].iloc[::10])

# %% Keep it for R, DuckDB, polars, MATLAB …: units travel in the file's metadata
result.to_parquet("runs/first-look/log.parquet")
again = canprobe.load_table("runs/first-look/log.parquet")
assert again.equals(log)
