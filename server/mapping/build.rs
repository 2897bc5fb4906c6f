//! Tells the tests where the recorded drives are: `$CLEARWAY_DATA`, else `<workspace>/../shared/data`.

use std::path::PathBuf;

fn main() {
    println!("cargo::rustc-check-cfg=cfg(clearway_data)");
    println!("cargo::rerun-if-env-changed=CLEARWAY_DATA");
    let beside = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("CLEARWAY_DATA").map_or_else(beside, PathBuf::from);
    if let Ok(folder) = folder.canonicalize()
        && folder.is_dir()
    {
        println!("cargo::rustc-cfg=clearway_data");
        println!("cargo::rustc-env=CLEARWAY_DATA={}", folder.display());
    }
}
