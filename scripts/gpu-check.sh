#!/bin/sh
# Checks and measures keysplat on the machine it runs on, in one command: the GPU against the oracle, two runs of the demo that must give
# the same map, then the training step's stages and the mapping thread's own time as JSON in the folder $1 (default benches/results), named after the adapter. Further
# arguments go to `keysplat bench step`. Builds where there is a Rust toolchain, else uses the
# build that was carried along in target/release (`cargo test --release --no-run && cargo build --release` makes it).
set -eu

cd "$(dirname "$0")/.."
out=${1:-benches/results}
mkdir -p "$out"
if command -v cargo >/dev/null 2>&1; then
    cargo build --release
    cargo test --release --test gpu --no-run
fi

target/release/keysplat adapters
# The newest build of the shaders' tests.
binary=$(find target/release/deps -maxdepth 1 -name "gpu-*" -type f -perm -u+x -exec ls -t {} + | head -n 1)
[ -n "$binary" ] || { echo "gpu-check: the tests are not built" >&2; exit 1; }
KEYSPLAT_REQUIRE=adapter "$binary"

repeats=$(mktemp -d)
trap 'rm -rf "$repeats"' EXIT
for run in first second; do
    target/release/keysplat demo --quiet --out "$repeats/$run"
done
if ! cmp "$repeats/first/map.ply" "$repeats/second/map.ply"; then
    echo "gpu-check: two runs of the demo gave different maps" >&2
    exit 1
fi

adapter=$(target/release/keysplat adapters 2>/dev/null | head -n 1 | sed 's/  \[.*//; s/[^A-Za-z0-9]\{1,\}/-/g; s/-$//' | tr '[:upper:]' '[:lower:]')
[ $# -eq 0 ] || shift
target/release/keysplat bench step --out "$out/step-$adapter.json" "$@"
target/release/keysplat bench host --out "$out/host-$adapter.json"
