#!/bin/sh
# Run the device with empty non-volatile memory: sh device/run.sh CHANNEL NODE
set -eu
cd "$(dirname "$0")/CANopenDemo/demo"
for name in od_comm mainline od_app od_app_auto; do echo - >"$name.persist"; done
exec ./demoLinuxDevice "$1" -i "$2"
