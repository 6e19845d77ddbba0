//! What every call goes through, whichever service it is for: it is counted and written down, its key becomes a tenant,
//! its bytes are charged, and a refusal by the transport gets a reason.
//!
//! A call whose key is withdrawn while it lasts ends, in both directions.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use http_body::{Body as HttpBody, Frame};
use prost::bytes::Bytes;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tower::{Layer, Service};

use super::access_log::{OpenCall, RefusalLog};
use super::auth::{Authenticate, CallKey, Lost};
use super::inflight::{Budget, Permit};
use super::message_body::MessageBody;
use super::status;

/// The layer around the services.
#[derive(Debug, Clone)]
pub struct CallLayer {
    pub authenticate: Authenticate,
    pub budget: Arc<Budget>,
    /// Largest message, compressed and decompressed.
    pub max_message_bytes: usize,
    pub refusals: RefusalLog,
}

impl<S> Layer<S> for CallLayer {
    type Service = CallService<S>;

    fn layer(&self, inner: S) -> CallService<S> {
        CallService { inner, layer: self.clone() }
    }
}

/// The services behind the layer.
#[derive(Debug, Clone)]
pub struct CallService<S> {
    inner: S,
    layer: CallLayer,
}

impl<S> Service<Request<Body>> for CallService<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<AnswerBody>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        let CallLayer { authenticate, budget, max_message_bytes, refusals } = &self.layer;
        let call = OpenCall::begin(&request, refusals.clone());
        let record = call.record.clone();
        // A port that reads requests in another form has a permit for them, which goes on.
        let charged = request.extensions().get::<Permit>().cloned();
        let permit = charged.unwrap_or_else(|| Permit::new(Arc::clone(budget)));
        request.extensions_mut().insert(permit.clone());
        let key = match authenticate.admit(&mut request, &record) {
            Ok(key) => key,
            Err(status) => {
                let refusal = AnswerBody::of(status.into_http(), call, CallKey::default().lost(), permit);
                return Box::pin(async { Ok(refusal) });
            }
        };
        let (lost, lost_later) = (key.lost(), key.lost());
        let request = MessageBody::in_place(request, *max_message_bytes, permit.clone(), record, key.lost());
        let answer = self.inner.call(request.map(Body::new));
        Box::pin(async move {
            let answer = tokio::select! {
                answer = answer => answer?,
                () = lost => status::withdrawn_key().into_http(),
            };
            Ok(AnswerBody::of(answer, call, lost_later, permit))
        })
    }
}

/// The frames of an answer, as long as the call's key stands. Its trailers, or its drop, end the call. It holds the
/// permit of what it is made of: a reader that is slow holds it, too.
pub struct AnswerBody {
    body: Body,
    /// `None`: it was lost, and nothing follows.
    lost: Option<Lost>,
    /// `None`: it has ended.
    call: Option<OpenCall>,
    _permit: Permit,
}

impl AnswerBody {
    fn of(mut answer: Response<Body>, call: OpenCall, lost: Lost, permit: Permit) -> Response<Self> {
        add_details(answer.headers_mut());
        // An error without a message has its status in the headers.
        let call = match Status::from_header_map(answer.headers()) {
            Some(status) => {
                call.end(&status);
                None
            }
            None => Some(call),
        };
        answer.map(|body| Self { body, lost: Some(lost), call, _permit: permit })
    }
}

impl HttpBody for AnswerBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Some(lost) = &mut self.lost else { return Poll::Ready(None) };
        let frame = if lost.as_mut().poll(context).is_ready() {
            self.lost = None;
            // An error would reset the stream, and its caller would not learn why.
            let withdrawn = status::withdrawn_key().into_http::<Body>();
            Some(Ok(Frame::trailers(withdrawn.headers().clone())))
        } else {
            ready!(Pin::new(&mut self.body).poll_frame(context))
        };
        let no_status = || Status::unknown("the answer has no status");
        let status = match &frame {
            Some(Ok(frame)) => {
                if let (Some(data), Some(call)) = (frame.data_ref(), &mut self.call) {
                    call.sent_bytes += data.len() as u64;
                }
                frame.trailers_ref().map(|trailers| Status::from_header_map(trailers).unwrap_or_else(no_status))
            }
            Some(Err(status)) => Some(status.clone()),
            None => Some(no_status()),
        };
        if let Some(status) = status
            && let Some(call) = self.call.take()
        {
            call.end(&status);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.lost.is_none() || self.body.is_end_stream()
    }
}

/// Gives the transport's own refusals a reason: a message that is too large or cannot be decoded never reaches a
/// service, so that no service can say what is wrong. Only headers can hold such a status: what is wrong with a request
/// is known before its answer begins.
fn add_details(headers: &mut HeaderMap) {
    if headers.contains_key(Status::GRPC_STATUS_DETAILS) {
        return;
    }
    let Some(detailed) = Status::from_header_map(headers).as_ref().and_then(status::from_transport) else { return };
    // Fails for a sentence that no header can hold, which then stays without details.
    if let Err(error) = detailed.add_header(headers) {
        tracing::warn!(%error, "cannot add details to a refusal of the transport");
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use governor::clock::DefaultClock;
    use http_body_util::StreamBody;
    use metrics_exporter_prometheus::PrometheusBuilder;
    use tonic::Code;
    use tonic::codegen::http::HeaderValue;
    use tonic_types::StatusExt;

    use super::*;
    use crate::rpc::rates::{self, Rates};

    fn layer() -> CallLayer {
        let rates = Arc::new(Rates::new(rates::Options::default(), DefaultClock::default()));
        let authenticate = Authenticate::new(None, rates);
        let (budget, refusals) = (Budget::new(u64::MAX), RefusalLog::default());
        CallLayer { authenticate, budget, max_message_bytes: usize::MAX, refusals }
    }

    fn with_status(code: &'static str) -> HeaderMap {
        HeaderMap::from_iter([("grpc-status".parse().expect("a header"), HeaderValue::from_static(code))])
    }

    /// The code under which a call is counted whose answer has these headers and frames, `read` of which are read.
    fn counted_as(headers: HeaderMap, frames: Vec<Frame<Bytes>>, read: usize) -> String {
        let recorder = PrometheusBuilder::new().build_recorder();
        metrics::with_local_recorder(&recorder, || {
            let frames = futures_util::stream::iter(frames.into_iter().map(Ok::<_, Status>));
            let mut answer = Response::new(Body::new(StreamBody::new(frames)));
            *answer.headers_mut() = headers;
            let mut answer = Some(answer);
            let inner = tower::service_fn(move |_: Request<Body>| {
                let answer = answer.take().expect("called once");
                async { Ok::<_, Infallible>(answer) }
            });
            let request =
                Request::builder().uri("/scpsfm.v1.JobService/GetJob").body(Body::empty()).expect("a request");
            let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
            runtime.block_on(async {
                let Ok(answer) = layer().layer(inner).call(request).await;
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

    fn detailed(found: &Status) -> Status {
        let mut headers = HeaderMap::new();
        found.add_header(&mut headers).expect("a header");
        add_details(&mut headers);
        Status::from_header_map(&headers).expect("a status")
    }

    #[test]
    fn only_what_the_transport_refused_is_explained() {
        let cases = [
            (Code::OutOfRange, Code::OutOfRange, "MESSAGE_TOO_LARGE"),
            (Code::ResourceExhausted, Code::OutOfRange, "MESSAGE_TOO_LARGE"),
            (Code::Internal, Code::InvalidArgument, "MALFORMED_MESSAGE"),
        ];
        for (found, code, reason) in cases {
            let status = detailed(&Status::new(found, "100 % wrong"));
            assert_eq!(status.code(), code);
            assert!(status.message().contains("100 % wrong"), "{status}");
            assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, reason);
        }
        for code in [Code::Ok, Code::Unimplemented, Code::NotFound, Code::Cancelled] {
            let status = detailed(&Status::new(code, "as it was"));
            assert_eq!((status.code(), status.message(), status.details().len()), (code, "as it was", 0));
        }
        let ours = detailed(&status::internal(&"a defect"));
        assert_eq!(ours.code(), Code::Internal);
        assert_eq!(ours.get_details_error_info().expect("an ErrorInfo").reason, "INTERNAL");
        let mut none = HeaderMap::new();
        add_details(&mut none);
        assert!(none.is_empty());
    }
}
