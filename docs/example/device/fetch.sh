#!/bin/sh
# Fetch CANopenNode's demo device for Linux at the commits that were tried, and build it. CANOPENNODE names another
# place of its three repositories, such as a folder with clones.
set -eu
cd "$(dirname "$0")"
from=${CANOPENNODE:-https://github.com/CANopenNode}

fetch() { # repository, commit, folder
    [ -e "$3/.git" ] || git clone -q "$from/$1" "$3"
    git -C "$3" checkout -q "$2"
}

fetch CANopenDemo 1f16f496cf9bec459d0c86307572eac7cdbc2ebd CANopenDemo
fetch CANopenLinux 064b4c4e702fbff1131075e66459abab37d0f3ed CANopenDemo/CANopenLinux
fetch CANopenNode 9b8beed8367241e96ac03f916cd5a500bcb2cf23 CANopenDemo/CANopenLinux/CANopenNode
# with two threads it misses an abort of a client now and then
make -s -C CANopenDemo/demo OPT="-w -DCO_SINGLE_THREAD" GIT_VERSION=1f16f49
