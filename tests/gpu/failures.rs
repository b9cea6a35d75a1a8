//! What happens when the GPU gives way in the middle of a run: a typed error, and everything mapped until then.

use std::time::{Duration, Instant};

use crate::common::recording::{ITERATIONS_PER_KEYFRAME, recording, scratch, skipped_without_adapter};
use fastrand::Rng;
use keysplat::export::MapFormat;
use keysplat::gpu::{Gpu, GpuBuffer, GpuError};
use keysplat::mapping::MappingError;
use keysplat::pipeline::{self, PipelineError, Progress, Replay};
use keysplat::render::{GpuCloud, Rasterizer};
use keysplat::run_folder::outputs;
use keysplat::splat::ShDegree;
use keysplat::{Config, Recording};

fn few_steps() -> Recording {
    let mut config = Config::for_recording(recording());
    config.mapping.iterations_per_keyframe = ITERATIONS_PER_KEYFRAME as usize;
    Recording::open(config).unwrap()
}

fn gpu_error(replay: &Replay) -> &GpuError {
    match &replay.error {
        Some(PipelineError::Mapping(MappingError::Gpu(error))) => error,
        other => panic!("no GPU error: {other:?}"),
    }
}

/// Writes the result as the program does, and reads the map back.
fn assert_written(name: &str, recording: &Recording, Replay { result, .. }: &Replay) {
    assert!(!result.cloud.is_empty(), "the map of the keyframes before the failure is kept");
    let out = scratch().join(name);
    let _lock = outputs::prepare_folder(&out).unwrap();
    outputs::write_results(&out, recording, result).unwrap();
    assert_eq!(MapFormat::default().read(&out.join(outputs::map_name(MapFormat::default()))).unwrap().len(), result.cloud.len());
}

#[test]
fn a_lost_device_ends_the_run_with_what_was_mapped() {
    if skipped_without_adapter() {
        return;
    }
    let recording = few_steps();
    let gpu = Gpu::open(None).unwrap();
    let progress = Progress::default();
    let replay = std::thread::scope(|scope| {
        let (gpu, progress) = (&gpu, &progress);
        scope.spawn(move || {
            while progress.snapshots().get().is_none() {
                std::thread::sleep(Duration::from_millis(1));
            }
            gpu.device.destroy();
        });
        pipeline::run(&recording, gpu, progress, None, None).unwrap()
    });
    assert!(matches!(gpu_error(&replay), GpuError::Failed(_)), "{:?}", replay.error);
    assert_written("lost-device", &recording, &replay);
}

/// What does not fit is refused by name and size, and what there was goes on working.
#[test]
fn buffers_beyond_the_adapter_are_refused_and_nothing_is_lost() {
    if skipped_without_adapter() {
        return;
    }
    const LARGEST: u64 = 8 << 20;
    let small = Gpu::open_small(None, LARGEST).unwrap();
    let rng = &mut Rng::with_seed(1);
    let degree = ShDegree::default();
    let cloud = crate::common::scene(rng, 20_000, degree);
    let mut map = GpuCloud::new(&small, degree, 64).unwrap();
    map.append(&small, &cloud).unwrap();
    let per_gaussian = map.parameters().raw().size() as usize / map.capacity();
    // As many as fit: more than the last power of two below.
    let room = LARGEST as usize / per_gaussian;
    assert!(!room.is_power_of_two() || room > 2 * cloud.len());
    map.append(&small, &crate::common::scene(rng, room - 1000 - cloud.len(), degree)).unwrap();
    let refused = map.append(&small, &crate::common::scene(rng, 2000, degree)).unwrap_err();
    assert!(matches!(refused, GpuError::TooLarge { needed, limit, .. } if needed > LARGEST && limit == LARGEST), "{refused}");
    assert_eq!(map.len(), room - 1000);
    let kept = map.download(&small).unwrap();
    assert_eq!((kept.get(0), kept.get(19_999)), (cloud.get(0), cloud.get(19_999)));

    let mut map = GpuCloud::new(&small, degree, 64).unwrap();
    map.append(&small, &crate::common::scene(rng, 300, degree)).unwrap();
    let mut rasterizer = Rasterizer::new(small.clone()).unwrap();
    let mut view = crate::common::camera(rng, 64, 48);
    let before = rasterizer.render(&map, &view, [0.0; 3]).unwrap();
    (view.pinhole.width, view.pinhole.height) = (4096, 4096);
    let refused = rasterizer.render(&map, &view, [0.0; 3]).unwrap_err();
    assert!(refused.to_string().contains("MiB is needed, but the adapter binds at most 8 MiB"), "{refused}");
    (view.pinhole.width, view.pinhole.height) = (64, 48);
    assert_eq!(rasterizer.render(&map, &view, [0.0; 3]).unwrap(), before);
}

/// Work that takes longer than the limit is reported, and nothing waits for it again.
#[test]
fn a_gpu_that_hangs_is_reported() {
    if skipped_without_adapter() {
        return;
    }
    let gpu = Gpu::open(None).unwrap();
    let [from, to] = ["from", "to"].map(|label| GpuBuffer::storage(&gpu, label, 64 << 20).unwrap());
    let copy = |times: u32| {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        (0..times).for_each(|_| encoder.copy_buffer_to_buffer(from.raw(), 0, to.raw(), 0, from.raw().size()));
        gpu.queue.submit([encoder.finish()]);
    };
    let time = |_| {
        let started = Instant::now();
        copy(10);
        gpu.wait().unwrap();
        started.elapsed().as_secs_f64()
    };
    // The first time the adapter may have to wake up.
    let half_a_second = 5.0 / (0..3).map(time).fold(f64::INFINITY, f64::min);
    copy(half_a_second.clamp(10.0, 20_000.0) as u32);
    let error = gpu.wait_at_most(Duration::ZERO).unwrap_err();
    assert!(matches!(error, GpuError::Hung { .. }) && error.to_string().contains("counts as hung"), "{error}");
    assert!(matches!(to.read::<u32>(&gpu, 0, 1), Err(GpuError::Hung { .. })));
    gpu.device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
}
