#!/usr/bin/env python3
"""Times gsplat's training step on a run's map and view, for a table beside keysplat's.

    keysplat bench step --run out/kitchen --gaussians 100000000 --out step.json
    gsplat_step.py out/kitchen/map.ply step.json [--out <JSON>]

Needs PyTorch with CUDA and gsplat. Three steps are timed with CUDA events, medians in milliseconds: `raster` (forward and backward), `l1` (with the L1 loss of
colour and depth, and Adam of the visible Gaussians) and `ssim` (with SSIM by convolutions as well). keysplat's own step holds all of that.
"""

import argparse
import json
import pathlib
import statistics

import numpy as np
import torch
import torch.nn.functional as F
from gsplat import rasterization
from gsplat.optimizers import SelectiveAdam


def read_ply(path):
    """Columns of a binary PLY of floats."""
    data = path.read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    count = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
    table = np.frombuffer(body, dtype="<f4", count=count * len(names)).reshape(count, len(names))
    return {name: table[:, i].copy() for i, name in enumerate(names)}


def parameters(columns):
    stack = lambda names: torch.tensor(np.stack([columns[n] for n in names], axis=1), device="cuda")
    rest = sorted((n for n in columns if n.startswith("f_rest_")), key=lambda n: int(n.rsplit("_", 1)[1]))
    tensors = {
        "means": stack(["x", "y", "z"]),
        "quats": stack([f"rot_{i}" for i in range(4)]),
        "scales": stack([f"scale_{i}" for i in range(3)]),
        "opacities": stack(["opacity"])[:, 0].contiguous(),
        "sh0": stack([f"f_dc_{i}" for i in range(3)])[:, None, :].contiguous(),
    }
    if rest:
        tensors["shN"] = stack(rest).reshape(len(columns["x"]), 3, -1).transpose(1, 2).contiguous()
    return {name: torch.nn.Parameter(value) for name, value in tensors.items()}


def ssim(a, b, window):
    """Mean SSIM of two images, (3, height, width)."""
    blur = lambda t: F.conv2d(F.conv2d(t[:, None], window[None, None, None, :]), window[None, None, :, None])
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    cov = blur(a * b) - mean_a * mean_b
    return (((2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)) / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean()


def median_ms(step, repeats):
    for _ in range(20):
        step()
    times = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        step()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end))
    return statistics.median(times)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=pathlib.Path)
    parser.add_argument("step", type=pathlib.Path)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--out", type=pathlib.Path)
    args = parser.parse_args()
    camera = json.loads(args.step.read_text())["view"]
    width, height = camera["width"], camera["height"]
    params = parameters(read_ply(args.map))
    count = len(params["means"])
    view = torch.tensor(camera["camera_from_world"], device="cuda", dtype=torch.float32)[None]
    # gsplat's pixel centres lie at half a pixel.
    rows = [[camera["fx"], 0, camera["cx"] + 0.5], [0, camera["fy"], camera["cy"] + 0.5], [0, 0, 1]]
    intrinsics = torch.tensor([rows], device="cuda", dtype=torch.float32)
    coefficients = 1 + (params["shN"].shape[1] if "shN" in params else 0)
    degree = round(coefficients**0.5) - 1
    offsets = torch.arange(11, device="cuda", dtype=torch.float32) - 5
    window = torch.exp(-(offsets**2) / (2 * 1.5**2))
    window = window / window.sum()

    def render():
        colors = torch.cat([params["sh0"], params["shN"]], dim=1) if "shN" in params else params["sh0"]
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), colors, view, intrinsics,
            width, height, sh_degree=degree, render_mode="RGB+ED", packed=False,
        )
        return image[0], info

    with torch.no_grad():
        image, info = render()
        target = (image[..., :3] + 0.05 * torch.randn_like(image[..., :3])).permute(2, 0, 1).contiguous()
        depth = image[..., 3] + 0.02
        visible = int((info["radii"] > 0).all(-1).sum()) if info["radii"].dim() == 3 else int((info["radii"] > 0).sum())
        pairs = int(info["tiles_per_gauss"].sum())
    optimizers = [SelectiveAdam([{"params": [p], "lr": 0.0}], eps=1e-15, betas=(0.9, 0.999)) for p in params.values()]

    def raster():
        image, _ = render()
        image.sum().backward()
        for p in params.values():
            p.grad = None

    def step(with_ssim):
        image, info = render()
        color = image[..., :3].permute(2, 0, 1)
        loss = 0.8 * (color - target).abs().mean() + 0.1 * (image[..., 3] - depth).abs().mean()
        if with_ssim:
            loss = loss + 0.2 * (1 - ssim(color, target, window))
        loss.backward()
        seen = (info["radii"] > 0).all(-1).any(0) if info["radii"].dim() == 3 else (info["radii"] > 0).any(0)
        for optimizer in optimizers:
            optimizer.step(seen)
            optimizer.zero_grad(set_to_none=True)

    report = {
        "gpu": torch.cuda.get_device_name(0),
        "gaussians": count, "visible": visible, "tile_intersections": pairs, "size": [width, height], "sh_degree": degree,
        "ms": {
            "raster": median_ms(raster, args.repeats),
            "l1": median_ms(lambda: step(False), args.repeats),
            "ssim": median_ms(lambda: step(True), args.repeats),
        },
    }
    text = json.dumps(report, indent=2)
    print(text)
    if args.out:
        args.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
