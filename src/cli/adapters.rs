//! `keysplat adapters`

use keysplat::gpu;

use super::print;

/// Prints a line per adapter, the one that a run would choose first.
pub fn adapters() -> miette::Result<()> {
    let found = gpu::adapters();
    if found.is_empty() {
        return print(&format!("{}\n", gpu::GpuError::NoAdapter));
    }
    for (i, a) in found.iter().enumerate() {
        let chosen = if i == 0 { "  (default)" } else { "" };
        print(&format!("{}  [{}, {}, {}]{chosen}\n", a.name, a.kind, a.backend, a.driver))?;
    }
    Ok(())
}
