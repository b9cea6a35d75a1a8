#!/usr/bin/env python3
"""Estimate of a training step's time on GPUs: counted bytes and instructions over published rates.

A stage takes the longer of its bytes over the bandwidth and its instructions over the issue rate, but not less than its longest chain of
dependent iterations; commands add their launches. Prints a table. Bandwidth of the H200 and launches of an H100 are measured; beside the H200's estimate stands what its steps took
(benches/README.md), so that the estimates of the other GPUs can be judged.
"""

# Effective memory bandwidth (bytes/s), subgroup instructions a second at full issue, clock (Hz), microseconds a command.
GPUS = {
    "H200": (3.9e12, 132 * 4 * 1.8e9, 1.8e9, 6.0),
    "RTX 4090": (0.9e12, 128 * 4 * 2.5e9, 2.5e9, 3.0),
    "M2": (0.085e12, 10 * 4 * 1.4e9, 1.4e9, 8.0),
    "Iris Xe": (0.055e12, 24 * 1.3e9, 1.3e9, 8.0),
}
# Share of the issue rate that dependent arithmetic with workgroup memory reaches.
ISSUE = 0.5
COMMANDS = 13
BUCKET = 96

# Gaussians, visible, intersections, forward evaluations, pixels, harmonics' coefficients.
SCENES = {
    "S: 320x240": (30e3, 30e3, 72e3, 4.1e6, 320 * 240, 9),
    "A: 1200x680": (110e3, 110e3, 400e3, 26.5e6, 1200 * 680, 4),
    # Its evaluations by the share of sub-tiles that 500,000 Gaussians reach at 1200x680.
    "B: 1920x1080": (1e6, 1e6, 2.3e6, 124e6, 1920 * 1080, 16),
}

# Milliseconds a step took on an H200 (`keysplat bench step`).
MEASURED = {"S: 320x240": 0.23, "A: 1200x680": 0.48, "B: 1920x1080": 2.34}


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
        # Two halves of a workgroup read each Gaussian.
        "rasterize_forward": (pairs * 56 + pixels * 24 + pairs * 20, evaluations / 32 * 24 + pairs * 2 * 20, 300 * 130),
        "loss": (pixels * (20 * halo + 12 * 3 * halo + 56 + 32), pixels / 32 * 450, 0),
        # A sub-tile's pixels, then the sums of two Gaussians by 20 lanes over 32 rows.
        "rasterize_backward": (pairs * (56 + 48 + 20) + pixels * 72, evaluations / 32 * 54 + pairs * 70, BUCKET * 500),
        "slot sums, Adam": (pairs * 56 + visible * planes * 16 * 6, pairs / 0.5 / 32 * 30 + visible / 32 * (600 + 90 * planes), 64 * 450),
    }


def main():
    print("| scene | H200, measured, ms | " + " | ".join(f"{gpu}, ms" for gpu in GPUS) + " |")
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
