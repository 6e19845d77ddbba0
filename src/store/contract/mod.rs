//! What every store must do, as tests that each implementation runs through [`store_contract!`].

pub(super) mod admin;
pub(super) mod creation;
pub(super) mod leases;
pub(super) mod reading;
pub(super) mod removal;
pub(super) mod tenants;
pub(super) mod uploads;
pub(super) mod webhooks;

use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use crate::domain::job::{AttemptEnd, EventBody, Failure, Job, JobName, JobState, PastAttempt, Summary};
use crate::domain::{Progress, ReconstructionProgress, SolveSettings, Stage, Status, Step, Task};
use crate::store::postgres::Postgres;
use crate::store::record::{JobInput, NewRecord, Request};
use crate::store::sqlite::Sqlite;
use crate::store::{
    ATTEMPTS_EXHAUSTED, Bound, ChangeReply, Claim, Claimed, EncodedResult, Ending, Error, JobQuery, Lease, Order,
    Outcome, QueueBounds, Store, payload,
};

/// Runs the contract: `$open` is an async function without arguments whose result, where the database is there, derefs
/// to a store that is empty.
macro_rules! store_contract {
    ($open:path) => {
        $crate::store::contract::store_contract!(@each $open;
            creation::a_created_job_reads_back,
            creation::a_request_id_stands_for_one_body_and_one_job,
            creation::one_request_id_from_many_callers_is_one_job,
            creation::a_taken_job_id_is_refused,
            creation::admission_bounds_what_waits,
            leases::claims_go_by_priority_then_age,
            leases::no_job_is_claimed_twice,
            leases::a_prefetched_job_waits_until_it_is_begun,
            leases::a_prefetched_job_is_begun_by_whoever_comes_first,
            leases::large_jobs_and_late_ones_are_not_prefetched,
            leases::a_suspect_is_begun_only_where_nothing_else_runs,
            leases::a_lease_that_was_taken_over_writes_nothing,
            leases::a_success_stores_its_result_then_its_state,
            leases::progress_is_an_event_and_stands_in_the_job,
            leases::every_outcome_ends_in_its_state,
            leases::giving_back_is_free_and_vanishing_is_not,
            leases::a_cancel_ends_what_waits_and_flags_what_runs,
            leases::deadlines_end_what_waits,
            tenants::tenants_take_turns_and_priority_counts_within_one,
            tenants::weights_are_shares,
            tenants::weights_are_shares_where_jobs_are_prefetched,
            tenants::an_idle_tenant_saves_nothing_up,
            tenants::the_running_jobs_of_a_tenant_are_bounded,
            tenants::a_job_that_is_solved_leaves_its_place_before_its_end_is_stored,
            tenants::a_bound_holds_however_many_claim_at_once,
            reading::listings_page_and_filter,
            reading::events_come_in_order_and_in_portions,
            reading::what_does_not_exist_is_not_found,
            reading::operators_see_tenants_the_oldest_job_and_bytes,
            creation::admission_bounds_each_tenant,
            creation::a_batch_is_stored_whole_or_not_at_all,
            creation::a_batch_knows_its_request_ids,
            creation::a_batch_that_never_fits_is_told_so,
            creation::only_a_job_that_its_call_created_depends_on_calls,
            removal::an_ended_job_goes_with_all_that_it_had,
            removal::what_waits_or_runs_is_not_deleted,
            removal::an_etag_is_honoured_and_changes_with_the_job,
            removal::what_ended_long_ago_goes_oldest_first_and_in_portions,
            admin::a_retried_job_begins_anew_and_its_events_go_on,
            admin::a_retry_is_refused_where_there_is_nothing_to_do_or_no_room,
            admin::only_waiting_jobs_get_another_priority,
            admin::a_paused_queue_gives_out_no_job,
            admin::a_report_counts_jobs_by_state_and_tenant,
            uploads::an_upload_goes_on_where_it_ended_and_becomes_an_input,
            uploads::the_latest_stream_has_the_upload,
            uploads::an_upload_id_stands_for_one_length_and_hash,
            uploads::a_tenants_uploads_are_bounded,
            uploads::what_nobody_goes_on_with_is_given_up_and_removed,
            uploads::an_input_lives_as_long_as_a_job_has_it,
            uploads::a_finished_upload_that_is_begun_again_is_kept_as_one_that_is_used,
            uploads::jobs_know_their_uploaded_inputs,
            uploads::inputs_are_listed_page_by_page,
            uploads::a_deleted_input_is_kept_by_its_jobs_alone,
            uploads::a_status_beside_deletions_is_whole_or_none,
            uploads::many_that_begin_at_once_share_the_last_room,
            webhooks::every_end_of_a_job_makes_its_webhook_due,
            webhooks::an_attempt_is_leased_and_settled_once,
            webhooks::a_failed_attempt_is_due_again_later_and_a_last_one_never,
            webhooks::a_retried_job_has_another_end_to_send,
            webhooks::busy_hosts_and_tenants_are_passed_over,
            webhooks::no_delivery_is_claimed_twice,
            webhooks::a_deleted_job_takes_its_webhook_along,
        );
    };
    (@each $open:path; $($part:ident :: $test:ident,)*) => {
        $(
            #[tokio::test]
            async fn $test() {
                let Some(fixture) = $open().await else { return };
                $crate::store::contract::$part::$test(&*fixture).await;
            }
        )*
    };
}
pub(super) use store_contract;

/// Bounds that refuse nothing.
pub(super) const ROOM: QueueBounds = QueueBounds {
    max_jobs: u64::MAX,
    max_bytes: u64::MAX,
    max_observations: u64::MAX,
    max_tenant_jobs: u64::MAX,
    max_tenant_bytes: u64::MAX,
};

const LEASE: Duration = Duration::from_secs(30);
const MAX_ATTEMPTS: u32 = 3;

/// A moment some seconds after a fixed one.
pub(super) fn time(seconds: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000 + seconds)
}

/// A small job of tenant `t`.
pub(super) fn record(job: &str) -> NewRecord {
    NewRecord {
        name: JobName { tenant: "t".into(), job: job.into() },
        request: None,
        input: vec![7; 100].into(),
        view_count: 3,
        track_count: 20,
        observation_count: 60,
        settings: SolveSettings { seed: 5, noise_px: Some(0.5), ..SolveSettings::default() },
        deadline: None,
        priority: 0,
        labels: BTreeMap::new(),
        trace_parent: None,
        cancel_on_disconnect: false,
        webhook_url: None,
    }
}

impl Store {
    /// Stores one job.
    pub(crate) async fn create_job(
        &self,
        new: NewRecord,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<ChangeReply, Error> {
        Ok(self.create_jobs(vec![new], bounds, now).await?.pop().expect("one of one"))
    }
}

impl Claim {
    /// Of the next job alone, where all tenants have equal shares, by a process in which nothing else runs.
    pub(crate) fn one(worker: &str, lease_for: Duration) -> Self {
        Self {
            worker: worker.into(),
            lease_for,
            begin: None,
            prefetch: None,
            shares: Arc::default(),
            solved: Vec::new(),
            suspect_after: None,
        }
    }
}

impl From<Vec<u8>> for JobInput {
    fn from(payload: Vec<u8>) -> Self {
        JobInput::Inline(payload)
    }
}

impl Deref for Sqlite {
    type Target = Store;

    fn deref(&self) -> &Store {
        self
    }
}

impl Deref for Postgres {
    type Target = Store;

    fn deref(&self) -> &Store {
        self
    }
}

async fn create(store: &Store, new: NewRecord, seconds: u64) -> Job {
    store.create_job(new, &ROOM, time(seconds)).await.expect("created").job
}

async fn claim(store: &Store, seconds: u64) -> Claimed {
    store.claim(&Claim::one("worker", LEASE), time(seconds)).await.expect("claims").begun.expect("a job waits")
}

fn progress(iteration: u32) -> Progress {
    Progress {
        stage: Stage::Search,
        fraction: 0.5,
        iteration,
        losses: None,
        head: None,
        inliers: 12,
        focal_px: Some(1234.5),
        best_cost: Some(f64::INFINITY),
        elapsed_seconds: 0.25,
        reconstruction: ReconstructionProgress {
            registered_views: 7,
            views: 9,
            step: Some(Step { task: Task::Adjust, step: 2, steps: 3 }),
            ..ReconstructionProgress::default()
        },
    }
}

fn summary() -> Summary {
    Summary {
        status: Status::NoReconstruction,
        grade: None,
        focal_px: None,
        sigma_log_focal: None,
        inlier_tracks: 0,
        registered_views: 0,
        reprojection_rms_px: None,
        winning_proposal: None,
        iterations: 1,
        seconds: 0.5,
        result_size_bytes: 10,
        warnings: Vec::new(),
    }
}

fn success(result: Vec<u8>) -> Arc<Ending> {
    let result = EncodedResult::new(result);
    Ending { outcome: Outcome::Succeeded { summary: summary(), result }, progress: None }.into()
}

/// The bytes of a job's result, which must be those that were stored.
async fn result_of(store: &Store, name: &JobName) -> Result<Option<Vec<u8>>, Error> {
    let result = store.result(name, u32::MAX).await?;
    assert_eq!(store.result(name, 0).await.as_ref(), Ok(&result), "however large it is said to be");
    assert!(result.as_ref().is_none_or(EncodedResult::is_intact));
    Ok(result.map(|result| result.bytes))
}

/// A job with a label.
pub(super) fn labelled(job: &str) -> NewRecord {
    NewRecord { labels: BTreeMap::from([("site".into(), "north".into())]), ..record(job) }
}

/// The events of a job as `(sequence, attempt, what)`.
async fn story(store: &Store, name: &JobName) -> Vec<(u64, u32, String)> {
    let events = store.events_after(name, 0, 1000).await.expect("events");
    events
        .into_iter()
        .map(|event| {
            assert_eq!(&event.job, name);
            let what = match event.body {
                EventBody::State { state, failure } => {
                    failure.map_or(state.name().into(), |failure| format!("{}:{}", state.name(), failure.reason))
                }
                EventBody::Progress(progress) => format!("progress {}", progress.iteration),
                EventBody::Summary(_) => "summary".into(),
                EventBody::Weights { .. } => "weights".into(),
            };
            (event.sequence.expect("stored events are numbered"), event.attempt, what)
        })
        .collect()
}

fn told(story: &[(u64, u32, &str)]) -> Vec<(u64, u32, String)> {
    story.iter().map(|&(sequence, attempt, what)| (sequence, attempt, what.to_owned())).collect()
}
