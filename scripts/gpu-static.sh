#!/bin/sh
# Proof without a GPU: every shader, in both forms, becomes valid SPIR-V (spirv-val), MSL and HLSL, passes Tint (the compiler of Chrome), and keeps to
# scripts/gpu-budget.toml as AMD's compiler RADV builds it for GPUs that are not there: no spills, no scratch memory, enough waves a SIMD.
# Parts whose tools are missing are skipped and named; KEYSPLAT_REQUIRE=static makes that an error. The tools: spirv-tools, mesa-vulkan-drivers, npm.
set -eu

cd "$(dirname "$0")/.."
root=$PWD
out=${CARGO_TARGET_DIR:-$root/target}/shaders
cargo build --release --example gpu_static
static=${CARGO_TARGET_DIR:-$root/target}/release/examples/gpu_static
rm -rf "$out"
"$static" "$out"

skip() {
    echo "gpu-static: skipped: $*" >&2
    case ",${KEYSPLAT_REQUIRE:-}," in *,static,*) exit 1 ;; esac
}

if command -v spirv-val >/dev/null 2>&1; then
    for module in "$out"/*.spv; do
        spirv-val --target-env vulkan1.2 "$module" || { echo "gpu-static: $module is not valid" >&2; exit 1; }
    done
    echo "spirv-val: $(find "$out" -name '*.spv' | wc -l) entry points, all valid"
else
    skip "validation of SPIR-V (spirv-tools)"
fi

radv=$(find /usr/share/vulkan/icd.d /etc/vulkan/icd.d -name 'radeon_icd*.json' 2>/dev/null | head -n 1)
if [ -n "$radv" ]; then
    for family in gfx1100 navi21 polaris10; do
        # Newer drivers take 32 lanes for small workgroups by themselves.
        VK_ICD_FILENAMES=$radv RADV_FORCE_FAMILY=$family RADV_PERFTEST=cswave32 "$static" "$out" scripts/gpu-budget.toml
    done
else
    skip "RADV's statistics (mesa-vulkan-drivers)"
fi

if command -v npm >/dev/null 2>&1 && [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ]; then
    tint=${CARGO_TARGET_DIR:-$root/target}/tint
    mkdir -p "$tint"
    cd "$tint"
    [ -d node_modules/webgpu ] || npm install --silent --no-audit --no-fund --prefix . webgpu@0.6.2 >/dev/null
    node "$root/scripts/tint.mjs" "$out"/*.wgsl
else
    skip "Tint (npm)"
fi
