//! The layer that finds out whose call it is: before any service sees a request, its key becomes a tenant.

use std::pin::Pin;
use std::task::{Context, Poll};

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::header::AUTHORIZATION;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tower::{Layer, Service};

use super::caller::Tenant;
use super::keys::KeyRing;
use super::reload::Current;
use super::status;

/// What needs no key: whoever spreads calls over servers asks for their health, and has no tenant.
const OPEN: &str = "/grpc.health.v1.Health/";

/// The layer; goes around every service, and within the one that counts calls.
#[derive(Debug, Clone)]
pub struct Authenticate {
    /// `None`: nobody needs a key, and everyone is of the default tenant.
    keys: Option<Current<KeyRing>>,
}

impl Authenticate {
    pub fn new(keys: Option<Current<KeyRing>>) -> Self {
        Self { keys }
    }

    fn tenant(&self, headers: &HeaderMap) -> Result<Tenant, Status> {
        let Some(keys) = &self.keys else { return Ok(Tenant::default()) };
        let key = bearer(headers)?;
        let keys = keys.borrow();
        keys.tenant_of(key).map(Tenant::new).ok_or_else(status::unknown_key)
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

impl<S, B> Service<Request<B>> for Authenticated<S>
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

    fn call(&mut self, mut request: Request<B>) -> Self::Future {
        if !request.uri().path().starts_with(OPEN) {
            match self.layer.tenant(request.headers()) {
                Ok(tenant) => drop(request.extensions_mut().insert(tenant)),
                Err(status) => {
                    let refusal = status.into_http();
                    return Box::pin(async { Ok(refusal) });
                }
            }
            // No service needs it any more, and none can let it slip.
            request.headers_mut().remove(AUTHORIZATION);
        }
        Box::pin(self.inner.call(request))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::sync::watch;
    use tonic::Code;

    use super::*;

    const KEY: &str = "0123456789abcdef0123456789abcdef";

    fn headers(values: &[&str]) -> HeaderMap {
        values.iter().map(|value| (AUTHORIZATION, value.parse().expect("a header"))).collect()
    }

    #[test]
    fn a_key_becomes_its_tenant_and_nothing_else_does() {
        let ring = format!("north:{KEY}").parse().expect("a key");
        let (_sender, keys) = watch::channel(Arc::new(ring));
        let layer = Authenticate::new(Some(keys));
        for right in ["Bearer", "bearer", "BEARER"] {
            let tenant = layer.tenant(&headers(&[&format!("{right} {KEY}")])).expect("known");
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
            let status = layer.tenant(&headers(values)).expect_err("refused");
            assert_eq!(status.code(), Code::Unauthenticated, "{values:?}");
            assert!(!status.message().contains(KEY), "{status}");
        }
    }

    #[test]
    fn without_keys_everyone_is_of_the_default_tenant() {
        assert_eq!(Authenticate::new(None).tenant(&headers(&[])).expect("open"), Tenant::default());
    }
}
