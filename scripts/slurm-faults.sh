#!/bin/bash
# Runs a plan on a real Slurm of three one-core nodes on this machine, causes one fault at a time, and compares what it ends in with an
# unbroken run: the same digest of the results, or the hole named. Root; slurm-wlm and munge.
# usage: [PLAN=cells] scripts/slurm-faults.sh [TASKS [FAULT]...]
# Beside the faults, one-node, two-nodes and three-nodes take the time on so many nodes of one core. Planning and merging are timed apart.
# The plan is a sweep of so many runs, or with PLAN=cells the refinement of one run's map in so many cells.
set -euo pipefail

kind=${PLAN:-sweep}
tasks=${1:-12}
shift "$(($# < 1 ? $# : 1))"
faults=(none "$@")
[ ${#faults[@]} -gt 1 ] || faults=(none kill-task kill-slurmd kill-node kill-controller short-limit hard-limit disk-full corrupted-input poison two-submissions)
keysplat=$(realpath "${KEYSPLAT:-target/release/keysplat}")
for program in sbatch slurmctld slurmd munged; do
    PATH=$PATH:/usr/sbin command -v "$program" >/dev/null || { echo "SKIPPED: $program is not installed; apt-get install slurm-wlm munge" >&2; exit 0; }
done
[ "$(id -u)" -eq 0 ] || { echo "SKIPPED: Slurm's daemons need root" >&2; exit 0; }
export PATH=$PATH:/usr/sbin
work=$(mktemp -d)
conf=$work/slurm.conf
export SLURM_CONF=$conf XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-$work}

pid_of() { cat "$work/$1.pid" 2>/dev/null || echo 0; }
stop() {
    scancel --user="$(id -un)" >/dev/null 2>&1 || true
    sleep 2
    for daemon in slurmctld slurmd.n1 slurmd.n2 slurmd.n3 munged; do
        [ ! -e "$work/$daemon.pid" ] || kill -9 "$(pid_of "$daemon")" 2>/dev/null || true
    done
    for mount in $(awk -v work="$work/" 'index($2, work) == 1 { print $2 }' /proc/mounts); do umount -l "$mount"; done
    [ -n "${KEEP:-}" ] && echo "kept: $work" || rm -rf "$work"
}
trap stop EXIT

start_slurm() {
    local host
    host=$(hostname -s)
    mkdir -p "$work/state"
    # A munged of our own, with a key of our own.
    mkdir -m 755 "$work/munge"
    head -c 1024 /dev/urandom >"$work/munge/key"
    chmod 400 "$work/munge/key"
    chown -R munge "$work/munge"
    chmod 711 "$work"
    su -s /bin/sh munge -c "munged --force --key-file=$work/munge/key --socket=$work/munge/socket --pid-file=$work/munge/pid \
        --log-file=$work/munge/log --seed-file=$work/munge/seed" 2>/dev/null
    cp "$work/munge/pid" "$work/munged.pid"
    # Nodes count as dead and requeued tasks start after seconds, not minutes.
    cat >"$conf" <<CONF
ClusterName=faults
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$work/munge/socket,cred_expire=5
MpiDefault=none
ProctrackType=proctrack/pgid
TaskPlugin=task/none
ReturnToService=2
SlurmctldPort=7827
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.%n.pid
SlurmdSpoolDir=$work/spool.%n
StateSaveLocation=$work/state
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd.%n.log
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=2,sched_interval=2
SelectType=select/cons_tres
SlurmdTimeout=15
KillWait=5
MinJobAge=600
NodeName=n[1-3] NodeHostname=$host NodeAddr=127.0.0.1 Port=[17101-17103] CPUs=1 RealMemory=2000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO
CONF
    slurmctld
    for node in n1 n2 n3; do slurmd -N $node; done
    wait_until 30 all_idle || { echo "Slurm did not start; see $work/slurmctld.log" >&2; KEEP=1; exit 1; }
}
all_idle() { [ "$(sinfo -h -t idle -o %D 2>/dev/null)" = 3 ]; }
# Looks at a condition each half second.
wait_until() {
    local seconds=$1 end
    end=$((SECONDS + seconds))
    shift
    until "$@" >/dev/null; do
        [ "$SECONDS" -lt "$end" ] || return 1
        sleep 0.5
    done
}
jobs_over() { [ -z "$(squeue -h 2>/dev/null)" ] && squeue -h >/dev/null 2>&1; }
some_run() { [ "$(ls -d "$plan"/tasks/*/working 2>/dev/null | wc -l)" -ge 2 ]; }
later_run() { [ "$(ls -d "$plan"/tasks/*/result 2>/dev/null | wc -l)" -ge 1 ]; }

new_plan() {
    local epochs=$1 count=$2
    umount "$plan/tasks/0003" 2>/dev/null || true
    rm -rf "$plan" "$work/room"
    cp -r "$work/original" "$work/room"
    if [ "$kind" = cells ]; then
        # Divided at the medians.
        local most=$(($(sed -n 's/.*"gaussians": \([0-9]*\).*/\1/p' "$work/run/metrics.json" | head -1) / count + 2))
        "$keysplat" -q split "$work/run" --size 1000 --halo 0.5 --max-gaussians $most --out "$plan" -- \
            --set "mapping.refine.final_epochs=$epochs" >/dev/null
    else
        "$keysplat" -q bench sweep "$work/room" --plan "$plan" --epochs "$epochs" --seeds "$(seq -s, 0 $((count - 1)))" >/dev/null
    fi
}
submit() { "$keysplat" -q jobs submit "$plan" --slurm -- "$@" >/dev/null; }
# A process of the first task that has begun and not ended.
a_task() { pgrep -f "^$keysplat --quiet jobs run $plan --task" | head -1; }
status_of() { "$keysplat" -q jobs status "$plan" "$@"; }
digest() { status_of --json | sed -n 's/.*"digest": "\(.*\)".*/\1/p' | head -1; }

# What each fault does between a submission and its end.
none() { submit; }
kill-task() { submit; wait_until 180 some_run; kill -9 "$(a_task)"; }
# The daemon alone: the task goes on as an orphan, and Slurm starts it again elsewhere or learns of its end.
kill-slurmd() {
    submit
    wait_until 180 task_on_n2
    kill -9 "$(pid_of slurmd.n2)"
    wait_until 120 node_down || echo "n2 was not missed" >&2
    slurmd -N n2
}
# All that a dead node takes along: the daemon, the task, its script and their parent.
kill-node() {
    submit
    wait_until 180 task_on_n2
    local task script
    task=$(task_on_n2) script=$(ps -o ppid= -p "$(task_on_n2)" | tr -d ' ')
    kill -9 "$(pid_of slurmd.n2)" "$(ps -o ppid= -p "$script" | tr -d ' ')" "$script" "$task"
    wait_until 120 node_down || echo "n2 was not missed" >&2
    slurmd -N n2
}
task_on_n2() {
    local pid
    for pid in $(pgrep -f "^$keysplat --quiet jobs run $plan --task"); do
        ! tr '\0' '\n' <"/proc/$pid/environ" 2>/dev/null | grep -qx SLURMD_NODENAME=n2 || { echo "$pid" && return; }
    done
    return 1
}
node_down() { [[ $(sinfo -h -n n2 -o %T) = down* ]]; }
kill-controller() {
    submit
    touch "$work/submitted"
    wait_until 180 some_run
    wait_until 60 jobs_saved || echo "the controller does not save its jobs" >&2
    kill -9 "$(pid_of slurmctld)"
    sleep 8
    slurmctld
}
# What Slurm has not saved is lost with the controller.
jobs_saved() { [ "$work/state/job_state" -nt "$work/submitted" ]; }
# Tasks of minutes with a limit of one: each leaves with a checkpoint, is requeued and goes on.
short-limit() { submit --time=1 --signal=B:USR1@30; }
# The same without the early signal, and without requeueing: Slurm's own end.
hard-limit() { submit --time=1 --signal=B:CONT@1 --no-requeue; }
disk-full() {
    mkdir -p "$plan/tasks/0003"
    mount -t tmpfs -o size=${FULL_SIZE:-300k} tmpfs "$plan/tasks/0003"
    submit
}
corrupted-input() { submit; wait_until 180 later_run; printf 'x' | dd of="$(ls "$work"/room/rgb/*.png | head -7 | tail -1)" bs=1 seek=100 conv=notrunc status=none; }
# Its adapter does not exist.
poison() {
    sed -i '0,/"options": \[/s//"options": [ "--adapter", "no-such-adapter",/' "$plan/plan.json"
    submit
}
two-submissions() { submit & submit & wait; }
# No faults, but times: on so many of the nodes, whose adapter has one core.
on_nodes() {
    local drained=$1
    [ -z "$drained" ] || scontrol update NodeName="$drained" State=DRAIN Reason=times
    LP_NUM_THREADS=1 submit
    wait_until 1500 jobs_over || true
    [ -z "$drained" ] || scontrol update NodeName="$drained" State=RESUME
}
one-node() { on_nodes n2,n3; }
two-nodes() { on_nodes n3; }
three-nodes() { on_nodes ""; }

start_slurm
plan=$work/plan
cat >"$work/room.toml" <<SCENE
seed = 3
frames = ${FRAMES:-40}
[camera]
width = 160
height = 120
fx = 131.25
fy = 131.25
cx = 79.5
cy = 59.5
[path]
kind = "sweep"
SCENE
"$keysplat" -q generate "$work/room.toml" -o "$work/original"
if [ "$kind" = cells ]; then
    cp -r "$work/original" "$work/room"
    "$keysplat" -q run "$work/room" --out "$work/run" --map-scale 1 --set mapping.refine.final_epochs=4 >/dev/null
fi
now() { date +%s%N; }
since() { local tenths=$((($(now) - $1) / 100000000)) && echo "$((tenths / 10)).$((tenths % 10))"; }
printf '%-16s %7s %5s %5s %5s %6s  %-16s %-17s %s\n' fault seconds plan merge done failed digest '' holes
whole='' long='' failed=0
for fault in "${faults[@]}"; do
    wait_until 60 all_idle || true
    expected=$whole planned=''
    if [[ $fault = *-limit ]]; then
        # Longer tasks have a digest of their own.
        new_plan "${LONG_EPOCHS:-900}" 3
        if [ -z "$long" ]; then
            "$keysplat" -q jobs submit "$plan" --local 2 >/dev/null
            long=$(digest)
            new_plan "${LONG_EPOCHS:-900}" 3
        fi
        expected=$long
    else
        began=$(now)
        new_plan "${EPOCHS:-60}" "$tasks"
        planned=$(since "$began")
    fi
    began=$SECONDS
    "$fault"
    wait_until 1500 jobs_over || echo "jobs remain" >&2
    seconds=$((SECONDS - began)) found=$(digest)
    [ "$fault" != none ] || { whole=$found expected=$found; }
    merging=$(now)
    holes=$("$keysplat" -q jobs merge "$plan" 2>&1 | grep -o 'hole: task.*' | head -2 | paste -sd';' || true)
    merged=$(since "$merging")
    ended=$(status_of | tail -1)
    [[ $ended = digest* ]] && ended=$(status_of | tail -2 | head -1)
    done=${ended%% done*} bad=$(sed 's/.*running, \([0-9]*\) failed.*/\1/' <<<"$ended")
    verdict='hole named'
    [ -z "$found" ] || [ "$found" != "$expected" ] || verdict="same digest"
    [ "$verdict" = "same digest" ] || [ -n "$holes" ] || { verdict=DIFFERS && failed=1; }
    printf '%-16s %7d %5s %5s %5s %6s  %-16s %-17s %s\n' "$fault" "$seconds" "$planned" "$merged" "$done" "$bad" "${found:0:16}" "$verdict" "${holes:0:300}"
    # What was in the way is gone: the holes fill, to the same digest.
    if [ -n "$holes" ] && [[ $fault != poison ]]; then
        umount "$plan/tasks/0003" 2>/dev/null || true
        cp -r "$work/original/." "$work/room/"
        submit
        wait_until 1500 jobs_over || true
        verdict=DIFFERS
        [ "$(digest)" != "$expected" ] || verdict='same digest'
        [ "$verdict" = 'same digest' ] || failed=1
        printf '%-16s %7d %5s %5s %5s %6s  %-16s %-17s\n' '  submitted again' "$((SECONDS - began))" '' '' '' '' "$(digest | cut -c1-16)" "$verdict"
    fi
done
exit "$failed"
