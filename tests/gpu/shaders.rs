//! Every shader is valid WGSL with the entry points that the host asks for; no adapter is needed.

use keysplat::render::layout::struct_layouts;
use keysplat::render::{BlendForm, Blending, SHADERS, ShaderSource};
use naga::valid::{Capabilities, ValidationFlags, Validator};

#[test]
fn every_shader_validates() {
    let faults: Vec<String> =
        Blending::all().flat_map(|blending| SHADERS.iter().filter_map(move |shader| validate(shader, blending).err())).collect();
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

fn validate(shader: &ShaderSource, blending: Blending) -> Result<(), String> {
    let text = shader.text(blending);
    let module = naga::front::wgsl::parse_str(&text).map_err(|e| format!("{}: {}", shader.name, e.emit_to_string(&text)))?;
    Validator::new(ValidationFlags::all(), Capabilities::SHADER_FLOAT16_IN_FLOAT32)
        .validate(&module)
        .map_err(|e| format!("{}: {}", shader.name, e.emit_to_string(&text)))?;
    let found: Vec<&str> = module.entry_points.iter().map(|e| e.name.as_str()).collect();
    if found == shader.entry_points { Ok(()) } else { Err(format!("{}: entry points {found:?}", shader.name)) }
}

/// Shared structs have the same fields at the same places on both sides; host twins may be padded at the end.
#[test]
fn host_structs_match_the_shaders() {
    let host = struct_layouts();
    let mut seen = std::collections::BTreeSet::new();
    for shader in SHADERS {
        let module = naga::front::wgsl::parse_str(&shader.text(BlendForm::default())).unwrap();
        for (_, ty) in module.types.iter() {
            let (Some(name), naga::TypeInner::Struct { members, span }) = (&ty.name, &ty.inner) else { continue };
            let Some((_, size, fields)) = host.iter().find(|(host_name, ..)| host_name == name) else { continue };
            seen.insert(name.clone());
            let wgsl: Vec<(&str, usize)> = members.iter().map(|m| (m.name.as_deref().unwrap(), m.offset as usize)).collect();
            let fields: Vec<(&str, usize)> = fields.iter().copied().filter(|(field, _)| *field != "pad").collect();
            assert_eq!(wgsl, fields, "{name} in {}", shader.name);
            assert!(*size >= *span as usize, "{name} in {}: {size} bytes on the host, {span} in the shader", shader.name);
        }
    }
    let all: std::collections::BTreeSet<String> = host.iter().map(|(name, ..)| (*name).into()).collect();
    assert_eq!(seen, all, "each host twin has its shader");
}
