//! Remembers whether the server ever answered, so that a connection that worked is not asked whether it is the right
//! one.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use tonic::codegen::http::{Request, Response};
use tower::Service;

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
            // A refusal is an answer too.
            answered.store(true, Ordering::Relaxed);
            Ok(answer)
        })
    }
}

#[cfg(test)]
mod tests {
    use tower::ServiceExt;

    use super::*;

    #[test]
    fn the_first_answer_is_remembered_and_an_error_is_none() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        let flag = Arc::new(AtomicBool::new(false));
        let inner = tower::service_fn(|request: Request<bool>| async move {
            if request.into_body() { Ok(Response::new(())) } else { Err("broken") }
        });
        let service = Answered::new(inner, Arc::clone(&flag));
        for (works, known) in [(false, false), (true, true), (false, true)] {
            let answer = runtime.block_on(service.clone().oneshot(Request::new(works)));
            assert_eq!((answer.is_ok(), flag.load(Ordering::Relaxed)), (works, known));
        }
    }
}
