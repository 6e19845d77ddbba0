//! Compiles `proto/` without a `protoc`: protox parses it, prost and tonic generate the code.

use std::error::Error;
use std::path::PathBuf;
use std::{env, fs};

use protox::prost::Message;

/// The files that nothing else imports; the others follow from them.
const ROOTS: [&str; 3] =
    ["scpsfm/v1/calibration_service.proto", "scpsfm/v1/input_service.proto", "scpsfm/v1/job_service.proto"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let files = protox::compile(ROOTS, ["proto"])?;
    // What the reflection service answers from.
    let descriptors = PathBuf::from(env::var("OUT_DIR")?).join("scpsfm_descriptors.bin");
    fs::write(descriptors, files.encode_to_vec())?;
    tonic_prost_build::configure()
        // Maps in key order, so that the same message has the same bytes.
        .btree_map(".")
        // A result is cut into chunks without copying it.
        .bytes(".scpsfm.v1.ResultChunk.data")
        .compile_fds(files)?;
    Ok(())
}
