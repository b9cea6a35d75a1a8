#!/usr/bin/env python3
"""Estimate of what many GPUs give: a large scene refined in cells, and a sweep of independent runs.

A plan and its merge are serial; a task runs as soon as a GPU is free. Prints two tables. No cluster took part: MEASURED was measured on one machine, ASSUMED was not.
"""

import heapq

MEASURED = {
    # A step with a million visible Gaussians at 1920x1080 on an H200 (benches/README.md).
    "step_s": 2.34e-3,
    # Further visits to keyframes for each border that a cell shares: 0.30 with 1 border a cell, 0.39 with 1.25 (docs/large-maps.md).
    "visits_per_border": 0.31,
    # Processor time to find what one keyframe sees of one Gaussian: 1.5 s for 453 keyframes and 85,766 Gaussians (docs/large-maps.md).
    "see_s": 39e-9,
    # A run of 300 frames with `best` on an H200 (docs/results.md).
    "run_s": 5.0,
}
ASSUMED = {
    # Cores beside each GPU; bytes/s of the storage that all nodes share; bytes of an image and a Gaussian.
    "cores": 16,
    "storage": 5e9,
    "image": 0.6e6,
    "gaussian": 236,
    # Seconds from Slurm's start of a task to its work: process, device, pipelines.
    "start_s": 5.0,
    # Largest cell's visits over the mean one's.
    "imbalance": 1.5,
    # Share of the keyframes that have some of a cell in view, hidden or not: a task looks no further at the others.
    "in_view": 0.25,
}
KEYFRAMES, GAUSSIANS, EPOCHS, GRID = 2_000, 5_000_000, 135, 8
RUNS = 256
GPUS = (1, 4, 16, 64)


def makespan(tasks, gpus):
    """Seconds until all tasks are done: each goes to the GPU that is free first, the longest ones first."""
    free = [0.0] * gpus
    for task in sorted(tasks, reverse=True):
        heapq.heapreplace(free, free[0] + task)
    return max(free)


def shares(cells, imbalance):
    """Each cell's share of the visits: evenly spread, the largest `imbalance` times the mean."""
    return [(1 + (imbalance - 1) * (2 * i / (cells - 1) - 1)) / cells for i in range(cells)]


def scene_table(step_s, visits_per_border, see_s, cores, storage, image, gaussian, start_s, imbalance, in_view, **_):
    cells = GRID * GRID
    visits = 1 + visits_per_border * 2 * GRID * (GRID - 1) / cells
    see = KEYFRAMES * GAUSSIANS * see_s / cores
    read = KEYFRAMES * image / storage
    work = KEYFRAMES * EPOCHS * step_s
    whole = start_s + read + work
    # The plan reads the recording and finds each cell's keyframes; the merge reads the results and the map, and writes one.
    serial = read + see + 3 * GAUSSIANS * gaussian / storage
    print(
        f"{KEYFRAMES:,} keyframes at 1920x1080, {GAUSSIANS:,} Gaussians, {EPOCHS} epochs, {cells} cells; {visits:.2f} visits to a "
        f"keyframe in each epoch. Plan and merge: {serial:.0f} s.\n"
    )
    print("| GPUs | start of a task, s | steps of all tasks, s | time, s | speed-up | plan and merge |")
    print("|---|---|---|---|---|---|")
    print(f"| 1, in one piece | {start_s + read:.0f} | {work:.0f} | {whole:.0f} | 1 | |")
    for gpus in GPUS:
        # Each task reads its own images, as many tasks at a time as there are GPUs. The plan has read the recording, which no task does again.
        start = start_s + in_view * see + read * min(gpus, cells) * visits / cells
        time = serial + makespan([start + share * visits * work for share in shares(cells, imbalance)], gpus)
        print(f"| {gpus}, in cells | {start:.0f} | {visits * work:.0f} | {time:.0f} | {whole / time:.1f} | {serial / time:.0%} |")


def sweep_table(run_s, start_s, **_):
    print(f"\n{RUNS} runs of {run_s:.0f} s and a start of {start_s:.0f} s each.\n")
    print("| GPUs | time, s | speed-up |")
    print("|---|---|---|")
    for gpus in GPUS:
        time = makespan([start_s + run_s] * RUNS, gpus)
        print(f"| {gpus} | {time:.0f} | {RUNS * (start_s + run_s) / time:.0f} |")


if __name__ == "__main__":
    scene_table(**MEASURED, **ASSUMED)
    sweep_table(**MEASURED, **ASSUMED)
