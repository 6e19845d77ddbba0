//! Logs and traces: how they are written, and every span's name and fields.
//!
//! A job is one trace: `submit`, `queue`, `attempt` (one or several) and the attempt's stages, all under the trace
//! context that the caller sent. The job's record keeps the context as a W3C `traceparent`, so a restart, another
//! replica or a second attempt continues the same trace.
//!
//! The spans have level ERROR: a log filter decides which lines are written, and must not take the job's name from
//! the lines that remain.

use std::collections::HashMap;
use std::io::IsTerminal;
use std::time::SystemTime;

use opentelemetry::propagation::TextMapPropagator;
use opentelemetry::trace::{Span as _, SpanKind, TraceContextExt, Tracer, TracerProvider};
use opentelemetry::{Context, KeyValue, global};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use serde::{Deserialize, Serialize};
use tracing::{Span, error_span, field};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::{EnvFilter, Layer, Registry};

use super::otlp::{Export, SCOPE};
use crate::domain::Stage;
use crate::domain::job::JobName;

/// Target of the access log: one line a call.
pub const ACCESS: &str = "scpsfm::access";
/// Target of refused calls.
pub const REFUSED: &str = "scpsfm::refused";

/// Target of the audit log: who created, cancelled, deleted or uploaded what. Always written.
pub const AUDIT: &str = "scpsfm::audit";

/// How log lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// For eyes.
    #[default]
    Human,
    /// One JSON object a line, with the fields of the spans it stands in.
    Json,
}

/// What to log and where traces go.
#[derive(Debug, Clone, Copy)]
pub struct Options<'a> {
    pub format: Format,
    /// `tracing-subscriber`'s filter syntax: `info`, `info,scpsfm::engine=debug`.
    pub filter: &'a str,
    /// Whether the access log is written.
    pub access: bool,
    /// Where traces go; `None` exports none.
    pub export: Option<&'a Export>,
}

/// Why logging or tracing could not begin.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("log.filter: {0}")]
    Filter(#[from] tracing_subscriber::filter::ParseError),
    #[error("logging was already set up in this process")]
    AlreadySet,
}

/// Sets up logs (on stderr) and traces for the whole process.
///
/// # Errors
/// See [`Error`].
pub fn init(options: Options<'_>) -> Result<(), Error> {
    let ansi = std::io::stderr().is_terminal();
    let subscriber = build(options, std::io::stderr, ansi)?;
    tracing::subscriber::set_global_default(subscriber).map_err(|_| Error::AlreadySet)
}

/// The subscriber of [`init`], writing its lines to `writer`.
fn build<W>(options: Options<'_>, writer: W, ansi: bool) -> Result<impl tracing::Subscriber + use<W>, Error>
where
    W: for<'w> MakeWriter<'w> + Send + Sync + 'static,
{
    let lines = tracing_subscriber::fmt::layer().with_writer(writer).with_ansi(ansi);
    let lines = match options.format {
        Format::Human => lines.boxed(),
        Format::Json => lines.json().flatten_event(true).boxed(),
    };
    let export = options.export.map(|export| {
        let provider = export.traces();
        global::set_tracer_provider(provider.clone());
        tracing_opentelemetry::layer()
            .with_tracer(provider.tracer(SCOPE))
            .with_filter(Targets::new().with_target(SCOPE, LevelFilter::INFO))
    });
    let access = if options.access { LevelFilter::INFO } else { LevelFilter::OFF };
    let filter = EnvFilter::try_new(options.filter)?
        .add_directive(format!("{ACCESS}={access}").parse()?)
        .add_directive(format!("{AUDIT}=info").parse()?);
    Ok(Registry::default().with(export).with(lines.with_filter(filter)))
}

/// The trace context that a `traceparent` header states; an empty one for none or a malformed one, as W3C asks.
pub fn parent_context(traceparent: Option<&str>) -> Context {
    let carrier: HashMap<String, String> =
        traceparent.map(|value| ("traceparent".to_owned(), value.to_owned())).into_iter().collect();
    // From an empty context, not the current one: a job's spans never hang under whatever runs it.
    TraceContextPropagator::new().extract_with_context(&Context::new(), &carrier)
}

/// Puts a new span, not yet entered, under the trace that a `traceparent` states.
pub fn set_parent(span: &Span, traceparent: Option<&str>) {
    // The only failures are that nothing is exported or that a filter disabled the span: no trace to be part of.
    let _ = span.set_parent(parent_context(traceparent));
}

/// The `traceparent` of a span; `None` where nothing is exported.
pub fn traceparent_of(span: &Span) -> Option<String> {
    traceparent(&span.context())
}

fn traceparent(context: &Context) -> Option<String> {
    let span = context.span();
    let span = span.span_context();
    let sampled = u8::from(span.is_sampled());
    span.is_valid().then(|| format!("00-{}-{}-{sampled:02x}", span.trace_id(), span.span_id()))
}

/// The `traceparent` to keep with a job: the submit span's, or the caller's own where this server exports nothing,
/// so that one that does may continue the trace.
pub fn traceparent_to_store(submit: &Span, caller: Option<&str>) -> Option<String> {
    traceparent_of(submit).or_else(|| traceparent(&parent_context(caller)))
}

/// The call that creates a job, under the caller's trace. [`record_job`] tells its name once there is one.
pub fn submit_span(method: &'static str, traceparent: Option<&str>) -> Span {
    let span = error_span!(
        target: SCOPE, parent: None, "submit",
        otel.kind = "server", rpc.method = method, job = field::Empty
    );
    set_parent(&span, traceparent);
    span
}

/// Tells a submit span the name of the job it created.
pub fn record_job(submit: &Span, job: &JobName) {
    submit.record("job", field::display(job));
}

/// Exports the wait in the queue, known only once it is over: nothing of it is lost when the server restarts.
pub fn queue_span(job: &JobName, traceparent: Option<&str>, enqueued_at: SystemTime, claimed_at: SystemTime) {
    let tracer = global::tracer(SCOPE);
    let mut span = tracer
        .span_builder("queue")
        .with_kind(SpanKind::Internal)
        .with_start_time(enqueued_at)
        .with_attributes([KeyValue::new("job", job.to_string())])
        .start_with_context(&tracer, &parent_context(traceparent));
    span.end_with_timestamp(claimed_at);
}

/// One attempt at a job, under the trace that the job's record keeps.
pub fn attempt_span(job: &JobName, attempt: u32, traceparent: Option<&str>) -> Span {
    let span = error_span!(
        target: SCOPE, parent: None, "attempt",
        job = %job, attempt, outcome = field::Empty, otel.status_code = field::Empty
    );
    set_parent(&span, traceparent);
    span
}

/// One stage of an attempt.
pub fn stage_span(attempt: &Span, stage: Stage) -> Span {
    error_span!(target: SCOPE, parent: attempt, "stage", otel.name = stage.name(), stage = stage.name())
}

#[cfg(test)]
mod tests;
