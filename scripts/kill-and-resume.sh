#!/bin/bash
# Kills runs of a recording at random moments, resumes them, and compares what they end in with an unbroken run, to the byte.
# usage: scripts/kill-and-resume.sh RECORDING [COUNT [OPTION OF KEYSPLAT RUN]...]
set -euo pipefail

recording=${1:?usage: $0 RECORDING [COUNT [OPTION]...]}
count=${2:-20}
shift "$(($# < 2 ? $# : 2))"
keysplat=${KEYSPLAT:-target/release/keysplat}
every=${CHECKPOINT_EVERY:-1}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

hashes() { (cd "$1" && sha256sum trajectory.txt map.ply | cut -c1-12 | paste -sd' '); }
now() { date +%s%N; }

# Runs "$@", kills it after $1 ms, and waits; says whether it was killed.
killed_after() {
    local ms=$1 pid status=0
    shift
    "$@" >>"$work/log" 2>&1 &
    pid=$!
    sleep "$(printf '%d.%03d' $((ms / 1000)) $((ms % 1000)))"
    kill -KILL "$pid" 2>/dev/null || true
    wait "$pid" 2>/dev/null || status=$?
    [ "$status" -eq 137 ]
}

began=$(now)
"$keysplat" -q run "$recording" --out "$work/whole" "$@"
whole_ms=$((($(now) - began) / 1000000))
expected=$(hashes "$work/whole")
echo "unbroken: $whole_ms ms, trajectory and map $expected"
printf '%4s %6s %10s  %-25s  %-7s  %s\n' run kills checkpoint 'trajectory and map' '' 'killed after, ms'
failed=0 i=0
while ((i < count)); do
    out=$work/run moments=() size=none
    rm -rf "$out"
    command=("$keysplat" -q run "$recording" --out "$out" --checkpoint-every "$every" "$@")
    # Each resumed run may be killed too, every second one is.
    while :; do
        ms=$((RANDOM * RANDOM % whole_ms))
        killed_after "$ms" "${command[@]}" || break
        moments+=("$ms")
        if [ -e "$out/checkpoint.bin" ]; then
            size=$(stat -c %s "$out/checkpoint.bin")
            command=("$keysplat" -q resume "$out")
        fi
        if ((RANDOM % 2)) && [ -e "$out/checkpoint.bin" ]; then
            "${command[@]}" >>"$work/log" 2>&1 || true
            break
        fi
    done
    # It ended before it was killed once: the machine has become quicker.
    ((${#moments[@]} > 0)) || { whole_ms=$((whole_ms * 3 / 4 + 1)) && continue; }
    i=$((i + 1))
    found=$(hashes "$out" 2>/dev/null || echo 'no result')
    verdict=same
    [ "$found" = "$expected" ] && [ ! -e "$out/checkpoint.bin" ] || { verdict='DIFFERS' && failed=1; }
    printf '%4d %6d %10s  %-25s  %-7s  %s\n' "$i" "${#moments[@]}" "$size" "$found" "$verdict" "${moments[*]}"
done
[ "$failed" -eq 0 ] || { cat "$work/log" >&2; exit 1; }
