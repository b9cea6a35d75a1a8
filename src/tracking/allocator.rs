//! Memory that is free and still the process's.

/// Gives memory that was freed back to the system. glibc does so by itself only from the end of its heap on: a map whose keyframes come and go would
/// take ever more. A few milliseconds for a heap of 300 MB. Elsewhere the allocators are left to themselves.
pub fn give_back_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it may be called at any time.
    unsafe {
        libc::malloc_trim(0);
    }
}
