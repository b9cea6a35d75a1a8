#!/bin/sh
# Checks and measures keysplat on the machine it runs on, in one command, and writes JSON named after the adapter to the folder $1 (default benches/results):
#   step-*   the training step on made-up scenes and on a run's map, stage by stage
#   host-*   the mapping thread's own time for a keyframe
#   runs-*   the recording $2 at full size: each preset, then 30 frames a second in real time
#   gsplat-* gsplat's step on the same map and view, where PyTorch and gsplat are there
# Two runs must give the same map. Last come the tests of the shaders against the oracle. Without a recording, the demo takes its place.
# Builds where there is a Rust toolchain, else uses the build that was carried along in target/release (`cargo test --release --no-run && cargo build --release` makes
# it), or the programs that KEYSPLAT and KEYSPLAT_GPU_TESTS name.
set -eu

cd "$(dirname "$0")/.."
out=${1:-benches/results}
recording=${2:-}
mkdir -p "$out"
if command -v cargo >/dev/null 2>&1 && [ -z "${KEYSPLAT:-}" ]; then
    cargo build --release
    cargo test --release --test gpu --no-run
fi
keysplat=${KEYSPLAT:-target/release/keysplat}
# The newest build of the shaders' tests.
tests=${KEYSPLAT_GPU_TESTS:-$(find target/release/deps -maxdepth 1 -name "gpu-*" -type f -perm -u+x -exec ls -t {} + | head -n 1)}
[ -n "$tests" ] || { echo "gpu-check: the tests are not built" >&2; exit 1; }

"$keysplat" adapters
adapter=$("$keysplat" adapters 2>/dev/null | head -n 1 | sed 's/  \[.*//; s/[^A-Za-z0-9]\{1,\}/-/g; s/-$//' | tr '[:upper:]' '[:lower:]')
runs=$(mktemp -d)
trap 'rm -rf "$runs"' EXIT

same() {
    cmp "$1/map.ply" "$2/map.ply" || { echo "gpu-check: two runs gave different maps" >&2; exit 1; }
}

if [ -n "$recording" ]; then
    for preset in draft balanced quality best; do
        "$keysplat" run "$recording" --map-scale 1 --preset "$preset" --quiet --out "$runs/$preset"
    done
    "$keysplat" run "$recording" --map-scale 1 --preset balanced --quiet --out "$runs/again"
    same "$runs/balanced" "$runs/again"
    "$keysplat" run "$recording" --map-scale 1 --preset realtime --quiet --out "$runs/realtime"
    for preset in draft balanced quality best realtime; do
        printf '%s "%s": ' "$([ "$preset" = draft ] && echo "{" || echo ",")" "$preset"
        cat "$runs/$preset/metrics.json"
    done > "$out/runs-$adapter.json"
    echo "}" >> "$out/runs-$adapter.json"
    "$keysplat" bench step --run "$runs/balanced" --gaussians 100000000 --steps 96 --out "$out/step-map-$adapter.json"
    if python3 -c "import gsplat" 2>/dev/null; then
        python3 scripts/gsplat_step.py "$runs/balanced/map.ply" "$out/step-map-$adapter.json" --out "$out/gsplat-$adapter.json"
    fi
else
    for run in first second; do
        "$keysplat" demo --quiet --out "$runs/$run"
    done
    same "$runs/first" "$runs/second"
fi
"$keysplat" bench step --steps 96 --out "$out/step-$adapter.json"
"$keysplat" bench host --out "$out/host-$adapter.json"
KEYSPLAT_REQUIRE=adapter "$tests"
