#!/usr/bin/env python3
"""PSNR of held-out views within 1 m of the borders of a plan's cells, and farther from them.

    border-psnr.py PLAN RECORDING RUN...

Each RUN is a folder with `views/` and `trajectory.txt`, as `keysplat eval` leaves them, in the world of the plan's run. RECORDING has TUM's
layout with depth, whose frames decide how far from a border each pixel lies. Needs numpy and Pillow.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

BAND_METRES = 1.0
DEPTH_UNIT = 1 / 5000


def rows(path):
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def rotation(x, y, z, w):
    """World from camera."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def nearest(table, time):
    return min(table, key=lambda row: abs(float(row[0]) - time))


def border_distance(points, regions):
    """Distance of points from the nearest side that two cells share; [N] metres."""
    least = np.full(len(points), np.inf)
    for i, a in enumerate(regions):
        for b in regions[i + 1 :]:
            low, high = np.maximum(a["low"], b["low"]), np.minimum(a["high"], b["high"])
            if (low <= high + 1e-6).all():
                outside = np.maximum(np.maximum(low - points, points - high), 0)
                least = np.minimum(least, np.linalg.norm(outside, axis=1))
    return least


def main():
    plan, recording, runs = json.loads((Path(sys.argv[1]) / "plan.json").read_text()), Path(sys.argv[2]), sys.argv[3:]
    regions = [task["work"]["cell"]["region"] for task in plan["tasks"]]
    color, depth = rows(recording / "rgb.txt"), rows(recording / "depth.txt")
    fx, fy, cx, cy = (float(v) for v in rows(recording / "camera.txt")[0][:4])
    for run in map(Path, runs):
        trajectory = rows(run / "trajectory.txt")
        sums = {"band": [0.0, 0], "rest": [0.0, 0], "all": [0.0, 0]}
        for picture in sorted((run / "views").glob("*.png")):
            pair = np.asarray(Image.open(picture), dtype=np.float64) / 255
            width = pair.shape[1] // 2
            error = ((pair[:, :width] - pair[:, width:]) ** 2).mean(axis=2).ravel()
            time = float(color[int(picture.stem)][0])
            pose = [float(v) for v in nearest(trajectory, time)[1:]]
            image = np.asarray(Image.open(recording / nearest(depth, time)[1]), dtype=np.float64) * DEPTH_UNIT
            scale = image.shape[1] / width
            v, u = np.mgrid[0 : pair.shape[0], 0:width]
            u, v = ((u.ravel() + 0.5) * scale - 0.5, (v.ravel() + 0.5) * scale - 0.5)
            z = image[v.round().astype(int), u.round().astype(int)]
            rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=1)
            points = rays * z[:, None] @ rotation(*pose[3:]).T + pose[:3]
            near = border_distance(points, regions) <= BAND_METRES
            for name, mask in [("band", (z > 0) & near), ("rest", (z > 0) & ~near), ("all", z > -1)]:
                sums[name][0] += error[mask].sum()
                sums[name][1] += mask.sum()
        figures = {name: -10 * np.log10(total / max(count, 1)) for name, (total, count) in sums.items()}
        share = sums["band"][1] / max(sums["all"][1], 1)
        print(f"{run}: band {figures['band']:.2f} dB ({share:.0%} of the pixels), rest {figures['rest']:.2f} dB, all {figures['all']:.2f} dB")


if __name__ == "__main__":
    main()
