#!/usr/bin/env python3
"""Estimate of a training step's time on GPUs: counted bytes and instructions over published rates.

A stage takes the longer of its bytes over the bandwidth and its instructions over the issue rate, but not less than its longest chain of
dependent iterations; commands add their launches. Prints a table. Bandwidth and launches of the H100 are measured; beside its estimate stands what its steps took
(benches/README.md), so that the estimates of the other GPUs can be judged.
"""

# Effective memory bandwidth (bytes/s), subgroup instructions a second at full issue, clock (Hz), microseconds a command.
GPUS = {
    "H100": (2.79e12, 132 * 4 * 1.755e9, 1.755e9, 6.0),
    "H200": (4.0e12, 132 * 4 * 1.8e9, 1.8e9, 3.5),
    "RTX 4090": (0.9e12, 128 * 4 * 2.5e9, 2.5e9, 3.0),
    "M2": (0.085e12, 10 * 4 * 1.4e9, 1.4e9, 8.0),
    "Iris Xe": (0.055e12, 24 * 1.3e9, 1.3e9, 8.0),
}
# Share of the issue rate that dependent arithmetic with workgroup memory reaches.
ISSUE = 0.5
COMMANDS = 13
BUCKET = 128

# Gaussians, visible, intersections, forward evaluations, pixels, harmonics' coefficients.
SCENES = {
    "S: 320x240": (30e3, 30e3, 72e3, 9.2e6, 320 * 240, 9),
    "A: 1200x680": (110e3, 110e3, 400e3, 51e6, 1200 * 680, 4),
    "B: 1920x1080": (1e6, 1e6, 2.3e6, 294e6, 1920 * 1080, 16),
}

# Milliseconds a step took on an H100 (`keysplat bench step`).
MEASURED = {"S: 320x240": 0.288, "A: 1200x680": 0.636, "B: 1920x1080": 3.25}


def stages(gaussians, visible, pairs, evaluations, pixels, coefficients):
    """Name: (bytes, subgroup instructions, cycles of the longest chain)."""
    planes = 3 + coefficients
    halo = (25 / 16) ** 2
    return {
        "project_forward": (gaussians * 16 * (2 + coefficients) + visible * 48, gaussians / 32 * 300, 0),
        "compact, scan": (gaussians * 12, 0, 2000),
        "tile lists": (visible * 2 * 52 + pairs * 12, (visible * 2 * 2.5 + pairs) / 0.9 / 32 * 120, 64 * 180),
        # 28 rounds for a list of 128.
        "sort_tiles": (pairs * 28, pairs / 2 / 32 * 28 * 30, 45 * 8 * 60),
        "rasterize_forward": (pairs * 56 + pixels * 24 + pairs * 20, evaluations / 4 / 32 * 88, 500 * 130),
        "loss": (pixels * (20 * halo + 12 * 3 * halo + 56 + 32), pixels / 32 * 450, 0),
        # 32 strips a Gaussian; a bucket has 31 steps of run-in.
        "rasterize_backward": (pairs * (56 + 48 + 20) + pixels * 56, pairs / 0.8 * 217, (BUCKET + 31) * 250),
        "slot sums, Adam": (pairs * 56 + visible * planes * 16 * 6, pairs / 0.5 / 32 * 30 + visible / 32 * (600 + 90 * planes), 64 * 450),
    }


def main():
    print("| scene | H100, measured, ms | " + " | ".join(f"{gpu}, ms" for gpu in GPUS) + " |")
    print("|---|---|" + "---|" * len(GPUS))
    for scene, counts in SCENES.items():
        cells = []
        for bandwidth, issue, clock, launch in GPUS.values():
            parts = {
                name: max(moved / bandwidth, instructions / (issue * ISSUE), chain / clock)
                for name, (moved, instructions, chain) in stages(*counts).items()
            }
            total = sum(parts.values()) + COMMANDS * launch * 1e-6
            longest = max(parts, key=parts.get)
            cells.append(f"{total * 1e3:.2f} ({longest} {parts[longest] * 1e3:.2f})")
        print(f"| {scene} | {MEASURED[scene]} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
