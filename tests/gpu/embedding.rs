//! A program with a wgpu device of its own embeds the trainer: `Gpu::from_device`.

use std::sync::Arc;

use fastrand::Rng;
use image::RgbImage;
use keysplat::gpu::{Gpu, GpuError};
use keysplat::optimise::{AdamConfig, LossConfig, TargetImage, Trainer, TrainingView};
use keysplat::render::GpuCloud;
use keysplat::splat::ShDegree;

/// A device that this test requests itself, with the given change of the documented limits.
fn device(change: fn(&mut wgpu::Limits)) -> (wgpu::Adapter, wgpu::Device, wgpu::Queue) {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default())).unwrap();
    let mut required_limits = Gpu::required_limits(&adapter);
    change(&mut required_limits);
    let descriptor = wgpu::DeviceDescriptor { required_limits, ..Default::default() };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).unwrap();
    (adapter, device, queue)
}

#[test]
fn a_step_on_the_programs_own_device_moves_the_map() {
    if crate::common::recording::skipped_without_adapter() {
        return;
    }
    let (adapter, device, queue) = device(|_| ());
    let gpu = Gpu::from_device(&adapter, device.clone(), queue).unwrap();
    let mut rng = Rng::with_seed(3);
    let camera = crate::common::camera(&mut rng, 48, 32);
    let cloud = crate::common::scene(&mut rng, 60, ShDegree::default());
    let on_gpu = GpuCloud::of(&gpu, &cloud).unwrap();
    let target = TargetImage::new(&gpu, &RgbImage::from_pixel(48, 32, image::Rgb([90, 120, 60])), None).unwrap();
    let mut trainer = Trainer::new(Arc::clone(&gpu)).unwrap();
    let (loss, adam) = (LossConfig::default(), AdamConfig::default());
    let reports = trainer.steps(&on_gpu, &[TrainingView::new(camera, &target); 10], &loss, &adam).unwrap();
    assert!(reports[9].loss.total(&loss) < reports[0].loss.total(&loss), "{reports:?}");
    assert_ne!(on_gpu.download(&gpu).unwrap(), cloud);
    // The program goes on with its device.
    device.create_command_encoder(&Default::default()).finish();
}

#[test]
fn a_device_that_lacks_a_limit_is_refused_by_the_limits_name() {
    if crate::common::recording::skipped_without_adapter() {
        return;
    }
    let (adapter, device, queue) = device(|limits| limits.max_storage_buffers_per_shader_stage = 4);
    match Gpu::from_device(&adapter, device, queue) {
        Err(GpuError::MissingLimit { limit: "max_storage_buffers_per_shader_stage", needed: 8, offered: 4 }) => {}
        other => panic!("{other:?}"),
    }
}
