//! The command `clearway` in several builds, and the surroundings in which it runs.

use std::path::PathBuf;
use std::process::{Command, Output};
use std::str::FromStr;

use clearway_tests::workspace;

/// A build of the command.
#[derive(Clone, Debug)]
pub struct Program {
    /// Its name in the table.
    pub name: String,
    /// The command.
    pub path: PathBuf,
}

/// What may differ between two machines, and between two runs on one.
#[derive(Clone, Copy, Debug)]
pub struct Surroundings {
    /// Number of processors that the command may use.
    pub processors: usize,
    /// True if the C library takes its functions for processors without FMA and AVX2: some of its sines, exponentials
    /// and logarithms then differ in the last bit.
    pub without_fma: bool,
}

impl FromStr for Program {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, path) = text.split_once('=').ok_or("NAME=PATH is allowed")?;
        let path = std::path::absolute(path).map_err(|error| error.to_string())?;
        if !path.is_file() {
            return Err(format!("{} is no file", path.display()));
        }
        Ok(Self { name: name.to_owned(), path })
    }
}

/// Builds the command: debug, release, and release for processors since 2013. Without zenoh, SQLite and the store,
/// which make no map.
///
/// # Panics
/// If a build fails.
pub fn build() -> Vec<Program> {
    let target = workspace().join("target");
    let mut builds = vec![
        ("debug", target.clone(), "debug", None),
        ("release", target.clone(), "release", None),
        ("v3", target.join("v3"), "release", Some("-C target-cpu=x86-64-v3")),
    ];
    if cfg!(not(target_arch = "x86_64")) {
        builds.pop();
    }
    let built = builds.into_iter().map(|(name, target, profile, flags)| {
        eprintln!("building {name}");
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["build", "--package", "clearway", "--no-default-features", "--features", "tools", "--target-dir"]);
        cargo.arg(&target).current_dir(workspace());
        if profile == "release" {
            cargo.arg("--release");
        }
        cargo.envs(flags.map(|flags| ("RUSTFLAGS", flags)));
        let status = cargo.status().expect("cargo runs");
        assert!(status.success(), "cargo build of {name}: {status}");
        Program { name: name.to_owned(), path: target.join(profile).join("clearway") }
    });
    built.collect()
}

impl Program {
    /// The command with arguments, in these surroundings.
    pub fn command(&self, surroundings: Surroundings, arguments: &[&str]) -> Command {
        let mut command = Command::new("taskset");
        command.args(["--cpu-list", &processors(surroundings.processors)]).arg(&self.path).args(arguments);
        if surroundings.without_fma {
            command.env("GLIBC_TUNABLES", "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2");
        }
        command
    }

    /// Runs the command to its end.
    ///
    /// # Panics
    /// If it fails. An input that is not whole (exit code 2) is no failure here: what follows needs the output.
    pub fn run(&self, surroundings: Surroundings, arguments: &[&str]) -> Output {
        let output = self.command(surroundings, arguments).output().expect("taskset, of util-linux");
        let said = String::from_utf8_lossy(&output.stderr);
        let is_done = matches!(output.status.code(), Some(0 | 2));
        assert!(is_done, "{} {arguments:?}: {}: {said}", self.name, output.status);
        output
    }
}

impl Surroundings {
    /// As this machine is.
    pub const PLAIN: Self = Self { processors: usize::MAX, without_fma: false };

    /// Those of each of many runs: one, two and four processors, with and without FMA, in turn.
    pub fn of_run(run: usize) -> Self {
        Self { processors: [1, 2, 4][run % 3], without_fma: run % 2 == 1 }
    }
}

/// The first processors that this process may use, as taskset lists them.
fn processors(count: usize) -> String {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let allowed =
        status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).expect("a list of processors");
    let number = |text: &str| text.trim().parse::<usize>().expect("a number");
    let ranges = allowed.split(',').map(|range| range.split_once('-').unwrap_or((range, range)));
    let all = ranges.flat_map(|(first, last)| number(first)..=number(last));
    all.take(count).map(|processor| processor.to_string()).collect::<Vec<_>>().join(",")
}
