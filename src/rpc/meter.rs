//! Counts every call by method and status code, from the request's headers to the last byte of its answer.

use std::pin::Pin;
use std::task::{Context, Poll};

use http_body::{Body as HttpBody, Frame};
use prost::bytes::Bytes;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::{Code, Status};
use tower::{Layer, Service};

use super::keys::Scope::{self, Admin, Ordinary, ReadOnly};
use crate::telemetry::metrics::{RpcCall, UNKNOWN_METHOD};

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

fn method_of(path: &str) -> &'static str {
    find(path).map_or(UNKNOWN_METHOD, |(method, _)| method)
}

/// The scope that a key needs for the method at this path. What is not listed is reflection, or is not there, which its
/// caller is told by `UNIMPLEMENTED`.
pub fn scope_of(path: &str) -> Scope {
    find(path).map_or(Scope::ReadOnly, |(_, scope)| scope)
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
    use std::collections::VecDeque;
    use std::convert::Infallible;

    use metrics_exporter_prometheus::PrometheusBuilder;
    use prost::Message;
    use tonic::codegen::http::HeaderValue;

    use super::*;
    use crate::rpc::proto::FILE_DESCRIPTOR_SET;

    /// A body of given frames.
    struct Frames(VecDeque<Frame<Bytes>>);

    impl HttpBody for Frames {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            _context: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.pop_front().map(Ok))
        }
    }

    fn with_status(code: &'static str) -> HeaderMap {
        HeaderMap::from_iter([("grpc-status".parse().expect("a header"), HeaderValue::from_static(code))])
    }

    /// The code under which a call is counted whose answer has these headers and frames, `read` of which are read.
    fn counted_as(headers: HeaderMap, frames: Vec<Frame<Bytes>>, read: usize) -> String {
        let recorder = PrometheusBuilder::new().build_recorder();
        metrics::with_local_recorder(&recorder, || {
            let mut answer = Response::new(Body::new(Frames(frames.into())));
            *answer.headers_mut() = headers;
            let mut answer = Some(answer);
            let inner = tower::service_fn(move |_: Request<()>| {
                let answer = answer.take().expect("called once");
                async { Ok::<_, Infallible>(answer) }
            });
            let request = Request::builder().uri("/scpsfm.v1.JobService/GetJob").body(()).expect("a request");
            let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
            runtime.block_on(async {
                let Ok(answer) = Meter.layer(inner).call(request).await;
                let mut body = answer.into_body();
                for _ in 0..read {
                    std::future::poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await;
                }
            });
        });
        let page = recorder.handle().render();
        let counts: Vec<&str> = page.lines().filter(|line| line.starts_with("scpsfm_grpc_requests_total{")).collect();
        let [count] = counts[..] else { panic!("not one count:\n{page}") };
        assert!(count.contains("JobService/GetJob") && count.ends_with(" 1"), "{count}");
        let (_, rest) = count.split_once("code=\"").expect("a code");
        rest.split('"').next().expect("a value").to_owned()
    }

    #[test]
    fn a_call_is_counted_once_by_how_it_ended() {
        let data = || Frame::data(Bytes::from_static(b"message"));
        assert_eq!(counted_as(with_status("5"), vec![], 0), "NOT_FOUND");
        assert_eq!(counted_as(HeaderMap::new(), vec![data(), Frame::trailers(with_status("0"))], 2), "OK");
        assert_eq!(
            counted_as(HeaderMap::new(), vec![data(), Frame::trailers(with_status("8"))], 3),
            "RESOURCE_EXHAUSTED"
        );
        assert_eq!(counted_as(HeaderMap::new(), vec![data()], 2), "UNKNOWN");
        assert_eq!(counted_as(HeaderMap::new(), vec![data(), data()], 1), "CANCELLED");
    }

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
