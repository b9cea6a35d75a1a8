#!/bin/sh
# Feeds every parser damaged files, coverage-guided, from the seeds in fuzz/corpus: each for ten million executions or $1 seconds
# (default 60), whichever ends first. Needs a nightly toolchain and cargo-fuzz (`cargo install cargo-fuzz`). What is found anew stays in
# fuzz/target; an input that crashes or hangs is left in fuzz/artifacts and ends the run with an error. Targets given after the seconds are
# run alone.
set -eu

cd "$(dirname "$0")/../fuzz"
seconds=${1:-60}
[ $# -eq 0 ] || shift
cargo +nightly fuzz --version >/dev/null 2>&1 || { echo "fuzz: there is no nightly toolchain with cargo-fuzz" >&2; exit 1; }
[ $# -gt 0 ] || set -- $(cargo +nightly fuzz list --fuzz-dir .)
# Nothing here is unsafe code of ours, so that memory is not watched: the sanitizer does not get on with OpenCV. Built once for all, so
# that the sources may change meanwhile.
cargo +nightly fuzz build -s none --fuzz-dir .
built=target/$(rustc +nightly -vV | sed -n 's/^host: //p')/release
printf '%-12s %12s %8s %8s\n' target executions seconds MB
for target in "$@"; do
    found=target/found/$target log=target/found/$target.log
    mkdir -p "$found" "artifacts/$target"
    "$built/$target" "$found" "corpus/$target" -artifact_prefix="artifacts/$target/" -runs=10000000 -max_total_time="$seconds" \
        -timeout=60 -rss_limit_mb=1024 -malloc_limit_mb=256 -max_len=65536 -print_final_stats=1 >"$log" 2>&1 || {
        grep -E "ERROR|panicked|SUMMARY|Test unit" "$log" >&2 || tail -n 5 "$log" >&2
        echo "fuzz: $target failed, see fuzz/artifacts/$target" >&2
        exit 1
    }
    sed -n 's/^Done \([0-9]*\) runs in \([0-9]*\) second.*/\1 \2/p; s/^stat::peak_rss_mb: *//p' "$log" | paste -sd' ' |
        (read -r executions took peak && printf '%-12s %12d %8d %8d\n' "$target" "$executions" "$took" "$peak")
done
