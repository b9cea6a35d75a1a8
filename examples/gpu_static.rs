//! What compilers make of the shaders, without a GPU: `gpu_static <folder> [budget.toml]` writes each shader in both forms of the blending passes
//! to the folder, as WGSL and, translated as wgpu does it, as SPIR-V, MSL and HLSL. With a budget it also compiles the wide form by the first Vulkan
//! driver with pipeline statistics (RADV for a GPU that `RADV_FORCE_FAMILY` names, which needs no card) and fails on spills, scratch memory,
//! or fewer waves a SIMD than the budget's table of that family has. `scripts/gpu-static.sh` runs it.

use std::collections::BTreeMap;
use std::error::Error;
use std::ffi::{CStr, CString};
use std::path::Path;

use ash::{Device, Instance, khr, vk};
use keysplat::render::{BlendForm, Blending, SHADERS};
use keysplat::splat::model::Surface;
use naga::back::{hlsl, msl, spv};
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use naga::{AddressSpace, Module, ShaderStage};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// Waves that each entry point keeps at least on a SIMD, by GPU family; `default` for those that are not named.
type Budget = BTreeMap<String, BTreeMap<String, u64>>;

/// A compiled entry point: `[words]` of SPIR-V, and the kind of each binding.
struct Compiled {
    label: String,
    entry_point: String,
    words: Vec<u32>,
    bindings: Vec<(u32, vk::DescriptorType)>,
}

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(arguments.first().ok_or("usage: gpu_static <folder> [budget.toml]")?);
    std::fs::create_dir_all(folder)?;
    let mut wide = Vec::new();
    for blending in Blending::all() {
        for shader in SHADERS {
            let is_planar = blending.surface == Surface::Planar;
            if is_planar && !shader.depends_on_surface() {
                continue;
            }
            let text = shader.text(blending);
            let surface = if is_planar { "planar-" } else { "" };
            let label = format!("{:?}-{surface}{}", blending.form, shader.name).to_lowercase();
            std::fs::write(folder.join(format!("{label}.wgsl")), &text)?;
            let module = naga::front::wgsl::parse_str(&text).map_err(|e| e.emit_to_string(&text))?;
            let info = Validator::new(ValidationFlags::all(), Capabilities::all()).validate(&module)?;
            for entry_point in shader.entry_points {
                let path =
                    folder.join(if shader.entry_points.len() == 1 { label.clone() } else { format!("{label}-{entry_point}") });
                let words = translate(&module, &info, entry_point, &path)?;
                // Software adapters alone run what is narrow.
                if blending.form == BlendForm::Wide && !label.ends_with("_narrow") {
                    let label = path.file_name().unwrap_or_default().to_string_lossy().replace("wide-", "");
                    wide.push(Compiled { label, entry_point: (*entry_point).into(), words, bindings: bindings(&module) });
                }
            }
        }
    }
    println!("{} shaders in {} forms are in {}", SHADERS.len(), Blending::all().count(), folder.display());
    let Some(budget) = arguments.get(1) else { return Ok(()) };
    let budget: Budget = toml::from_str(&std::fs::read_to_string(budget)?)?;
    let family = std::env::var("RADV_FORCE_FAMILY").map_err(|_| "RADV_FORCE_FAMILY has to name the GPU")?;
    let waves = budget.get(&family).ok_or_else(|| format!("the budget has no table [{family}]"))?;
    // SAFETY: the Vulkan objects live until the process ends, and each is made by the device it is used with.
    let exceeded = unsafe { hold(&wide, waves) }?;
    if exceeded.is_empty() { Ok(()) } else { Err(format!("{family}: over the budget: {}", exceeded.join("; ")).into()) }
}

/// Writes an entry point as SPIR-V, MSL and HLSL, with wgpu's options for modules it trusts; returns the SPIR-V.
fn translate(module: &Module, info: &ModuleInfo, entry_point: &str, path: &Path) -> Outcome<Vec<u32>> {
    let unchecked = BoundsCheckPolicy::Unchecked;
    let policies = BoundsCheckPolicies { index: unchecked, buffer: unchecked, image_load: unchecked, binding_array: unchecked };
    let stage = ShaderStage::Compute;
    let options = spv::Options {
        lang_version: (1, 4),
        flags: spv::WriterFlags::LABEL_VARYINGS,
        bounds_check_policies: policies,
        zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::None,
        force_loop_bounding: false,
        emit_int_div_checks: false,
        ..Default::default()
    };
    let pipeline = spv::PipelineOptions { shader_stage: stage, entry_point: entry_point.into() };
    let words = spv::write_vec(module, info, &options, Some(&pipeline))?;
    std::fs::write(path.with_extension("spv"), bytemuck::cast_slice(&words))?;

    let options = msl::Options {
        lang_version: (2, 4),
        fake_missing_bindings: true,
        bounds_check_policies: policies,
        zero_initialize_workgroup_memory: false,
        force_loop_bounding: false,
        emit_int_div_checks: false,
        ..Default::default()
    };
    let pipeline = msl::PipelineOptions { entry_point: Some((stage, entry_point.into())), ..Default::default() };
    let (metal, _) = msl::write_string(module, info, &options, &pipeline)?;
    std::fs::write(path.with_extension("metal"), metal)?;

    let options = hlsl::Options {
        fake_missing_bindings: true,
        zero_initialize_workgroup_memory: false,
        restrict_indexing: false,
        force_loop_bounding: false,
        ..Default::default()
    };
    let pipeline = hlsl::PipelineOptions { entry_point: Some((stage, entry_point.into())) };
    let mut text = String::new();
    hlsl::Writer::new(&mut text, &options, &pipeline).write(module, info, None)?;
    std::fs::write(path.with_extension("hlsl"), text)?;
    Ok(words)
}

fn bindings(module: &Module) -> Vec<(u32, vk::DescriptorType)> {
    let kind = |space| match space {
        AddressSpace::Uniform => vk::DescriptorType::UNIFORM_BUFFER,
        _ => vk::DescriptorType::STORAGE_BUFFER,
    };
    module.global_variables.iter().filter_map(|(_, v)| Some((v.binding?.binding, kind(v.space)))).collect()
}

/// Compiles the shaders by the driver; prints a row for each, and returns those beyond the budget.
unsafe fn hold(shaders: &[Compiled], budget: &BTreeMap<String, u64>) -> Outcome<Vec<String>> {
    let entry = unsafe { ash::Entry::load() }?;
    let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_3);
    let instance = unsafe { entry.create_instance(&vk::InstanceCreateInfo::default().application_info(&application), None) }?;
    let extension = khr::pipeline_executable_properties::NAME;
    let has_statistics = |gpu: &vk::PhysicalDevice| {
        let extensions = unsafe { instance.enumerate_device_extension_properties(*gpu) }.unwrap_or_default();
        extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(extension))
    };
    let gpu = unsafe { instance.enumerate_physical_devices() }?.into_iter().find(has_statistics);
    let gpu = gpu.ok_or("no Vulkan driver here has pipeline statistics; install mesa-vulkan-drivers")?;
    let properties = unsafe { instance.get_physical_device_properties(gpu) };
    println!("\n{}", properties.device_name_as_c_str()?.to_string_lossy());
    let device = unsafe { open(&instance, gpu) }?;
    let statistics = khr::pipeline_executable_properties::Device::new(&instance, &device);
    println!("| kernel | wave | VGPRs | LDS bytes | waves a SIMD |\n|---|---|---|---|---|");
    let mut exceeded = Vec::new();
    for shader in shaders {
        let (subgroup, found) = unsafe { compile(&device, &statistics, shader) }?;
        let of =
            |name: &str| found.get(name).copied().ok_or_else(|| format!("{}: the driver does not count {name:?}", shader.label));
        let waves = of("Subgroups per SIMD")?;
        println!("| {} | {subgroup} | {} | {} | {waves} |", shader.label, of("VGPRs")?, of("LDS size")?);
        let least = budget.get(&shader.label).or_else(|| budget.get("default")).copied().unwrap_or(1);
        if waves < least {
            exceeded.push(format!("{} has {waves} waves of {least}", shader.label));
        }
        for forbidden in ["Spilled VGPRs", "Spilled SGPRs", "Scratch size"] {
            if of(forbidden)? > 0 {
                exceeded.push(format!("{}: {forbidden} {}", shader.label, of(forbidden)?));
            }
        }
    }
    Ok(exceeded)
}

unsafe fn open(instance: &Instance, gpu: vk::PhysicalDevice) -> Outcome<Device> {
    let mut statistics = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
    let mut memory_model = vk::PhysicalDeviceVulkan12Features::default().vulkan_memory_model(true);
    let queues = [vk::DeviceQueueCreateInfo::default().queue_priorities(&[1.0])];
    let extensions = [khr::pipeline_executable_properties::NAME.as_ptr()];
    let info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_extension_names(&extensions)
        .push_next(&mut memory_model)
        .push_next(&mut statistics);
    Ok(unsafe { instance.create_device(gpu, &info, None) }?)
}

/// Lanes of a subgroup, and the driver's statistics by name.
unsafe fn compile(
    device: &Device,
    statistics: &khr::pipeline_executable_properties::Device,
    shader: &Compiled,
) -> Outcome<(u32, BTreeMap<String, u64>)> {
    let binding = |&(binding, kind): &(u32, vk::DescriptorType)| {
        let layout = vk::DescriptorSetLayoutBinding::default().binding(binding).descriptor_type(kind);
        layout.descriptor_count(1).stage_flags(vk::ShaderStageFlags::COMPUTE)
    };
    let bindings: Vec<_> = shader.bindings.iter().map(binding).collect();
    let sets = [unsafe {
        device.create_descriptor_set_layout(&vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings), None)
    }?];
    let layout = unsafe { device.create_pipeline_layout(&vk::PipelineLayoutCreateInfo::default().set_layouts(&sets), None) }?;
    let module = unsafe { device.create_shader_module(&vk::ShaderModuleCreateInfo::default().code(&shader.words), None) }?;
    let name = CString::new(shader.entry_point.as_str())?;
    let stage = vk::PipelineShaderStageCreateInfo::default().stage(vk::ShaderStageFlags::COMPUTE).module(module).name(&name);
    let flags = vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR;
    let info = vk::ComputePipelineCreateInfo::default().flags(flags).stage(stage).layout(layout);
    let pipelines = unsafe { device.create_compute_pipelines(vk::PipelineCache::null(), &[info], None) };
    let pipeline = pipelines.map_err(|(_, error)| format!("{} does not compile: {error}", shader.label))?[0];

    let pipeline_info = vk::PipelineInfoKHR::default().pipeline(pipeline);
    let mut executables = [vk::PipelineExecutablePropertiesKHR::default()];
    let (get_executables, get_statistics) =
        (statistics.fp().get_pipeline_executable_properties_khr, statistics.fp().get_pipeline_executable_statistics_khr);
    let mut count = 1;
    unsafe { get_executables(device.handle(), &pipeline_info, &mut count, executables.as_mut_ptr()) }.result()?;
    let executable = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline);
    let mut found = [vk::PipelineExecutableStatisticKHR::default(); 64];
    let mut count = found.len() as u32;
    unsafe { get_statistics(device.handle(), &executable, &mut count, found.as_mut_ptr()) }.result()?;
    let mut named = BTreeMap::new();
    for statistic in &found[..count as usize] {
        // SAFETY: the driver ends its names with a zero; RADV's statistics are unsigned integers.
        let (name, value) = unsafe { (CStr::from_ptr(statistic.name.as_ptr()), statistic.value.u64) };
        named.insert(name.to_string_lossy().into_owned(), value);
    }
    Ok((executables[0].subgroup_size, named))
}
