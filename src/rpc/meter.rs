//! Counts every call by method and status code, from the request's headers to the last byte of its answer.

use std::pin::Pin;
use std::task::{Context, Poll};

use http_body::{Body as HttpBody, Frame};
use prost::bytes::Bytes;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::{Code, Status};
use tower::{Layer, Service};

use crate::telemetry::metrics::{RpcCall, UNKNOWN_METHOD};

/// Every method that this server offers. The path of a request is only looked up here: taken as a label, it would let
/// a client make series without end.
const METHODS: [&str; 14] = [
    "scpsfm.v1.CalibrationService/Solve",
    "scpsfm.v1.CalibrationService/GetCapabilities",
    "scpsfm.v1.JobService/CreateJob",
    "scpsfm.v1.JobService/BatchCreateJobs",
    "scpsfm.v1.JobService/GetJob",
    "scpsfm.v1.JobService/ListJobs",
    "scpsfm.v1.JobService/WatchJob",
    "scpsfm.v1.JobService/CancelJob",
    "scpsfm.v1.JobService/DeleteJob",
    "scpsfm.v1.JobService/ReadJobResult",
    "scpsfm.v1.InputService/UploadInput",
    "scpsfm.v1.InputService/GetUploadStatus",
    "grpc.health.v1.Health/Check",
    "grpc.health.v1.Health/Watch",
];

fn method_of(path: &str) -> &'static str {
    let name = path.strip_prefix('/').unwrap_or(path);
    METHODS.into_iter().find(|method| *method == name).unwrap_or(UNKNOWN_METHOD)
}

/// The layer; goes around everything else.
#[derive(Debug, Clone, Copy, Default)]
pub struct Meter;

impl<S> Layer<S> for Meter {
    type Service = Metered<S>;

    fn layer(&self, inner: S) -> Metered<S> {
        Metered { inner }
    }
}

/// A service whose calls are counted.
#[derive(Debug, Clone)]
pub struct Metered<S> {
    inner: S,
}

impl<S, B> Service<Request<B>> for Metered<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<MeteredBody>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let call = RpcCall::begin(method_of(request.uri().path()));
        let answer = self.inner.call(request);
        Box::pin(async move {
            let answer = answer.await?;
            // An error without a message has its status in the headers.
            let call = match code_in(answer.headers()) {
                Some(code) => {
                    call.finish(code);
                    None
                }
                None => Some(call),
            };
            Ok(answer.map(|body| MeteredBody { body, call }))
        })
    }
}

/// A body whose trailers, or whose drop, end the call.
pub struct MeteredBody {
    body: Body,
    call: Option<RpcCall>,
}

impl HttpBody for MeteredBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let frame = Pin::new(&mut self.body).poll_frame(context);
        let code = match &frame {
            Poll::Ready(Some(Ok(frame))) => frame.trailers_ref().map(|trailers| code_in(trailers).unwrap_or("UNKNOWN")),
            Poll::Ready(Some(Err(status))) => Some(code_name(status.code())),
            Poll::Ready(None) => Some("UNKNOWN"),
            Poll::Pending => None,
        };
        if let Some(code) = code
            && let Some(call) = self.call.take()
        {
            call.finish(code);
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}

fn code_in(headers: &HeaderMap) -> Option<&'static str> {
    headers.get("grpc-status").map(|value| code_name(Code::from_bytes(value.as_bytes())))
}

/// The code's name in the gRPC specification.
pub fn code_name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

#[cfg(test)]
mod tests {
    use prost::Message;

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
                    count += 1;
                }
            }
        }
        assert_eq!(count, 12);
        assert_eq!(method_of("/scpsfm.v1.JobService/Invented"), UNKNOWN_METHOD);
    }
}
