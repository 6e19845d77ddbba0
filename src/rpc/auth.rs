//! Whose call it is: before any service sees a request, its key becomes a tenant, a call that the key's scope does not
//! allow is refused, and one that is allowed counts for the key's rate.

use std::pin::Pin;
use std::sync::Arc;

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::header::{AUTHORIZATION, CONTENT_TYPE};
use tonic::codegen::http::{HeaderMap, Method, Request};

use super::access_log::CallRecord;
use super::caller::Caller;
use super::keys::{Grant, Hash, KeyRing};
use super::listener::ConnectionInfo;
use super::rates::Rates;
use super::reload::Current;
use super::{methods, status};

/// What needs no key: whoever spreads calls over servers asks for their health, and has no tenant.
const OPEN: &str = "/grpc.health.v1.Health/";

/// How the content type of every call begins (gRPC over HTTP/2, "Requests").
const GRPC: &str = "application/grpc";

/// Finds out whose a call is.
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

    /// What the key that these headers hold stands for; where none is asked for, what everyone has.
    ///
    /// # Errors
    /// `UNAUTHENTICATED`.
    pub fn check(&self, headers: &HeaderMap) -> Result<Grant, Status> {
        self.identify(headers).map(|(grant, _)| grant)
    }

    /// Lets a call in: tells its services whose it is. Returns the key that it depends on.
    ///
    /// # Errors
    /// `UNAUTHENTICATED`, `PERMISSION_DENIED`, and `RESOURCE_EXHAUSTED` for a rate.
    pub fn admit(&self, request: &mut Request<Body>, record: &Arc<CallRecord>) -> Result<CallKey, Status> {
        if is_open(request.uri().path()) {
            // Where keys are asked for, one who checks the server's health is still unauthenticated.
            if self.keys.is_none() {
                mark_authenticated(request);
            }
            return Ok(CallKey::default());
        }
        let (grant, key) = self.identify(request.headers())?;
        mark_authenticated(request);
        let hash = key.0.as_ref().map(|accepted| &accepted.key);
        record.identify(&grant.tenant, hash.map(Hash::fingerprint));
        // Without keys everyone may do everything.
        let needed = methods::scope_of(request.uri().path());
        if key.0.as_ref().is_some_and(|accepted| accepted.grant.scope < needed) {
            return Err(status::scope_missing(needed));
        }
        self.rates.call(hash)?;
        let caller = Caller::new(grant, request.headers(), self.rates.clone(), record.clone());
        request.extensions_mut().insert(caller);
        // No service needs it any more, and none can let it slip.
        request.headers_mut().remove(AUTHORIZATION);
        Ok(key)
    }

    fn identify(&self, headers: &HeaderMap) -> Result<(Grant, CallKey), Status> {
        let Some(keys) = &self.keys else { return Ok((Grant::default(), CallKey::default())) };
        let key = Hash::of(bearer(headers)?);
        let mut keys = keys.clone();
        let grant = keys.borrow_and_update().grant_of_hash(&key).cloned();
        let grant = grant.ok_or_else(status::unknown_key)?;
        Ok((grant.clone(), CallKey(Some(AcceptedKey { keys, key, grant }))))
    }
}

/// A key that was accepted, and what it stood for then.
#[derive(Clone)]
struct AcceptedKey {
    keys: Current<KeyRing>,
    key: Hash,
    grant: Grant,
}

/// The key that a call depends on, where it has one.
#[derive(Clone, Default)]
pub struct CallKey(Option<AcceptedKey>);

/// Ends with the key of a call.
pub type Lost = Pin<Box<dyn Future<Output = ()> + Send>>;

impl CallKey {
    /// Ends when the key does not stand for the same any more; keys that cannot change never end.
    pub fn lost(&self) -> Lost {
        let accepted = self.0.clone();
        Box::pin(async move {
            if let Some(AcceptedKey { mut keys, key, grant }) = accepted {
                while keys.changed().await.is_ok() {
                    if keys.borrow_and_update().grant_of_hash(&key) != Some(&grant) {
                        return;
                    }
                }
            }
            std::future::pending().await
        })
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
            let (grant, _) = layer.identify(&headers(&[&format!("{right} {KEY}")])).expect("known");
            assert_eq!(grant.tenant, "north");
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
            let status = layer.identify(&headers(values)).map(|_| ()).expect_err("refused");
            assert_eq!(status.code(), Code::Unauthenticated, "{values:?}");
            assert!(!status.message().contains(KEY), "{status}");
        }
    }

    #[test]
    fn without_keys_everyone_is_of_the_default_tenant() {
        let (grant, key) = Authenticate::new(None, any_rate()).identify(&headers(&[])).expect("open");
        assert!(grant == Grant::default() && key.0.is_none());
    }
}
