//! Remembers whether the server ever answered, so that a connection that worked is not asked whether it is the right
//! one.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use tonic::codegen::http::header::CONTENT_TYPE;
use tonic::codegen::http::{Request, Response};
use tower::Service;

/// How the content type of whatever answers a gRPC call begins (gRPC over HTTP/2, "Responses").
const GRPC_CONTENT: &[u8] = b"application/grpc";

/// A connection that knows whether a call over it was ever answered; its clones know the same.
#[derive(Debug, Clone)]
pub struct Answered<S> {
    inner: S,
    answered: Arc<AtomicBool>,
}

impl<S> Answered<S> {
    /// Sets `answered` at the first answer.
    pub fn new(inner: S, answered: Arc<AtomicBool>) -> Self {
        Self { inner, answered }
    }
}

impl<S, B, A> Service<Request<B>> for Answered<S>
where
    S: Service<Request<B>, Response = Response<A>>,
    S::Future: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<S::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let (answer, answered) = (self.inner.call(request), Arc::clone(&self.answered));
        Box::pin(async move {
            let answer = answer.await?;
            // A refusal is an answer too; a page, as from the port of the metrics, is none.
            if speaks_grpc(&answer) {
                answered.store(true, Ordering::Relaxed);
            }
            Ok(answer)
        })
    }
}

fn speaks_grpc<A>(answer: &Response<A>) -> bool {
    let content = answer.headers().get(CONTENT_TYPE);
    content.is_some_and(|content| content.as_bytes().starts_with(GRPC_CONTENT))
}

#[cfg(test)]
mod tests {
    use tower::ServiceExt;

    use super::*;

    /// What a server does with a call.
    #[derive(Clone, Copy)]
    enum Does {
        Break,
        Answer(&'static str),
    }

    #[test]
    fn the_first_answer_is_remembered_and_neither_an_error_nor_a_page_is_one() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        let flag = Arc::new(AtomicBool::new(false));
        let inner = tower::service_fn(|request: Request<Does>| async move {
            match request.into_body() {
                Does::Break => Err("broken"),
                Does::Answer(content) => {
                    Ok(Response::builder().header(CONTENT_TYPE, content).body(()).expect("a header"))
                }
            }
        });
        let service = Answered::new(inner, Arc::clone(&flag));
        let (page, answer) = (Does::Answer("text/plain"), Does::Answer("application/grpc+proto"));
        for (does, known) in [(Does::Break, false), (page, false), (answer, true), (page, true), (Does::Break, true)] {
            let answered = runtime.block_on(service.clone().oneshot(Request::new(does)));
            assert_eq!((answered.is_err(), flag.load(Ordering::Relaxed)), (matches!(does, Does::Break), known));
        }
    }
}
