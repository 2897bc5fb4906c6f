//! Compiles `clearway/v1/*.proto` without a system protoc, and keeps the descriptor set for reflection and recordings.

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    let protos = ["ingest", "journal", "map", "replay", "service"].map(|name| format!("clearway/v1/{name}.proto"));
    for proto in &protos {
        println!("cargo::rerun-if-changed={proto}");
    }
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let descriptors = protox::compile(protos, ["."])?;
    fs::write(out.join("clearway.v1.bin"), descriptors.encode_to_vec())?;
    // A recording carries a schema for each of its messages: the schema without comments and services.
    let mut recorded = protox::compile(["clearway/v1/journal.proto"], ["."])?;
    recorded.file.iter_mut().for_each(|file| file.source_code_info = None);
    fs::write(out.join("recording.bin"), recorded.encode_to_vec())?;
    // Ordered maps: the same map must always give the same bytes.
    let messages = tonic_prost_build::configure().bytes(".clearway.v1").btree_map(".clearway.v1");
    // Most updates have no state, which has a kilobyte, and no plan.
    let messages = messages.boxed(".clearway.v1.MapUpdate.vehicle").boxed(".clearway.v1.MapUpdate.plan");
    messages.boxed(".clearway.v1.Event.body.plan").compile_fds(descriptors)?;
    Ok(())
}
