//! What the system says of this process: its start, memory, open files and processor time, from `/proc`.

use std::fs;

/// Ticks in a second, on every Linux; a tick is the unit of times in `/proc/self/stat`.
const TICKS_HZ: f64 = 100.0;

/// The figures of a process; `None` where the system does not tell one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Process {
    /// Start of the process, in seconds since the Unix epoch.
    pub start_s: Option<f64>,
    /// Memory that is in use and not swapped out, in bytes.
    pub resident_bytes: Option<f64>,
    /// Processor time in use and in the system, in seconds.
    pub cpu_s: Option<f64>,
    /// Number of open files and sockets.
    pub open_files: Option<f64>,
    /// Largest number of open files that is allowed.
    pub open_files_max: Option<f64>,
}

/// The figures of this process now.
pub fn read() -> Process {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name of the program stands in brackets and may hold spaces.
    let fields: Vec<f64> = stat
        .rsplit_once(')')
        .map_or("", |(_, fields)| fields)
        .split_whitespace()
        .map(|field| field.parse().unwrap_or(0.0))
        .collect();
    let boot_s = number_after("/proc/stat", "btime ");
    let limits = fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let files = limits.lines().find_map(|line| line.strip_prefix("Max open files"));
    Process {
        // Fields 14, 15 and 22 of proc(5); the first behind the name is field 3.
        cpu_s: fields.get(11).zip(fields.get(12)).map(|(user, system)| (user + system) / TICKS_HZ),
        start_s: fields.get(19).zip(boot_s).map(|(ticks, boot_s)| boot_s + ticks / TICKS_HZ),
        resident_bytes: number_after("/proc/self/status", "VmRSS:").map(|kib| kib * 1024.0),
        open_files: fs::read_dir("/proc/self/fd").ok().map(|files| files.count() as f64),
        open_files_max: files.and_then(|line| line.split_whitespace().next()?.parse().ok()),
    }
}

/// The number behind a word at the beginning of a line of a file.
fn number_after(file: &str, word: &str) -> Option<f64> {
    let text = fs::read_to_string(file).ok()?;
    text.lines().find_map(|line| line.strip_prefix(word))?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_system_tells_this_process_apart() {
        let Process { start_s, resident_bytes, cpu_s, open_files, open_files_max } = read();
        let now_s = crate::base::clock::now_ns() as f64 / 1e9;
        assert!(start_s.is_some_and(|start| start < now_s && start > now_s - 86_400.0), "{start_s:?}, now {now_s}");
        assert!(resident_bytes.is_some_and(|bytes| bytes > 1e6), "{resident_bytes:?}");
        assert!(cpu_s.is_some() && open_files.is_some_and(|files| files >= 3.0), "{cpu_s:?} {open_files:?}");
        assert!(open_files_max > open_files, "{open_files:?} {open_files_max:?}");
    }
}
