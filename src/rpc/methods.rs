//! The methods of this server, and the scope that a key needs for each.

use super::keys::Scope::{self, Admin, Ordinary, ReadOnly};
use crate::telemetry::metrics::UNKNOWN_METHOD;

/// Every method that this server offers, with the scope that a key needs for it. The path of a request is only looked
/// up here: taken as a label, it would let a client make series without end.
const METHODS: [(&str, Scope); 23] = [
    ("scpsfm.v1.CalibrationService/Solve", Ordinary),
    ("scpsfm.v1.CalibrationService/GetCapabilities", ReadOnly),
    ("scpsfm.v1.JobService/CreateJob", Ordinary),
    ("scpsfm.v1.JobService/BatchCreateJobs", Ordinary),
    ("scpsfm.v1.JobService/GetJob", ReadOnly),
    ("scpsfm.v1.JobService/ListJobs", ReadOnly),
    ("scpsfm.v1.JobService/WatchJob", ReadOnly),
    ("scpsfm.v1.JobService/CancelJob", Ordinary),
    ("scpsfm.v1.JobService/DeleteJob", Ordinary),
    ("scpsfm.v1.JobService/RetryJob", Ordinary),
    ("scpsfm.v1.JobService/SetJobPriority", Ordinary),
    ("scpsfm.v1.JobService/GetJobResult", ReadOnly),
    ("scpsfm.v1.JobService/ReadJobResult", ReadOnly),
    ("scpsfm.v1.InputService/UploadInput", Ordinary),
    ("scpsfm.v1.InputService/GetUploadStatus", ReadOnly),
    ("scpsfm.v1.InputService/ListInputs", ReadOnly),
    ("scpsfm.v1.InputService/DeleteInput", Ordinary),
    ("scpsfm.v1.AdminService/GetQueue", Admin),
    ("scpsfm.v1.AdminService/PauseQueue", Admin),
    ("scpsfm.v1.AdminService/ResumeQueue", Admin),
    ("scpsfm.v1.AdminService/DrainServer", Admin),
    ("grpc.health.v1.Health/Check", ReadOnly),
    ("grpc.health.v1.Health/Watch", ReadOnly),
];

fn find(path: &str) -> Option<(&'static str, Scope)> {
    let name = path.strip_prefix('/').unwrap_or(path);
    METHODS.into_iter().find(|(method, _)| *method == name)
}

/// The name under which a call of this path is counted.
pub fn method_of(path: &str) -> &'static str {
    find(path).map_or(UNKNOWN_METHOD, |(method, _)| method)
}

/// The scope that a key needs for the method at this path. What is not listed is reflection, or is not there, which its
/// caller is told by `UNIMPLEMENTED`.
pub fn scope_of(path: &str) -> Scope {
    find(path).map_or(ReadOnly, |(_, scope)| scope)
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use prost_types::method_options::IdempotencyLevel;

    use super::*;
    use crate::rpc::proto::FILE_DESCRIPTOR_SET;

    #[test]
    fn every_method_of_the_api_is_known() {
        let files = prost_types::FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("decodes");
        let mut count = 0;
        for file in files.file {
            for service in &file.service {
                for method in &service.method {
                    let name = format!("{}.{}/{}", file.package(), service.name(), method.name());
                    assert_eq!(method_of(&format!("/{name}")), name);
                    // Methods whose names begin with these words change nothing.
                    let reads = ["Get", "List", "Watch", "Read"].iter().any(|verb| method.name().starts_with(verb));
                    let level = method.options.as_ref().map_or_else(Default::default, |of| of.idempotency_level());
                    assert_eq!(level == IdempotencyLevel::NoSideEffects, reads, "{name}");
                    let expected = match (service.name(), reads) {
                        ("AdminService", _) => Scope::Admin,
                        (_, true) => Scope::ReadOnly,
                        (_, false) => Scope::Ordinary,
                    };
                    assert_eq!(scope_of(&format!("/{name}")), expected, "{name}");
                    count += 1;
                }
            }
        }
        assert_eq!((count, METHODS.len()), (21, 23), "health has two");
        assert_eq!(method_of("/scpsfm.v1.JobService/Invented"), UNKNOWN_METHOD);
    }
}
