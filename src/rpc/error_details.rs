//! Gives the transport's own refusals a reason. A message that is too large or cannot be decoded never reaches a
//! service, so that no service can say with [`status`] what is wrong; this layer does, for all of them.

use std::pin::Pin;
use std::task::{Context, Poll};

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tower::{Layer, Service};

use super::status;

/// The layer; goes around every service, and within the one that counts calls.
#[derive(Debug, Clone, Copy, Default)]
pub struct ErrorDetailsLayer;

impl<S> Layer<S> for ErrorDetailsLayer {
    type Service = ErrorDetailsService<S>;

    fn layer(&self, inner: S) -> ErrorDetailsService<S> {
        ErrorDetailsService { inner }
    }
}

/// A service whose refusals all have a reason.
#[derive(Debug, Clone)]
pub struct ErrorDetailsService<S> {
    inner: S,
}

impl<S, B> Service<Request<B>> for ErrorDetailsService<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let answer = self.inner.call(request);
        Box::pin(async move {
            let mut answer = answer.await?;
            add_details(answer.headers_mut());
            Ok(answer)
        })
    }
}

/// Replaces a status that the transport made. Only headers can hold one: what is wrong with a request is known before
/// its answer begins.
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
    use tonic::Code;
    use tonic_types::StatusExt;

    use super::*;

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
