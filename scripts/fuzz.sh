#!/bin/sh
# Feeds every parser damaged files for $1 seconds each (default 60), coverage-guided, from the seeds in fuzz/corpus. Needs a nightly
# toolchain and cargo-fuzz (`cargo install cargo-fuzz`). What is found anew stays in fuzz/target; crashes are left in fuzz/artifacts
# and end the run with an error. Targets given after the seconds are run alone.
set -eu

cd "$(dirname "$0")/../fuzz"
seconds=${1:-60}
[ $# -eq 0 ] || shift
cargo +nightly fuzz --version >/dev/null 2>&1 || { echo "fuzz: there is no nightly toolchain with cargo-fuzz" >&2; exit 1; }
# Nothing here is unsafe code of ours, so that memory is not watched: the sanitizer does not get on with OpenCV.
[ $# -gt 0 ] || set -- $(cargo +nightly fuzz list --fuzz-dir .)
for target in "$@"; do
    found=target/found/$target
    mkdir -p "$found"
    echo "fuzz: $target for $seconds s"
    cargo +nightly fuzz run -s none --fuzz-dir . "$target" "$found" "corpus/$target" -- \
        -max_total_time="$seconds" -timeout=60 -rss_limit_mb=1024 -malloc_limit_mb=256 -max_len=65536 -print_final_stats=1 2>&1 |
        grep -E "ERROR|panicked|SUMMARY|stat::(number_of_executed_units|peak_rss_mb)|Test unit" || true
    [ -z "$(ls "artifacts/$target" 2>/dev/null)" ] || { echo "fuzz: $target crashed, see fuzz/artifacts/$target" >&2; exit 1; }
done
