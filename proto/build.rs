//! Compiles `clearway/v1/*.proto` without a system protoc, and keeps the descriptor set for reflection and recordings.

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    let protos = ["ingest", "journal", "map", "replay", "service"].map(|name| format!("clearway/v1/{name}.proto"));
    for proto in &protos {
        println!("cargo::rerun-if-changed={proto}");
    }
    let descriptors = protox::compile(protos, ["."])?;
    fs::write(PathBuf::from(env::var("OUT_DIR")?).join("clearway.v1.bin"), descriptors.encode_to_vec())?;
    // Ordered maps: the same map must always give the same bytes.
    tonic_prost_build::configure().bytes(".clearway.v1").btree_map(".clearway.v1").compile_fds(descriptors)?;
    Ok(())
}
