//! `keysplat adapters`

use keysplat::gpu;

/// Prints a line per adapter, the one that a run would choose first.
pub fn adapters() {
    let found = gpu::adapters();
    if found.is_empty() {
        println!("no adapter; {}", gpu::GpuError::NoAdapter);
    }
    for (i, a) in found.iter().enumerate() {
        let chosen = if i == 0 { "  (default)" } else { "" };
        println!("{}  [{}, {}, {}]{chosen}", a.name, a.kind, a.backend, a.driver);
    }
}
