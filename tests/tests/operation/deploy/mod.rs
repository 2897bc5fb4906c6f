//! What `deploy/` holds: linters read it, packages are made of it and started, its guides are followed.
#![cfg_attr(not(clearway_deploy), allow(dead_code, reason = "without the tools these tests report themselves ignored"))]

mod guides;
mod image;
mod linters;
mod service;

use std::path::Path;
use std::process::{Command, Output};

use clearway_tests::{binaries, workspace};

use crate::fixture::venv;

/// Runs a command in the repository to its end; returns what it printed.
fn succeeds(command: &mut Command) -> String {
    venv::run(command.current_dir(workspace()), "the tools that .ci/run installs")
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Makes a release of the built command in `folder`, and unpacks its Debian package into `root`.
fn unpacked_release(folder: &Path, root: &Path) {
    let mut release = Command::new("deploy/release.sh");
    // Little effort for a package that no machine installs.
    release.env("DPKG_DEB_COMPRESSOR_LEVEL", "0").arg(folder).arg(binaries().join("clearway"));
    let sums = succeeds(&mut release);
    for kind in [".tar.gz", ".whl", "clearway-map-0.1.0.tgz", ".foxe", ".deb", ".cdx.json"] {
        assert!(sums.lines().any(|line| line.ends_with(kind)), "{kind} in {sums}");
    }
    let version = env!("CARGO_PKG_VERSION");
    let architecture = succeeds(Command::new("dpkg").arg("--print-architecture"));
    let package = folder.join(format!("clearway_{version}_{}.deb", architecture.trim()));
    succeeds(Command::new("dpkg-deb").arg("-x").arg(package).arg(root));
}
