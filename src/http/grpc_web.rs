//! gRPC-Web: calls of gRPC as a browser can make them, over HTTP/1.1 and with the trailers in the body.

use std::future::poll_fn;

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, header};
use tonic_web::GrpcWebLayer;
use tower::{Layer, Service};

use super::answer::Answer;
use crate::rpc::listener::ConnectionInfo;
use crate::rpc::server::Gateway;

/// How the content type of such a call begins; `-text` and `+proto` may follow.
const CONTENT_TYPE: &str = "application/grpc-web";

/// Whether a request is such a call.
pub fn is_call(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
    kind.is_some_and(|kind| kind.starts_with(CONTENT_TYPE))
}

/// Answers a call within the process, behind the layers of every call; `connection_info` is that of its connection.
pub async fn answer(gateway: &Gateway, connection_info: ConnectionInfo, mut request: Request) -> Answer {
    request.extensions_mut().insert(connection_info);
    let mut service = GrpcWebLayer::new().layer(gateway.service.clone());
    // Never fails: the services are always ready.
    let _ = poll_fn(|context| Service::<Request>::poll_ready(&mut service, context)).await;
    match service.call(request).await {
        Ok(answer) => answer.map(Body::new),
        Err(never) => match never {},
    }
}
