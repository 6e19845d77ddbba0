//! Jobs and their events.

use std::collections::BTreeMap;

use super::enums::{Twin, optional_to_wire};
use super::time::{duration_to_wire, seconds_from_wire};
use super::{
    given, optional_time, progress, required, result, settings, size_from_wire, size_to_wire, tellable, time_from_wire,
};
use crate::domain::job::{AttemptEnd, EventBody, Failure, Job, JobEvent, JobName, JobState, PastAttempt, Summary};
use crate::domain::{Grade, InputName, InvalidInput, Proposal, Status, Violation, Webhook, WebhookState};
use crate::rpc::proto;
use proto::job_event::Body;

pub fn to_wire(job: &Job) -> proto::Job {
    proto::Job {
        name: job.name.to_string(),
        state: job.state.to_wire(),
        settings: Some(settings::to_wire(&job.settings)),
        labels: job.labels.clone(),
        priority: job.priority,
        deadline: job.deadline.map(|time| proto::job::Deadline::DeadlineTime(time.into())),
        attempt_count: job.attempt,
        view_count: job.view_count,
        track_count: job.track_count,
        observation_count: job.observation_count,
        create_time: Some(job.create_time.into()),
        start_time: job.start_time.map(Into::into),
        end_time: job.end_time.map(Into::into),
        progress: job.progress.as_ref().map(progress::to_wire),
        last_sequence: job.last_sequence,
        summary: job.summary.as_ref().map(summary_to_wire),
        error: job.failure.as_ref().map(failure_to_wire),
        cancel_requested: job.cancel_requested,
        expire_time: tellable(job.expire_time),
        etag: job.etag(),
        input: job.input.as_ref().map(InputName::to_string).unwrap_or_default(),
        webhook: job.webhook.as_ref().map(webhook_to_wire),
    }
}

/// # Errors
/// Violations that name the fields which no server of this version would send.
pub fn from_wire(job: proto::Job) -> Result<Job, InvalidInput> {
    let deadline = match job.deadline {
        Some(proto::job::Deadline::DeadlineTime(time)) => Some(time_from_wire(time, "deadline_time")?),
        Some(proto::job::Deadline::TimeLimit(_)) => {
            return Err(Violation::of("time_limit", "is an input only, not part of an answer").into());
        }
        None => None,
    };
    Ok(Job {
        name: name_from_wire(&job.name)?,
        state: JobState::required(job.state, "state")?,
        attempt: job.attempt_count,
        settings: settings::from_wire(job.settings)?,
        input: input_from_wire(&job.input)?,
        view_count: job.view_count,
        track_count: job.track_count,
        observation_count: job.observation_count,
        labels: BTreeMap::from_iter(job.labels),
        priority: job.priority,
        create_time: time_from_wire(required(job.create_time, "create_time")?, "create_time")?,
        start_time: optional_time(job.start_time, "start_time")?,
        end_time: optional_time(job.end_time, "end_time")?,
        deadline,
        progress: job.progress.as_ref().map(progress::from_wire).transpose()?.flatten(),
        last_sequence: job.last_sequence,
        summary: job.summary.as_ref().map(summary_from_wire).transpose()?,
        failure: job.error.map(failure_from_wire).transpose()?,
        cancel_requested: job.cancel_requested,
        // Not told: only servers need it.
        attached_calls: None,
        expire_time: optional_time(job.expire_time, "expire_time")?,
        webhook: job.webhook.map(webhook_from_wire).transpose()?,
    })
}

pub fn event_to_wire(event: JobEvent) -> proto::JobEvent {
    let body = match event.body {
        EventBody::State { state, failure } => Body::StateChange(proto::StateChange {
            state: state.to_wire(),
            error: failure.as_ref().map(failure_to_wire),
        }),
        EventBody::Progress(record) => Body::Progress(progress::to_wire(&record)),
        EventBody::Weights { iteration, weights } => Body::Weights(proto::InterimWeights { iteration, weights }),
        EventBody::Summary(summary) => Body::Summary(summary_to_wire(&summary)),
    };
    proto::JobEvent {
        job: event.job.to_string(),
        attempt: event.attempt,
        sequence: event.sequence.unwrap_or(0),
        time: Some(event.time.into()),
        body: Some(body),
    }
}

/// `None`: of a kind, or of progress in a stage, that this version does not know.
///
/// # Errors
/// A violation that names the field which no server of this version would send.
pub fn event_from_wire(event: proto::JobEvent) -> Result<Option<JobEvent>, Violation> {
    let Some(body) = event.body else { return Ok(None) };
    let body = match body {
        Body::StateChange(change) => EventBody::State {
            state: JobState::required(change.state, "state_change.state")?,
            failure: change.error.map(failure_from_wire).transpose()?,
        },
        Body::Progress(record) => match progress::from_wire(&record)? {
            Some(progress) => EventBody::Progress(progress),
            None => return Ok(None),
        },
        Body::Weights(interim) => EventBody::Weights { iteration: interim.iteration, weights: interim.weights },
        Body::Summary(summary) => EventBody::Summary(summary_from_wire(&summary)?),
    };
    Ok(Some(JobEvent {
        job: name_from_wire(&event.job)?,
        attempt: event.attempt,
        sequence: (event.sequence > 0).then_some(event.sequence),
        time: time_from_wire(required(event.time, "time")?, "time")?,
        body,
    }))
}

fn name_from_wire(name: &str) -> Result<JobName, Violation> {
    JobName::parse(name).ok_or_else(|| Violation::of("name", format!("{name:?} is not a job's name")))
}

fn input_from_wire(name: &str) -> Result<Option<InputName>, Violation> {
    if name.is_empty() {
        return Ok(None);
    }
    let parsed = InputName::parse(name);
    parsed.map(Some).ok_or_else(|| Violation::of("input", format!("{name:?} is not an input's name")))
}

fn webhook_to_wire(webhook: &Webhook) -> proto::Webhook {
    proto::Webhook {
        url: webhook.url.clone(),
        state: webhook.state.to_wire(),
        attempt_count: webhook.attempts,
        last_error: webhook.last_error.clone().unwrap_or_default(),
    }
}

fn webhook_from_wire(webhook: proto::Webhook) -> Result<Webhook, Violation> {
    Ok(Webhook {
        url: webhook.url,
        state: WebhookState::required(webhook.state, "webhook.state")?,
        attempts: webhook.attempt_count,
        last_error: given(webhook.last_error),
    })
}

fn failure_to_wire(failure: &Failure) -> proto::JobError {
    let attempts = failure.attempts.iter().map(past_attempt_to_wire).collect();
    proto::JobError { reason: failure.reason.clone(), message: failure.message.clone(), attempts }
}

fn failure_from_wire(error: proto::JobError) -> Result<Failure, Violation> {
    let attempts = error.attempts.into_iter().map(past_attempt_from_wire).collect::<Result<_, _>>()?;
    Ok(Failure { reason: error.reason, message: error.message, attempts })
}

fn past_attempt_to_wire(past: &PastAttempt) -> proto::PastAttempt {
    proto::PastAttempt {
        attempt: past.attempt,
        server: past.server.clone(),
        start_time: Some(past.start_time.into()),
        end_time: Some(past.end_time.into()),
        end: past.end.to_wire(),
    }
}

fn past_attempt_from_wire(past: proto::PastAttempt) -> Result<PastAttempt, Violation> {
    let time = |time, field| time_from_wire(required(time, field)?, field);
    Ok(PastAttempt {
        attempt: past.attempt,
        server: past.server,
        start_time: time(past.start_time, "error.attempts.start_time")?,
        end_time: time(past.end_time, "error.attempts.end_time")?,
        end: AttemptEnd::required(past.end, "error.attempts.end")?,
    })
}

fn summary_to_wire(summary: &Summary) -> proto::JobSummary {
    proto::JobSummary {
        status: summary.status.to_wire(),
        grade: optional_to_wire(summary.grade),
        focal_px: summary.focal_px,
        sigma_log_focal: summary.sigma_log_focal,
        inlier_track_count: summary.inlier_tracks,
        registered_view_count: summary.registered_views,
        reprojection_rms_px: summary.reprojection_rms_px,
        winning_proposal: optional_to_wire(summary.winning_proposal),
        iteration_count: summary.iterations,
        solve_duration: Some(duration_to_wire(summary.seconds)),
        result_size_bytes: size_to_wire(summary.result_size_bytes),
        warnings: result::warnings_to_wire(&summary.warnings),
    }
}

fn summary_from_wire(summary: &proto::JobSummary) -> Result<Summary, Violation> {
    Ok(Summary {
        status: Status::required(summary.status, "summary.status")?,
        grade: Grade::from_wire(summary.grade, "summary.grade")?,
        focal_px: summary.focal_px,
        sigma_log_focal: summary.sigma_log_focal,
        inlier_tracks: summary.inlier_track_count,
        registered_views: summary.registered_view_count,
        reprojection_rms_px: summary.reprojection_rms_px,
        winning_proposal: Proposal::known(summary.winning_proposal),
        iterations: summary.iteration_count,
        seconds: seconds_from_wire(summary.solve_duration, "summary.solve_duration")?,
        result_size_bytes: size_from_wire(summary.result_size_bytes, "summary.result_size_bytes")?,
        warnings: result::warnings_from_wire(&summary.warnings),
    })
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;
    use crate::domain::{Progress, ReconstructionProgress, SolveSettings, Stage, Step, Task, Warning, WarningCode};

    fn name() -> JobName {
        JobName { tenant: "default".into(), job: "a-1".into() }
    }

    fn time(seconds: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::new(1_700_000_000 + seconds, 123_456_789)
    }

    fn summary() -> Summary {
        Summary {
            status: Status::Solved,
            grade: Some(Grade::Metric),
            focal_px: Some(1200.0),
            sigma_log_focal: None,
            inlier_tracks: 20,
            registered_views: 10,
            reprojection_rms_px: Some(0.4),
            winning_proposal: Some(Proposal::Network),
            iterations: 60,
            seconds: 1.25,
            result_size_bytes: 12_345,
            warnings: vec![Warning::new(WarningCode::FewInliers, "three").of_group(2)],
        }
    }

    fn progress() -> Progress {
        Progress {
            stage: Stage::Refine,
            fraction: 0.5,
            iteration: 3,
            losses: None,
            head: None,
            inliers: 4,
            focal_px: None,
            best_cost: Some(0.0),
            elapsed_seconds: 2.0,
            reconstruction: ReconstructionProgress {
                block: 1,
                blocks: 4,
                part: 1,
                registered_views: 7,
                views: 9,
                step: Some(Step { task: Task::Windows, step: 2, steps: 3 }),
            },
        }
    }

    #[test]
    fn jobs_survive_the_wire() {
        let job = Job {
            name: name(),
            state: JobState::Failed,
            attempt: 3,
            settings: SolveSettings { seed: 5, ..SolveSettings::default() },
            input: Some(InputName { tenant: "default".into(), input: "a-1".into() }),
            view_count: 10,
            track_count: 200,
            observation_count: 2000,
            labels: BTreeMap::from([("site".to_owned(), "north 3".to_owned())]),
            priority: -2,
            create_time: time(0),
            start_time: Some(time(1)),
            end_time: Some(time(2)),
            deadline: Some(time(3)),
            progress: Some(progress()),
            last_sequence: 17,
            summary: Some(summary()),
            failure: Some(Failure::new("INTERNAL", "a defect")),
            cancel_requested: true,
            attached_calls: None,
            expire_time: Some(time(4)),
            webhook: Some(Webhook {
                url: "https://hooks.example/a".into(),
                state: WebhookState::GivenUp,
                attempts: 7,
                last_error: Some("the receiver answered 410 Gone".into()),
            }),
        };
        assert_eq!(from_wire(to_wire(&job)), Ok(job.clone()));
        let bare = Job {
            state: JobState::Queued,
            input: None,
            labels: BTreeMap::new(),
            start_time: None,
            end_time: None,
            deadline: None,
            progress: None,
            summary: None,
            failure: None,
            cancel_requested: false,
            expire_time: None,
            webhook: Some(Webhook::pending("http://a")),
            ..job
        };
        assert_eq!(from_wire(to_wire(&bare)), Ok(bare.clone()));
        // As a store may have it that is kept for longer than the calendar lasts.
        let late = Job { expire_time: Some(time(3_000_000 * 86_400)), ..bare.clone() };
        assert_eq!(from_wire(to_wire(&late)), Ok(bare));
    }

    #[test]
    fn events_survive_the_wire() {
        let past = |(attempt, end)| PastAttempt {
            attempt,
            server: format!("host-{attempt}"),
            start_time: time(1),
            end_time: time(2),
            end,
        };
        let attempts = (1..).zip(AttemptEnd::ALL).map(past).collect();
        let failure = Some(Failure { attempts, ..Failure::new("ATTEMPTS_EXHAUSTED", "three attempts") });
        let bodies = [
            (Some(1), EventBody::State { state: JobState::Queued, failure: None }),
            (Some(2), EventBody::Progress(progress())),
            (None, EventBody::Weights { iteration: 5, weights: vec![0.5, 1.0] }),
            (Some(3), EventBody::Summary(summary())),
            (Some(u64::MAX), EventBody::State { state: JobState::Failed, failure }),
        ];
        for (sequence, body) in bodies {
            let event = JobEvent { job: name(), attempt: 1, sequence, time: time(0), body };
            assert_eq!(event_from_wire(event_to_wire(event.clone())), Ok(Some(event)));
        }
    }

    #[test]
    fn events_of_later_versions_are_left_out() {
        let body = EventBody::Progress(progress());
        let event = event_to_wire(JobEvent { job: name(), attempt: 1, sequence: Some(1), time: time(0), body });
        let with = |change: &dyn Fn(&mut proto::Progress)| {
            let mut record = progress::to_wire(&progress());
            change(&mut record);
            let event = proto::JobEvent { body: Some(Body::Progress(record)), ..event.clone() };
            event_from_wire(event).expect("well formed").map(|event| event.body)
        };
        assert_eq!(event_from_wire(proto::JobEvent { body: None, ..event.clone() }), Ok(None));
        assert_eq!(with(&|record| record.stage = 99), None);
        let mut plain = progress();
        plain.reconstruction.step = None;
        let newer_task = with(&|record| record.reconstruction.as_mut().expect("set").task = 99);
        assert_eq!(newer_task, Some(EventBody::Progress(plain)));
    }
}
