#!/usr/bin/env bash
# Start a device program, examine it, end it; the status is that of `canprobe conform`. It is told by its environment:
# DEVICE (a command), NODE, EDS, CHANNEL, and BUS, BASELINE, FAIL_ON, OPTIONS, OUT, PATIENCE_S where they differ.
set -fuo pipefail
bus=${BUS:-socketcan} out=${OUT:-conform} patience_s=${PATIENCE_S:-30}
mkdir -p "$out"

setsid bash -c "$DEVICE" >"$out/device.log" 2>&1 &
device=$!
trap 'kill -- -"$device" 2>/dev/null; wait "$device" 2>/dev/null' EXIT

until canprobe scan --bus "$bus" --channel "$CHANNEL" 2>"$out/scan.log" | grep -q "^$NODE "; do
    if ! kill -0 "$device" 2>/dev/null || ((SECONDS > patience_s)); then
        echo "node $NODE is not on $CHANNEL after $SECONDS s; the last lines of scan and of the device program:" >&2
        tail -n 20 "$out/scan.log" "$out/device.log" >&2
        exit 3
    fi
done

words=(--node "$NODE" --eds "$EDS" --bus "$bus" --channel "$CHANNEL" --fail-on "${FAIL_ON:-deviation}" --json)
[ -z "${BASELINE:-}" ] || words+=(--baseline "$BASELINE")
# shellcheck disable=SC2206 # several words, which are no patterns
words+=(${OPTIONS:-} --junit "$out/conform.xml" --html "$out/conform.html" --log "$out/bus.log")
words+=(--snapshot "$out/snapshot.json")
GITHUB_STEP_SUMMARY="$out/summary.md" canprobe conform "${words[@]}" >"$out/conform.json"
status=$?
if [ -e "$out/summary.md" ]; then
    cat "$out/summary.md"
    [ -z "${GITHUB_STEP_SUMMARY:-}" ] || cat "$out/summary.md" >>"$GITHUB_STEP_SUMMARY"
fi
exit "$status"
