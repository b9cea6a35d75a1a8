//! One training step by criterion: as a whole (wall time) and stage by stage (GPU timestamps), over sizes of map and image and degrees
//! of the spherical harmonics. `cargo bench -- 110000/640x480/sh1` measures a part; `KEYSPLAT_ADAPTER` names an adapter.

use std::cell::RefCell;
use std::time::Duration;

use criterion::{Criterion, criterion_group, criterion_main};
use keysplat::calibration::{BenchScene, StepRunner, StepTimes};
use keysplat::gpu::{Gpu, GpuError};
use keysplat::render::BlendForm;
use keysplat::splat::ShDegree;

const GAUSSIANS: [usize; 4] = [10_000, 110_000, 500_000, 2_000_000];
const SIZES: [(u32, u32); 3] = [(320, 240), (640, 480), (1200, 680)];
const DEGREES: [u8; 3] = [0, 1, 3];
/// Stages that are worth a benchmark of their own; the others are a few percent together.
const STAGES: [&str; 11] = [
    "project_forward",
    "sort_scatter",
    "tile_lists_wide",
    "tile_lists_narrow",
    "rasterize_forward_wide",
    "rasterize_forward_narrow",
    "loss_forward",
    "loss_backward",
    "rasterize_backward_wide",
    "rasterize_backward_narrow",
    "project_backward_adam",
];

fn steps(criterion: &mut Criterion) {
    let gpu = match Gpu::open_profiled(std::env::var("KEYSPLAT_ADAPTER").ok().as_deref()) {
        Ok(gpu) => gpu,
        Err(error) => return eprintln!("SKIPPED: {error}"),
    };
    for gaussians in GAUSSIANS {
        for (width, height) in SIZES {
            for degree in DEGREES {
                let name = format!("{gaussians}/{width}x{height}/sh{degree}");
                let form = BlendForm::of(&gpu);
                let runner = move |gpu| {
                    let scene = BenchScene::new(gpu, gaussians, (width, height), ShDegree::new(degree).expect("0 to 3"))?;
                    StepRunner::new(gpu, scene, form)
                };
                bench_scene(criterion, &name, || runner(&gpu));
            }
        }
    }
}

/// The scene is built only if one of its benchmarks is chosen. Where it does not fit, that is said and the others go on.
fn bench_scene(criterion: &mut Criterion, name: &str, build: impl Fn() -> Result<StepRunner, GpuError>) {
    let runner = RefCell::new(None);
    let mut group = criterion.benchmark_group(name);
    group.sample_size(10).warm_up_time(Duration::from_millis(1));
    let mut bench = |id: &str, part: &dyn Fn(&StepTimes) -> Duration| {
        group.bench_function(id, |bencher| {
            bencher.iter_custom(|iterations| {
                let mut runner = runner.borrow_mut();
                let runner = match runner.get_or_insert_with(&build) {
                    Ok(runner) => runner,
                    Err(error) => {
                        eprintln!("{name}: SKIPPED: {error}");
                        return Duration::from_secs(1);
                    }
                };
                (0..iterations).map(|_| part(&runner.run().expect("the adapter keeps working"))).sum()
            });
        });
    };
    bench("step", &|times| times.wall);
    for stage in STAGES {
        bench(stage, &|times| times.stages.get(stage).copied().unwrap_or(Duration::from_nanos(1)));
    }
    group.finish();
}

criterion_group!(benches, steps);
criterion_main!(benches);
