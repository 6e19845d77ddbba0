//! Who calls, and what that caller may name.

use std::fmt::Display;
use std::sync::Arc;

use tonic::codegen::http::HeaderMap;
use tonic::{Code, Request, Status};
use tracing::Instrument;

use super::access_log::{CallRecord, code_name};
use super::convert::names;
use super::keys::{Grant, Scope};
use super::rates::Rates;
use super::status;
use crate::domain::InputName;
use crate::domain::job::{Job, JobName};
use crate::telemetry::tracing::AUDIT;

/// Header of the W3C trace context.
pub const TRACE_PARENT: &str = "traceparent";

/// The caller of one call: the one place where a service learns whose it is.
#[derive(Debug, Clone)]
pub struct Caller {
    grant: Grant,
    trace_parent: Option<String>,
    rates: Arc<Rates>,
    record: Arc<CallRecord>,
}

impl Caller {
    /// Of a call with these headers, for [`Authenticate`](super::auth::Authenticate), which puts it into the request's
    /// extensions.
    pub fn new(grant: Grant, headers: &HeaderMap, rates: Arc<Rates>, record: Arc<CallRecord>) -> Self {
        let trace_parent = headers.get(TRACE_PARENT).and_then(|value| value.to_str().ok()).map(str::to_owned);
        Self { grant, trace_parent, rates, record }
    }

    /// # Errors
    /// `INTERNAL` for a request that did not come through the layer that finds the caller: a service that was put
    /// outside of it must not answer as if everyone were the default tenant.
    pub fn of<T>(request: &Request<T>) -> Result<Self, Status> {
        let caller = request.extensions().get().cloned();
        caller.ok_or_else(|| status::internal(&"a request reached a service without a caller"))
    }

    /// Counts jobs that the caller is about to create for its tenant's rate.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED`, reason `RATE_LIMITED`.
    pub fn count_jobs(&self, count: usize) -> Result<(), Status> {
        self.rates.jobs(&self.grant.tenant, count)
    }

    /// Writes into the audit log that the caller did this to the resource, or tried to.
    pub fn audit<T>(&self, method: &'static str, resource: &dyn Display, outcome: &Result<T, Status>) {
        self.write_audit(method, resource, outcome.as_ref().map_or_else(Status::code, |_| Code::Ok));
    }

    /// The same of the creation of jobs, a line each; where it was refused, of their tenant.
    pub fn audit_jobs(&self, method: &'static str, created: Result<&[Job], &Status>) {
        match created {
            Ok(jobs) => jobs.iter().for_each(|job| self.write_audit(method, &job.name, Code::Ok)),
            Err(status) => self.write_audit(method, &format_args!("tenants/{}", &self.grant.tenant), status.code()),
        }
    }

    /// Does something to the resource and writes it into the audit log. In a task of its own: if the call is dropped
    /// meanwhile, what it did is written down all the same.
    ///
    /// # Errors
    /// Those of `work`.
    pub async fn audited<T: Send + 'static, E: Into<Status>>(
        self,
        method: &'static str,
        resource: impl Display + Send + Sync + 'static,
        work: impl Future<Output = Result<T, E>> + Send + 'static,
    ) -> Result<T, Status> {
        let doing = async move {
            let outcome = work.await.map_err(Into::into);
            self.audit(method, &resource, &outcome);
            outcome
        };
        tokio::spawn(doing.in_current_span()).await.map_err(|error| status::internal(&error))?
    }

    fn write_audit(&self, method: &'static str, resource: &dyn Display, code: Code) {
        tracing::info!(
            target: AUDIT,
            tenant = self.grant.tenant,
            key = self.record.key(),
            peer = self.record.peer(),
            method,
            resource = %resource,
            code = code_name(code),
            "audit"
        );
    }

    /// The trace that the call belongs to.
    pub fn trace_parent(&self) -> Option<&str> {
        self.trace_parent.as_deref()
    }

    /// Whether the caller may name what this tenant has.
    fn reaches(&self, tenant: &str) -> bool {
        self.grant.scope == Scope::Admin || tenant == self.grant.tenant
    }

    /// The tenant that `parent` names, which is the caller's own where that is left out, and must be for all but
    /// administrators.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for another form, `NOT_FOUND` for another tenant, whether there is one of that name or not.
    pub fn parent(&self, parent: &str) -> Result<String, Status> {
        let tenant = names::tenant(parent, &self.grant.tenant).map_err(status::invalid)?;
        if self.reaches(&tenant) { Ok(tenant) } else { Err(status::tenant_not_found(&tenant)) }
    }

    /// The job that `name` names; another tenant's is as one that never was, but for an administrator.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for another form, `NOT_FOUND` for another tenant's.
    pub fn job(&self, name: &str) -> Result<JobName, Status> {
        let name = names::job(name, &self.grant.tenant).map_err(status::invalid)?;
        if self.reaches(&name.tenant) { Ok(name) } else { Err(status::job_not_found(&name)) }
    }

    /// The uploaded input that `name`, of that field, names; another tenant's is as one that never was, but for an
    /// administrator.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for another form, `NOT_FOUND` for another tenant's.
    pub fn input(&self, name: &str, field: &str) -> Result<InputName, Status> {
        let name = names::input(name, field, &self.grant.tenant).map_err(status::invalid)?;
        if self.reaches(&name.tenant) { Ok(name) } else { Err(status::input_not_found(&name)) }
    }
}

#[cfg(test)]
mod tests {
    use governor::clock::DefaultClock;

    use super::*;
    use crate::rpc::rates;

    #[test]
    fn other_tenants_are_out_of_reach() {
        assert_eq!(Caller::of(&Request::new(())).expect_err("no caller").code(), Code::Internal);
        let caller = |grant| {
            let rates = Rates::new(rates::Options::default(), DefaultClock::default());
            Caller::new(grant, &HeaderMap::new(), Arc::new(rates), Arc::default())
        };
        let of = |scope| {
            let grant = Grant { tenant: "north".into(), scope };
            caller(grant).job("tenants/other/jobs/a").is_ok()
        };
        assert_eq!(Scope::ALL.map(of), [false, false, true], "an administrator names every tenant's");
        let caller = caller(Grant::default());
        assert_eq!(caller.parent("tenants/default").expect("own"), "default");
        assert_eq!(caller.parent("tenants/other").expect_err("another's").code(), Code::NotFound);
        assert_eq!(caller.parent("default").expect_err("malformed").code(), Code::InvalidArgument);
        assert!(caller.job("tenants/default/jobs/a").is_ok());
        assert_eq!(caller.job("tenants/other/jobs/a").expect_err("another's").code(), Code::NotFound);
        assert_eq!(caller.job("jobs/a").expect_err("malformed").code(), Code::InvalidArgument);
    }
}
