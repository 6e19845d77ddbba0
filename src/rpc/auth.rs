//! The layer that finds out whose call it is: before any service sees a request, its key becomes a tenant, a call that
//! the key's scope does not allow is refused, and one that is allowed counts for the key's rate. A call whose key is
//! withdrawn while it lasts ends, in both directions.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http_body::{Body as HttpBody, Frame, SizeHint};
use prost::bytes::Bytes;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::header::{AUTHORIZATION, CONTENT_TYPE};
use tonic::codegen::http::{HeaderMap, Method, Request, Response};
use tower::{Layer, Service};

use super::caller::Tenant;
use super::keys::{Grant, Hash, KeyRing};
use super::listener::ConnectionInfo;
use super::meter::CallRecord;
use super::rates::Rates;
use super::reload::Current;
use super::{meter, status};

/// What needs no key: whoever spreads calls over servers asks for their health, and has no tenant.
const OPEN: &str = "/grpc.health.v1.Health/";

/// How the content type of every call begins (gRPC over HTTP/2, "Requests").
const GRPC: &str = "application/grpc";

/// The layer; goes around every service, and within the one that counts calls.
#[derive(Debug, Clone)]
pub struct Authenticate {
    /// `None`: nobody needs a key, and everyone is of the default tenant.
    keys: Option<Current<KeyRing>>,
    rates: Arc<Rates>,
}

/// Whether a path needs no key: such calls have no tenant and no rate.
pub fn is_open(path: &str) -> bool {
    path.starts_with(OPEN)
}

impl Authenticate {
    pub fn new(keys: Option<Current<KeyRing>>, rates: Arc<Rates>) -> Self {
        Self { keys, rates }
    }

    /// Whether keys are asked for.
    pub fn is_on(&self) -> bool {
        self.keys.is_some()
    }

    /// The tenant of the key that these headers hold; where none is asked for, everyone's.
    ///
    /// # Errors
    /// `UNAUTHENTICATED`.
    pub fn check(&self, headers: &HeaderMap) -> Result<Tenant, Status> {
        self.admit(headers).map(|(tenant, _)| tenant)
    }

    /// Whose call it is, and what it hangs on.
    fn admit(&self, headers: &HeaderMap) -> Result<(Tenant, Option<AcceptedKey>), Status> {
        let Some(keys) = &self.keys else { return Ok((Tenant::default(), None)) };
        let key = Hash::of(bearer(headers)?);
        let mut keys = keys.clone();
        let grant = keys.borrow_and_update().grant_of_hash(&key).cloned();
        let grant = grant.ok_or_else(status::unknown_key)?;
        Ok((Tenant::of(&grant), Some(AcceptedKey { keys, key, grant })))
    }
}

/// A key that was accepted, and what it stood for then.
#[derive(Clone)]
struct AcceptedKey {
    keys: Current<KeyRing>,
    key: Hash,
    grant: Grant,
}

impl AcceptedKey {
    /// Ends when the key does not stand for the same any more; keys that cannot change never end.
    async fn lost(mut self) {
        while self.keys.changed().await.is_ok() {
            if self.keys.borrow_and_update().grant_of_hash(&self.key) != Some(&self.grant) {
                return;
            }
        }
        std::future::pending().await
    }
}

/// Ends with a key.
type Lost = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The frames of one direction of a call, as long as its key stands.
struct Watched {
    body: Body,
    /// `None`: it was lost, and nothing follows.
    lost: Option<Lost>,
    /// An answer ends with a status, a request with an error.
    is_answer: bool,
}

impl Watched {
    fn over(body: Body, accepted: &AcceptedKey, is_answer: bool) -> Body {
        Body::new(Self { body, lost: Some(Box::pin(accepted.clone().lost())), is_answer })
    }
}

impl HttpBody for Watched {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Some(lost) = &mut self.lost else { return Poll::Ready(None) };
        if lost.as_mut().poll(context).is_ready() {
            self.lost = None;
            let status = status::withdrawn_key();
            // An error of an answer's body would reset the stream, and its caller would not learn why.
            return Poll::Ready(Some(match self.is_answer {
                true => Ok(Frame::trailers(status.into_http::<Body>().headers().clone())),
                false => Err(status),
            }));
        }
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.lost.is_none() || self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::default()
    }
}

/// The key that a request carries: `authorization: Bearer KEY` (RFC 6750).
fn bearer(headers: &HeaderMap) -> Result<&str, Status> {
    let mut values = headers.get_all(AUTHORIZATION).iter();
    let value = values.next().ok_or_else(status::no_key)?;
    // Of two, one that checks the first and one that checks the last would disagree.
    if values.next().is_some() {
        return Err(status::no_key());
    }
    let (scheme, key) = value.to_str().ok().and_then(|value| value.split_once(' ')).ok_or_else(status::no_key)?;
    if scheme.eq_ignore_ascii_case("bearer") { Ok(key.trim()) } else { Err(status::no_key()) }
}

/// Marks the connection of someone who may call as authenticated, so that it may stay. What is no call of gRPC says
/// nothing of who it is.
fn mark_authenticated(request: &Request<Body>) {
    let content_type = request.headers().get(CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let is_call = request.method() == Method::POST && content_type.is_some_and(|kind| kind.starts_with(GRPC));
    if let Some(connection_info) = request.extensions().get::<ConnectionInfo>().filter(|_| is_call) {
        connection_info.set_authenticated();
    }
}

impl<S> Layer<S> for Authenticate {
    type Service = Authenticated<S>;

    fn layer(&self, inner: S) -> Authenticated<S> {
        Authenticated { inner, layer: self.clone() }
    }
}

/// A service that knows whose calls it gets.
#[derive(Debug, Clone)]
pub struct Authenticated<S> {
    inner: S,
    layer: Authenticate,
}

impl<S> Service<Request<Body>> for Authenticated<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        if is_open(request.uri().path()) {
            // Where keys are asked for, one who checks the server's health is still unauthenticated.
            if self.layer.keys.is_none() {
                mark_authenticated(&request);
            }
            return Box::pin(self.inner.call(request));
        }
        let (tenant, accepted) = match self.layer.admit(request.headers()) {
            Ok(admitted) => admitted,
            Err(status) => {
                let refusal = status.into_http();
                return Box::pin(async { Ok(refusal) });
            }
        };
        mark_authenticated(&request);
        let key = accepted.as_ref().map(|accepted| &accepted.key);
        if let Some(record) = CallRecord::of(request.extensions()) {
            record.identify(tenant.id(), key.map(Hash::fingerprint));
        }
        // Without keys everyone may do everything.
        let needed = meter::scope_of(request.uri().path());
        let checked = match accepted.as_ref().is_some_and(|accepted| accepted.grant.scope < needed) {
            true => Err(status::scope_missing(needed)),
            false => self.layer.rates.call(key),
        };
        if let Err(status) = checked {
            let refusal = status.into_http();
            return Box::pin(async { Ok(refusal) });
        }
        request.extensions_mut().insert(tenant);
        request.extensions_mut().insert(self.layer.rates.clone());
        // No service needs it any more, and none can let it slip.
        request.headers_mut().remove(AUTHORIZATION);
        let Some(accepted) = accepted else { return Box::pin(self.inner.call(request)) };
        let answer = self.inner.call(request.map(|body| Watched::over(body, &accepted, false)));
        Box::pin(async move {
            let answer = tokio::select! {
                answer = answer => answer?,
                () = accepted.clone().lost() => return Ok(status::withdrawn_key().into_http()),
            };
            Ok(answer.map(|body| Watched::over(body, &accepted, true)))
        })
    }
}

#[cfg(test)]
mod tests {
    use governor::clock::DefaultClock;
    use tokio::sync::watch;
    use tonic::Code;

    use super::*;
    use crate::rpc::rates;

    const KEY: &str = "0123456789abcdef0123456789abcdef";

    fn any_rate() -> Arc<Rates> {
        Arc::new(Rates::new(rates::Options::default(), DefaultClock::default()))
    }

    fn headers(values: &[&str]) -> HeaderMap {
        values.iter().map(|value| (AUTHORIZATION, value.parse().expect("a header"))).collect()
    }

    #[test]
    fn a_key_becomes_its_tenant_and_nothing_else_does() {
        let ring = format!("north:{KEY}").parse().expect("a key");
        let (_sender, keys) = watch::channel(Arc::new(ring));
        let layer = Authenticate::new(Some(keys), any_rate());
        for right in ["Bearer", "bearer", "BEARER"] {
            let (tenant, _) = layer.admit(&headers(&[&format!("{right} {KEY}")])).expect("known");
            assert_eq!(tenant, Tenant::new("north"));
        }
        let bearer = format!("Bearer {KEY}");
        let wrong: [&[&str]; 8] = [
            &[],
            &[""],
            &[KEY],
            &["Bearer"],
            &["Bearer "],
            &[&format!("Basic {KEY}")],
            &[&format!("Bearer {KEY}0")],
            &[&bearer, &bearer],
        ];
        for values in wrong {
            let status = layer.admit(&headers(values)).map(|_| ()).expect_err("refused");
            assert_eq!(status.code(), Code::Unauthenticated, "{values:?}");
            assert!(!status.message().contains(KEY), "{status}");
        }
    }

    #[test]
    fn without_keys_everyone_is_of_the_default_tenant() {
        let (tenant, accepted) = Authenticate::new(None, any_rate()).admit(&headers(&[])).expect("open");
        assert!(tenant == Tenant::default() && accepted.is_none());
    }
}
