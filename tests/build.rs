//! Finds what some tests need beside Rust, for every crate that names this file as its build script. A test whose need
//! is not met reports itself ignored, with the line that installs it.
//!
//! | `cfg` | what was found |
//! |---|---|
//! | `clearway_data` | recorded drives with an `INDEX.md`: `$CLEARWAY_DATA`, else `shared/data` beside the repository |
//! | `clearway_python` | `python3` with the modules `venv` and `ensurepip` |
//! | `clearway_npm` | `npm`, which installs `buf` |
//! | `clearway_cpp` | a compiler of C++, `c++` |
//! | `clearway_cpp_grpc` | also `cmake`, and gRPC's library for C++ |
//! | `clearway_openssl` | `openssl`, with which `deploy/make-test-ca.sh` makes certificates |
//! | `clearway_deploy` | the tools in [`DEPLOY`], which lint and start `deploy/`, as root |
//! | `clearway_namespaces` | the tools in [`NAMESPACES`], which `machines` needs, as root, and `/dev/net/tun` |
//! | `clearway_browser` | `chromium` and `chromedriver` |
//! | `clearway_promtool` | `promtool`, which comes with Prometheus |
//!
//! `env!("CLEARWAY_DRIVES")` is the path of the recorded drives, or empty. After you install one of them,
//! `touch tests/build.rs` makes cargo look again.

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Programs that lint and start what `deploy/` holds, with an argument that makes each end at once with success.
const DEPLOY: [(&str, &[&str]); 8] = [
    ("systemd-analyze", &["--version"]),
    ("shellcheck", &["--version"]),
    ("kubectl", &["version", "--client"]),
    ("buildah", &["--version"]),
    ("mmdebstrap", &["--version"]),
    ("strip", &["--version"]),
    ("ip", &["-Version"]),
    // Only root may make namespaces.
    ("unshare", &["--mount", "--net", "true"]),
];

/// Programs that make machines with links and clocks of their own, with such an argument.
const NAMESPACES: [(&str, &[&str]); 4] = [
    ("ip", &["-Version"]),
    ("python3", &["--version"]),
    ("faketime", &["--version"]),
    // Only root may make namespaces.
    ("unshare", &["--mount", "--net", "true"]),
];

fn main() {
    println!("cargo::rerun-if-env-changed=CLEARWAY_DATA");
    let package = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("set by cargo"));
    let repository = package.ancestors().find(|folder| folder.join("ARCHITECTURE.md").is_file());
    if let Some(repository) = repository {
        println!("cargo::rerun-if-changed={}", repository.join("tests/build.rs").display());
    }
    let data = env::var_os("CLEARWAY_DATA").map(PathBuf::from);
    let data = data.or_else(|| repository.and_then(Path::parent).map(|beside| beside.join("shared/data")));
    let data = data.filter(|data| data.join("INDEX.md").is_file()).and_then(|data| data.canonicalize().ok());
    if let Some(data) = &data {
        println!("cargo::rerun-if-changed={}", data.join("INDEX.md").display());
    }
    // A published crate looks for nothing on the machine of its user.
    let succeeds = |program: &str, arguments: &[&str]| repository.is_some() && succeeds(program, arguments);
    set("clearway_data", data.is_some());
    println!("cargo::rustc-env=CLEARWAY_DRIVES={}", data.unwrap_or_default().display());
    set("clearway_python", succeeds("python3", &["-c", "import venv, ensurepip"]));
    set("clearway_npm", succeeds("npm", &["--version"]));
    let has_cpp = succeeds("c++", &["--version"]);
    set("clearway_cpp", has_cpp);
    let has_grpc = succeeds("pkg-config", &["--exists", "grpc++", "protobuf"]);
    set("clearway_cpp_grpc", has_cpp && has_grpc && succeeds("cmake", &["--version"]));
    set("clearway_openssl", succeeds("openssl", &["version"]));
    set("clearway_promtool", succeeds("promtool", &["--version"]));
    let can_deploy = DEPLOY.iter().all(|(program, arguments)| succeeds(program, arguments));
    set("clearway_deploy", can_deploy && succeeds("python3", &["-c", "import venv, ensurepip"]));
    let has_namespaces = NAMESPACES.iter().all(|(program, arguments)| succeeds(program, arguments));
    set("clearway_namespaces", has_namespaces && Path::new("/dev/net/tun").exists());
    set("clearway_browser", succeeds("chromium", &["--version"]) && succeeds("chromedriver", &["--version"]));
}

/// Declares a `cfg`, and sets it if its need is met.
fn set(cfg: &str, is_met: bool) {
    println!("cargo::rustc-check-cfg=cfg({cfg})");
    if is_met {
        println!("cargo::rustc-cfg={cfg}");
    }
}

/// True if the program is there and exits with success.
fn succeeds(program: &str, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).stdin(Stdio::null()).output();
    output.is_ok_and(|output| output.status.success())
}
