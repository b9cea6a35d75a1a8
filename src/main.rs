//! The `keysplat` command.

mod cli;

fn main() -> std::process::ExitCode {
    without_device_select();
    cli::main()
}

/// Turns Mesa's device-select layer off where there is no desktop session: it would look for a Wayland display and print an error for each
/// Vulkan instance. keysplat chooses among all adapters by itself.
fn without_device_select() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread has been started.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}
