#!/bin/sh
# Runs all tests, or those that cargo's options name, and counts the skipped ones. KEYSPLAT_REQUIRE=adapter,data makes a test fail that would
# be skipped for lack of an adapter or of the recordings in $KEYSPLAT_DATA.
set -eu

cd "$(dirname "$0")/.."
skipped=${CARGO_TARGET_DIR:-target}/tmp/skipped.txt
rm -f "$skipped"
status=0
cargo test --release "$@" || status=$?
if [ -s "$skipped" ]; then
    reasons=$(cut -f1,3 "$skipped" | sort | uniq -c | sort -rn | sed 's/^ *\([0-9]*\) [a-z]*\t/\1: /' | paste -sd';' | sed 's/;/; /g')
    echo "skipped: $(wc -l <"$skipped") ($reasons)"
else
    echo "skipped: 0"
fi
exit "$status"
