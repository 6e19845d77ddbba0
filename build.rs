//! Compiles `proto/` without a `protoc`: protox parses it, prost and tonic generate the code.

use std::error::Error;
use std::path::PathBuf;
use std::{env, fs};

use protox::prost_reflect::prost_types::{DescriptorProto, FileDescriptorSet};

/// The files that nothing else imports; the others follow from them.
const ROOTS: [&str; 4] = [
    "scpsfm/v1/admin_service.proto",
    "scpsfm/v1/calibration_service.proto",
    "scpsfm/v1/input_service.proto",
    "scpsfm/v1/job_service.proto",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let mut compiler = protox::Compiler::new(["proto"])?;
    compiler.include_imports(true).include_source_info(true).open_files(ROOTS)?;
    // What reflection and JSON over HTTP answer from; encoded by protox, since prost forgets the annotations.
    let descriptors = PathBuf::from(env::var("OUT_DIR")?).join("scpsfm_descriptors.bin");
    fs::write(descriptors, compiler.encode_file_descriptor_set())?;
    let mut files = compiler.file_descriptor_set();
    pack(&mut files);
    // Messages and clients.
    tonic_prost_build::configure()
        .build_server(false)
        // Maps in key order, so that the same message has the same bytes.
        .btree_map(".")
        // A result is cut into chunks without copying it.
        .bytes(".scpsfm.v1.ResultChunk")
        .compile_fds(files)?;
    // Servers apart: they send a result as it is stored, and decode none.
    let servers = PathBuf::from(env::var("OUT_DIR")?).join("servers");
    fs::create_dir_all(&servers)?;
    tonic_prost_build::configure()
        .build_client(false)
        .extern_path(".scpsfm.v1", "crate::rpc::proto")
        .extern_path(".scpsfm.v1.JobResult", "crate::rpc::jobs::EncodedJobResult")
        .out_dir(servers)
        .compile_fds(compiler.file_descriptor_set())?;
    Ok(())
}

/// Says of each array of numbers that it is packed, as it is by default in proto3: prost takes any option of a field,
/// such as its field_behavior, to say that it is not.
fn pack(files: &mut FileDescriptorSet) {
    let mut messages: Vec<&mut DescriptorProto> =
        files.file.iter_mut().flat_map(|file| &mut file.message_type).collect();
    while let Some(message) = messages.pop() {
        for options in message.field.iter_mut().filter_map(|field| field.options.as_mut()) {
            options.packed.get_or_insert(true);
        }
        messages.extend(&mut message.nested_type);
    }
}
