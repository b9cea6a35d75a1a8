//! Processor name and peak memory, as the system reports them. Linux only; elsewhere `None`.

/// The largest resident memory this process has had, bytes (`VmHWM`).
pub fn peak_host_bytes() -> Option<u64> {
    parse_bytes(&std::fs::read_to_string("/proc/self/status").ok()?, "VmHWM")
}

/// The resident memory that this process has now, bytes (`VmRSS`).
pub fn host_bytes() -> Option<u64> {
    parse_bytes(&std::fs::read_to_string("/proc/self/status").ok()?, "VmRSS")
}

fn parse_bytes(status: &str, key: &str) -> Option<u64> {
    let kibibytes = field(status, key)?.strip_suffix("kB")?.trim().parse::<u64>().ok()?;
    kibibytes.checked_mul(1024)
}

/// The processor's name.
pub fn cpu_name() -> Option<String> {
    parse_cpu_name(&std::fs::read_to_string("/proc/cpuinfo").ok()?)
}

fn parse_cpu_name(cpuinfo: &str) -> Option<String> {
    // Arm boards say what they are in `Model`, if at all.
    ["model name", "Model"].into_iter().find_map(|key| field(cpuinfo, key)).map(str::to_owned)
}

/// The value of the first line `key : value`.
fn field<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        (name.trim() == key).then(|| value.trim())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found() {
        let status = "Name:\tx\nVmHWM:\t    2048 kB\nVmRSS:\t 12 kB\n";
        assert_eq!([parse_bytes(status, "VmHWM"), parse_bytes(status, "VmRSS")], [Some(2048 * 1024), Some(12 * 1024)]);
        assert_eq!(parse_bytes("VmRSS:\t 12 kB\n", "VmHWM"), None);
        assert_eq!(parse_cpu_name("processor\t: 0\nmodel name\t: A CPU @ 2 GHz\n").as_deref(), Some("A CPU @ 2 GHz"));
        assert_eq!(parse_cpu_name("processor\t: 0\nModel\t\t: A board\n").as_deref(), Some("A board"));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn this_process_uses_memory_on_some_processor() {
        let big = std::hint::black_box(vec![1u8; 32 << 20]);
        assert!(peak_host_bytes().unwrap() > big.len() as u64 && host_bytes().unwrap() > big.len() as u64);
        assert_eq!(cpu_name(), parse_cpu_name(&std::fs::read_to_string("/proc/cpuinfo").unwrap()));
        assert_ne!(cpu_name().as_deref(), Some(""));
    }
}
