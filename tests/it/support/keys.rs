//! Keys of tenants, and clients that send them.

use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Request, Status};

pub const NORTH: &str = "north0123456789abcdef0123456789abcdef";
pub const SOUTH: &str = "south0123456789abcdef0123456789abcdef";

/// Sends a key, in a header that is not marked as a secret, as other clients do.
#[derive(Clone)]
pub struct Key(pub &'static str);

impl Interceptor for Key {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        request.metadata_mut().insert("authorization", format!("Bearer {}", self.0).parse().expect("a header"));
        Ok(request)
    }
}

pub type Keyed = InterceptedService<Channel, Key>;

pub fn keyed(channel: &Channel, key: &'static str) -> Keyed {
    InterceptedService::new(channel.clone(), Key(key))
}
