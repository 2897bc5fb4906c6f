//! Tells the tests whether the recorded drives are here: `$CLEARWAY_DATA`, else `shared/data` beside the workspace.

use std::path::PathBuf;

fn main() {
    println!("cargo::rerun-if-env-changed=CLEARWAY_DATA");
    println!("cargo::rustc-check-cfg=cfg(clearway_data)");
    let manifest = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").expect("set by cargo"));
    let data = std::env::var_os("CLEARWAY_DATA").map_or(manifest.join("../../../shared/data"), PathBuf::from);
    if let Ok(data) = data.canonicalize() {
        println!("cargo::rustc-cfg=clearway_data");
        println!("cargo::rustc-env=CLEARWAY_DATA={}", data.display());
    }
}
