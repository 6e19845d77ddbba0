//! What a caller says of a job beside its input.

use std::collections::BTreeMap;

use super::{given, positive_duration, settings, time_from_wire};
use crate::domain::error::Violations;
use crate::domain::{InvalidInput, Violation, Webhook};
use crate::engine::{Deadline, JobDescription};
use crate::rpc::proto;
use proto::job::Deadline as WireDeadline;

/// Labels of one job: enough to find it again, too few to be a database.
const MAX_LABELS: usize = 64;
/// Longest label key and value in bytes; the key's bound is that of a resource id.
const MAX_LABEL_KEY: usize = 63;
const MAX_LABEL_VALUE: usize = 255;
/// Largest priority, and the smallest below 0: a few classes with room between them.
pub const MAX_PRIORITY: i32 = 1_000;
/// Longest request id: a UUID has 36 characters.
const MAX_REQUEST_ID: usize = 128;

/// Reads and checks everything but parent and input. Fields of the job that are the server's are ignored.
///
/// # Errors
/// Every violation found.
pub fn from_wire(job_id: String, request_id: String, job: Option<proto::Job>) -> Result<JobDescription, InvalidInput> {
    let job = job.unwrap_or_default();
    let settings = settings::from_wire(job.settings)?;
    let deadline = job.deadline.map(deadline_from_wire).transpose()?;
    let mut found = Violations::default();
    check_labels(&job.labels, &mut found);
    if let Err(violation) = check_priority(job.priority, "job.priority") {
        found.push(violation);
    }
    if request_id.len() > MAX_REQUEST_ID || !request_id.bytes().all(|byte| byte.is_ascii_graphic()) {
        let text = format!("is not 1 to {MAX_REQUEST_ID} visible ASCII characters; a UUID is");
        found.push(Violation::of("request_id", text));
    }
    let webhook_url = job.webhook.map(|webhook| webhook.url);
    if let Some(Err(error)) = webhook_url.as_deref().map(Webhook::parse_url) {
        found.push(Violation::of("job.webhook.url", error));
    }
    found.into_result()?;
    Ok(JobDescription {
        job_id: given(job_id),
        request_id: given(request_id),
        settings,
        labels: BTreeMap::from_iter(job.labels),
        priority: job.priority,
        deadline,
        webhook_url,
    })
}

/// Whether a job may have this priority, which stands in that field.
///
/// # Errors
/// That it is out of range.
pub fn check_priority(priority: i32, field: &str) -> Result<(), Violation> {
    match (-MAX_PRIORITY..=MAX_PRIORITY).contains(&priority) {
        true => Ok(()),
        false => Err(Violation::of(field, format!("{priority} is not in -{MAX_PRIORITY}..={MAX_PRIORITY}"))),
    }
}

fn check_labels(labels: &BTreeMap<String, String>, found: &mut Violations) {
    if labels.len() > MAX_LABELS {
        found.push(Violation::of("job.labels", format!("{} labels are above the limit of {MAX_LABELS}", labels.len())));
    }
    for (key, value) in labels.iter().take(MAX_LABELS) {
        if key.is_empty() || key.len() > MAX_LABEL_KEY {
            let text = format!("the key {:?} is not 1 to {MAX_LABEL_KEY} bytes", shortened(key));
            found.push(Violation::of("job.labels", text));
        }
        // A text of PostgreSQL's cannot hold it.
        if key.contains('\0') || value.contains('\0') {
            found.push(Violation::of("job.labels", format!("{:?} or its value holds a NUL", shortened(key))));
        }
        if value.len() > MAX_LABEL_VALUE {
            let text = format!("the value of {:?} is longer than {MAX_LABEL_VALUE} bytes", shortened(key));
            found.push(Violation::of("job.labels", text));
        }
    }
}

/// So much of a key as an error may repeat.
fn shortened(key: &str) -> String {
    key.chars().take(MAX_LABEL_KEY).collect()
}

fn deadline_from_wire(deadline: WireDeadline) -> Result<Deadline, Violation> {
    match deadline {
        WireDeadline::DeadlineTime(time) => Ok(Deadline::At(time_from_wire(time, "job.deadline_time")?)),
        WireDeadline::TimeLimit(limit) => Ok(Deadline::After(positive_duration(limit, "job.time_limit")?)),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn described(job: proto::Job) -> Result<JobDescription, Vec<String>> {
        from_wire(String::new(), "r-1".into(), Some(job))
            .map_err(|error| error.violations().iter().map(Violation::path).collect())
    }

    fn limit(seconds: i64) -> Option<WireDeadline> {
        Some(WireDeadline::TimeLimit(prost_types::Duration { seconds, nanos: 0 }))
    }

    #[test]
    fn an_empty_description_is_all_defaults() {
        let description = from_wire(String::new(), String::new(), None).expect("valid");
        assert_eq!(description.settings, crate::domain::SolveSettings::default());
        assert_eq!((description.job_id, description.request_id, description.deadline), (None, None, None));
    }

    #[test]
    fn deadlines_come_as_a_time_or_as_a_duration() {
        let after = described(proto::Job { deadline: limit(90), ..Default::default() }).expect("valid");
        assert_eq!(after.deadline, Some(Deadline::After(Duration::from_secs(90))));
        let time = prost_types::Timestamp { seconds: 1_800_000_000, nanos: 0 };
        let at = described(proto::Job { deadline: Some(WireDeadline::DeadlineTime(time)), ..Default::default() });
        let expected = std::time::UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        assert_eq!(at.expect("valid").deadline, Some(Deadline::At(expected)));
    }

    #[test]
    fn what_is_out_of_bounds_is_named() {
        let wrong = |job| described(job).expect_err("invalid");
        assert_eq!(wrong(proto::Job { priority: 1001, ..Default::default() }), ["job.priority"]);
        assert_eq!(wrong(proto::Job { deadline: limit(0), ..Default::default() }), ["job.time_limit"]);
        assert_eq!(wrong(proto::Job { deadline: limit(-5), ..Default::default() }), ["job.time_limit"]);
        assert_eq!(wrong(proto::Job { deadline: limit(i64::MAX), ..Default::default() }), ["job.time_limit"]);
        let time = prost_types::Timestamp { seconds: 1_800_000_000, nanos: -1 };
        let deadline = Some(WireDeadline::DeadlineTime(time));
        assert_eq!(wrong(proto::Job { deadline, ..Default::default() }), ["job.deadline_time"]);
        let labels = BTreeMap::from([("k".repeat(64), String::new()), ("v".into(), "x".repeat(256))]);
        assert_eq!(wrong(proto::Job { labels, ..Default::default() }), ["job.labels", "job.labels"]);
        let many = (0..65).map(|k| (k.to_string(), String::new())).collect();
        assert_eq!(wrong(proto::Job { labels: many, ..Default::default() }), ["job.labels"]);
        for url in ["", "ftp://a", "https://a/#b"] {
            let webhook = Some(proto::Webhook { url: url.into(), ..Default::default() });
            assert_eq!(wrong(proto::Job { webhook, ..Default::default() }), ["job.webhook.url"]);
        }
        let error = from_wire(String::new(), "a b".into(), None).expect_err("a space");
        assert_eq!(error.violations()[0].field, "request_id");
    }
}
