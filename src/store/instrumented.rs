//! A store that measures how long each of its operations took and counts which came too late, whatever implements it.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use super::{
    BegunUpload, CancelReply, Claim, Claims, Created, EncodedResult, Ending, Error, Heartbeat, InputPage, InputQuery,
    JobPage, JobPayload, JobQuery, Lease, NewInput, NewRecord, NewUpload, Notification, PassedOver, PurgedUploads,
    QueueBounds, QueueReport, QueueStats, Request, RetryReply, Store, StoreStats, StoredInput, Swept, UploadBounds,
    UploadLease, UploadStatus, WebhookOutcome, WebhookQueue,
};
use crate::domain::InputName;
use crate::domain::job::{Job, JobEvent, JobName};
use crate::domain::progress::Progress;
use crate::telemetry::metrics::{store_operation, write_fenced};

/// Times every operation of the store inside. Failed operations count too: a slow failure is still slow. Writes that
/// were refused because the lease was gone are counted.
#[derive(Debug)]
pub struct InstrumentedStore<S>(pub S);

/// Counts a write that came too late.
fn counted<T>(operation: &'static str, result: Result<T, Error>) -> Result<T, Error> {
    if let Err(Error::Fenced(_)) = &result {
        write_fenced(operation);
    }
    result
}

#[async_trait::async_trait]
impl<S: Store> Store for InstrumentedStore<S> {
    async fn create_jobs(
        &self,
        new: Vec<NewRecord>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<Vec<Created>, Error> {
        let _timer = store_operation("create_jobs");
        self.0.create_jobs(new, bounds, now).await
    }

    async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        let _timer = store_operation("requested_job");
        self.0.requested_job(tenant, request).await
    }

    async fn job(&self, name: &JobName) -> Result<Job, Error> {
        let _timer = store_operation("job");
        self.0.job(name).await
    }

    async fn jobs(&self, query: &JobQuery) -> Result<JobPage, Error> {
        let _timer = store_operation("jobs");
        self.0.jobs(query).await
    }

    async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        let _timer = store_operation("events_after");
        self.0.events_after(name, after, limit).await
    }

    async fn claim(&self, claim: &Claim, now: SystemTime) -> Result<Claims, Error> {
        let _timer = store_operation("claim");
        self.0.claim(claim, now).await
    }

    async fn job_payload(&self, name: &JobName) -> Result<JobPayload, Error> {
        let _timer = store_operation("work");
        self.0.job_payload(name).await
    }

    async fn heartbeat(&self, lease: &Lease, now: SystemTime, lease_for: Duration) -> Result<Heartbeat, Error> {
        let _timer = store_operation("heartbeat");
        counted("heartbeat", self.0.heartbeat(lease, now, lease_for).await)
    }

    async fn record(&self, lease: &Lease, progress: &Progress, now: SystemTime) -> Result<u64, Error> {
        let _timer = store_operation("record");
        counted("record", self.0.record(lease, progress, now).await)
    }

    async fn finish(&self, lease: &Lease, ending: &Arc<Ending>, now: SystemTime) -> Result<Job, Error> {
        let _timer = store_operation("finish");
        counted("finish", self.0.finish(lease, ending, now).await)
    }

    async fn release(&self, lease: &Lease, now: SystemTime) -> Result<Job, Error> {
        let _timer = store_operation("release");
        counted("release", self.0.release(lease, now).await)
    }

    async fn request_cancel(&self, name: &JobName, etag: Option<&str>, now: SystemTime) -> Result<CancelReply, Error> {
        let _timer = store_operation("request_cancel");
        self.0.request_cancel(name, etag, now).await
    }

    async fn retry_job(
        &self,
        name: &JobName,
        etag: Option<&str>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<RetryReply, Error> {
        let _timer = store_operation("retry_job");
        self.0.retry_job(name, etag, bounds, now).await
    }

    async fn set_priority(&self, name: &JobName, etag: Option<&str>, priority: i32) -> Result<Job, Error> {
        let _timer = store_operation("set_priority");
        self.0.set_priority(name, etag, priority).await
    }

    async fn set_paused(&self, paused: bool, now: SystemTime) -> Result<(), Error> {
        let _timer = store_operation("set_paused");
        self.0.set_paused(paused, now).await
    }

    async fn queue(&self, tenants: u32) -> Result<QueueReport, Error> {
        let _timer = store_operation("queue");
        self.0.queue(tenants).await
    }

    async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        let _timer = store_operation("detach");
        self.0.detach(name, created).await
    }

    async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        let _timer = store_operation("delete_job");
        self.0.delete_job(name, etag).await
    }

    async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
        let _timer = store_operation("purge");
        self.0.purge(ended_by, limit).await
    }

    async fn reclaim(&self) -> Result<(), Error> {
        let _timer = store_operation("reclaim");
        self.0.reclaim().await
    }

    async fn recover(&self, now: SystemTime, max_attempts: u32) -> Result<Vec<Job>, Error> {
        let _timer = store_operation("recover");
        self.0.recover(now, max_attempts).await
    }

    async fn sweep(&self, now: SystemTime, max_attempts: u32) -> Result<Swept, Error> {
        let _timer = store_operation("sweep");
        self.0.sweep(now, max_attempts).await
    }

    async fn result(&self, name: &JobName) -> Result<Option<EncodedResult>, Error> {
        let _timer = store_operation("result");
        self.0.result(name).await
    }

    async fn begin_upload(
        &self,
        new: &NewUpload,
        bounds: &UploadBounds,
        now: SystemTime,
    ) -> Result<BegunUpload, Error> {
        let _timer = store_operation("begin_upload");
        self.0.begin_upload(new, bounds, now).await
    }

    async fn append_upload(
        &self,
        lease: &UploadLease,
        at_byte: u64,
        data: &[u8],
        now: SystemTime,
    ) -> Result<(), Error> {
        let _timer = store_operation("append_upload");
        self.0.append_upload(lease, at_byte, data, now).await
    }

    async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
        let _timer = store_operation("read_upload");
        self.0.read_upload(lease, at_byte).await
    }

    async fn finish_upload(
        &self,
        lease: &UploadLease,
        new: &Arc<NewInput>,
        now: SystemTime,
    ) -> Result<StoredInput, Error> {
        let _timer = store_operation("finish_upload");
        self.0.finish_upload(lease, new, now).await
    }

    async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error> {
        let _timer = store_operation("give_up_upload");
        self.0.give_up_upload(lease).await
    }

    async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error> {
        let _timer = store_operation("upload");
        self.0.upload(name).await
    }

    async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error> {
        let _timer = store_operation("uploaded_input");
        self.0.uploaded_input(name).await
    }

    async fn inputs(&self, query: &InputQuery) -> Result<InputPage, Error> {
        let _timer = store_operation("inputs");
        self.0.inputs(query).await
    }

    async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        let _timer = store_operation("delete_input");
        self.0.delete_input(name).await
    }

    async fn purge_uploads(
        &self,
        abandoned_by: Option<SystemTime>,
        unused_since: Option<SystemTime>,
    ) -> Result<PurgedUploads, Error> {
        let _timer = store_operation("purge_uploads");
        self.0.purge_uploads(abandoned_by, unused_since).await
    }

    async fn queue_stats(&self) -> Result<QueueStats, Error> {
        let _timer = store_operation("load");
        self.0.queue_stats().await
    }

    async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error> {
        let _timer = store_operation("webhook_queue");
        self.0.webhook_queue(now).await
    }

    async fn claim_webhook(
        &self,
        passed: &PassedOver,
        now: SystemTime,
        lease_for: Duration,
    ) -> Result<Option<Job>, Error> {
        let _timer = store_operation("claim_webhook");
        self.0.claim_webhook(passed, now, lease_for).await
    }

    async fn settle_webhook(&self, claimed: &Job, outcome: &WebhookOutcome, now: SystemTime) -> Result<bool, Error> {
        let _timer = store_operation("settle_webhook");
        self.0.settle_webhook(claimed, outcome, now).await
    }

    async fn stats(&self) -> Result<StoreStats, Error> {
        let _timer = store_operation("stats");
        self.0.stats().await
    }

    fn is_shared(&self) -> bool {
        self.0.is_shared()
    }

    fn has_room(&self) -> bool {
        self.0.has_room()
    }

    /// Not measured: it waits for others.
    async fn notification(&self) -> Notification {
        self.0.notification().await
    }

    async fn close(&self) {
        let _timer = store_operation("close");
        self.0.close().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::contract;
    use crate::store::sqlite::Sqlite;
    use crate::telemetry::metrics::tests::page_after;
    use crate::telemetry::scrape::Page;

    #[test]
    fn writes_that_come_too_late_are_counted() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let late = async {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let store = InstrumentedStore(Sqlite::open(directory.path()).await.expect("opens"));
            store.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
            let claim = Claim::one("w", Duration::from_secs(1));
            let claims = store.claim(&claim, contract::time(0)).await.expect("claims");
            let lease = claims.begun.expect("a job").lease;
            store.heartbeat(&lease, contract::time(0), Duration::from_secs(1)).await.expect("holds");
            store.sweep(contract::time(2), 3).await.expect("takes it back");
            store.heartbeat(&lease, contract::time(3), Duration::from_secs(1)).await.expect_err("too late");
            store.release(&lease, contract::time(3)).await.expect_err("too late");
        };
        let page = Page::parse(&page_after(|| runtime.block_on(late)));
        for (operation, count) in [("heartbeat", 1.0), ("release", 1.0), ("finish", 0.0), ("record", 0.0)] {
            let series = format!("scpsfm_fenced_writes_total{{operation=\"{operation}\"}}");
            assert_eq!(page.value(&series), count, "{operation}");
        }
    }
}
