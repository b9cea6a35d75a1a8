//! Every shader is valid WGSL with the entry points that the host asks for; no adapter is needed.

use keysplat::render::{SHADERS, ShaderSource};
use naga::valid::{Capabilities, ValidationFlags, Validator};

#[test]
fn every_shader_validates() {
    let faults: Vec<String> = SHADERS.iter().filter_map(|shader| validate(shader).err()).collect();
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

fn validate(shader: &ShaderSource) -> Result<(), String> {
    let text = shader.text();
    let module = naga::front::wgsl::parse_str(&text).map_err(|e| format!("{}: {}", shader.name, e.emit_to_string(&text)))?;
    Validator::new(ValidationFlags::all(), Capabilities::default())
        .validate(&module)
        .map_err(|e| format!("{}: {}", shader.name, e.emit_to_string(&text)))?;
    let found: Vec<&str> = module.entry_points.iter().map(|e| e.name.as_str()).collect();
    if found == shader.entry_points { Ok(()) } else { Err(format!("{}: entry points {found:?}", shader.name)) }
}
