//! Those who call the servers, and what they were told.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rand::seq::IteratorRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::server::Server;
use crate::domain::SolveSettings;
use crate::domain::job::{EventBody, JobName, JobState};
use crate::engine::tests::input;
use crate::engine::{Engine, Error, JobDescription, JobInput, NewJob, StoreError};

/// Jobs that clients ask for in one simulation at most.
const MOST_REQUESTS: u64 = 24;

/// What a client knows of a job.
#[derive(Debug, Clone, Default)]
pub(super) struct Known {
    /// Sequence number of the last event that it saw.
    pub after: u64,
    /// The last state that it saw.
    state: Option<JobState>,
    /// The job's end, once a watch has told it and come to an end.
    pub end: Option<JobState>,
    /// How often it asked for another try of a job that had ended.
    pub retries: usize,
    /// Somebody follows it now.
    watched: bool,
    /// Its deletion was asked for: it may be gone.
    pub deleted: bool,
}

/// What all clients together know.
#[derive(Debug, Default)]
pub(super) struct History {
    /// Requests that were sent; the answer may be lost.
    pub sent: u64,
    /// The jobs that were acknowledged.
    pub jobs: BTreeMap<JobName, Known>,
    violation: Option<String>,
}

impl History {
    fn violated(&mut self, what: String) {
        self.violation.get_or_insert(what);
    }
}

/// All clients.
pub(super) struct Clients {
    rng: ChaCha8Rng,
    history: Arc<Mutex<History>>,
}

fn locked(history: &Mutex<History>) -> MutexGuard<'_, History> {
    history.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Clients {
    pub(super) fn new(seed: u64) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), history: Arc::default() }
    }

    /// The jobs that were acknowledged, and the number of requests that were sent.
    pub(super) fn known(&self) -> (BTreeMap<JobName, Known>, u64) {
        let history = self.history();
        (history.jobs.clone(), history.sent)
    }

    fn history(&self) -> MutexGuard<'_, History> {
        locked(&self.history)
    }

    /// What a client was told that must not be.
    pub(super) fn violation(&self) -> Option<String> {
        self.history().violation.clone()
    }

    /// Whether the end of every job was seen.
    pub(super) fn all_is_seen(&self) -> bool {
        self.history().jobs.values().all(|known| known.end.is_some())
    }

    /// Someone calls a server.
    pub(super) fn call(&mut self, server: &Server) {
        let history = self.history.clone();
        let known = locked(&history).jobs.keys().cloned().choose(&mut self.rng);
        match (self.rng.random_range(0..12), known) {
            (0..=1, Some(name)) => server.spawn(|engine| watch(engine, name, history)),
            (2, Some(name)) => server.spawn(|engine| cancel(engine, name, history)),
            (3, Some(name)) => server.spawn(|engine| delete(engine, name, history)),
            (4, Some(name)) => server.spawn(|engine| retry(engine, name, history)),
            (5, Some(name)) => {
                let priority = self.rng.random_range(0..3);
                server.spawn(|engine| set_priority(engine, name, priority, history));
            }
            _ => {
                let sent = self.history().sent;
                // A new request, or one that was sent before.
                let number = self.rng.random_range(0..=sent).min(MOST_REQUESTS - 1);
                let number = if self.rng.random_bool(0.7) { sent.min(MOST_REQUESTS - 1) } else { number };
                let mut known = self.history();
                known.sent = sent.max(number + 1);
                // One whose job is deleted would be another job.
                if known.jobs.iter().any(|(name, known)| known.deleted && name.job == format!("job-{number}")) {
                    return;
                }
                drop(known);
                server.spawn(|engine| submit(engine, number, history));
            }
        }
    }

    /// The operator pauses the queue, or lets it go on.
    pub(super) fn set_paused(&self, server: &Server, paused: bool) {
        let history = self.history.clone();
        server.spawn(move |engine| async move {
            let answer = engine.set_paused(paused).await;
            match answer {
                Ok(()) => {}
                Err(error) if is_failure(&error) => {}
                Err(error) => locked(&history).violated(format!("pause of the queue: {error}")),
            }
        });
    }

    /// Everyone who waits for the end of a job goes on with that.
    pub(super) fn watch_all(&mut self, server: &Server) {
        let open: Vec<JobName> =
            self.history().jobs.iter().filter(|(_, known)| known.end.is_none()).map(|(name, _)| name.clone()).collect();
        for name in open {
            let history = self.history.clone();
            server.spawn(|engine| watch(engine, name, history));
        }
    }
}

/// What request of this number asks for: the same each time.
pub(super) fn request(number: u64) -> NewJob {
    let seed = ChaCha8Rng::seed_from_u64(number).random_range(0..1_000_000);
    let settings = SolveSettings { seed, ..SolveSettings::default() };
    let description = JobDescription {
        request_id: Some(format!("request-{number}")),
        job_id: Some(format!("job-{number}")),
        priority: (seed / 1_000 % 3) as i32,
        settings,
        ..JobDescription::default()
    };
    NewJob {
        tenant: format!("tenant-{}", number % 3),
        description,
        input: JobInput::Inline(input()),
        trace_parent: None,
        cancel_on_disconnect: false,
    }
}

/// What may be answered by a server whose store misbehaves.
fn is_failure(error: &Error) -> bool {
    matches!(error, Error::Store(StoreError::Unavailable(_) | StoreError::NoSpace(_)) | Error::Draining)
}

async fn submit(engine: Engine, number: u64, history: Arc<Mutex<History>>) {
    let answer = engine.submit(request(number)).await;
    let mut history = locked(&history);
    match answer {
        Ok(job) => {
            if job.name.job != format!("job-{number}") {
                history.violated(format!("request {number} is {}", job.name));
            }
            history.jobs.entry(job.name).or_default();
        }
        Err(Error::Store(StoreError::QueueFull(_))) => {}
        Err(error) if is_failure(&error) => {}
        Err(error) => history.violated(format!("request {number}: {error}")),
    }
}

async fn cancel(engine: Engine, name: JobName, history: Arc<Mutex<History>>) {
    match engine.cancel(&name, None).await {
        Ok(_) => {}
        Err(error) if is_failure(&error) => {}
        Err(Error::Store(StoreError::NotFound(_)))
            if locked(&history).jobs.get(&name).is_none_or(|known| known.deleted) => {}
        Err(error) => locked(&history).violated(format!("cancel of {name}: {error}")),
    }
}

async fn delete(engine: Engine, name: JobName, history: Arc<Mutex<History>>) {
    // Before: whether an answer that is lost was a yes is not known.
    let Some(known) = locked(&history).jobs.get(&name).cloned() else { return };
    if known.end.is_none() {
        return;
    }
    if let Some(known) = locked(&history).jobs.get_mut(&name) {
        known.deleted = true;
    }
    match engine.delete(&name, None).await {
        // A request that was on its way for long has made the job anew.
        Ok(()) | Err(Error::Store(StoreError::NotFound(_) | StoreError::NotEnded(..))) => {}
        Err(error) if is_failure(&error) => {}
        Err(error) => locked(&history).violated(format!("delete of {name}: {error}")),
    }
}

async fn retry(engine: Engine, name: JobName, history: Arc<Mutex<History>>) {
    match locked(&history).jobs.get_mut(&name) {
        Some(known) if !known.deleted && known.end.is_some_and(|end| end != JobState::Succeeded) => {
            // Before: whether an answer that is lost was a yes is not known.
            known.end = None;
            known.retries += 1;
        }
        _ => return,
    }
    match engine.retry(&name, None).await {
        // Another client may have retried it, or deleted it.
        Ok(_) | Err(Error::Store(StoreError::NotFound(_) | StoreError::QueueFull(_) | StoreError::Succeeded(_))) => {}
        Err(error) if is_failure(&error) => {}
        Err(error) => locked(&history).violated(format!("retry of {name}: {error}")),
    }
}

async fn set_priority(engine: Engine, name: JobName, priority: i32, history: Arc<Mutex<History>>) {
    match engine.set_priority(&name, None, priority).await {
        Ok(_) | Err(Error::Store(StoreError::NotQueued(..))) => {}
        Err(error) if is_failure(&error) => {}
        Err(Error::Store(StoreError::NotFound(_)))
            if locked(&history).jobs.get(&name).is_none_or(|known| known.deleted) => {}
        Err(error) => locked(&history).violated(format!("priority of {name}: {error}")),
    }
}

/// Follows a job from the last event that was seen.
async fn watch(engine: Engine, name: JobName, history: Arc<Mutex<History>>) {
    let after = match locked(&history).jobs.get_mut(&name) {
        Some(known) if !known.watched && known.end.is_none() => {
            known.watched = true;
            known.after
        }
        _ => return,
    };
    // Also where the server dies in between.
    let _watched = Watched { name: name.clone(), history: history.clone() };
    let mut watch = match engine.watch(&name, after).await {
        Ok(watch) => watch,
        Err(error) if is_failure(&error) => return,
        Err(error) => return locked(&history).violated(format!("watch of {name} after {after}: {error}")),
    };
    while let Some(event) = watch.next().await {
        let mut history = locked(&history);
        let event = match event {
            Ok(event) => event,
            Err(error) if is_failure(&error) => return,
            Err(error) => return history.violated(format!("events of {name}: {error}")),
        };
        let Some(sequence) = event.sequence else { continue };
        let Some(known) = history.jobs.get_mut(&name) else { return };
        let (before, state_before, retries) = (known.after, known.state, known.retries);
        known.after = sequence;
        if let EventBody::State { state, .. } = event.body {
            known.state = Some(state);
        }
        let ended_before = state_before.is_some_and(JobState::is_terminal);
        if sequence != before + 1 || ended_before && retries == 0 {
            history.violated(format!("{name}: event {sequence} came after {before} in the state {state_before:?}"));
        }
    }
    // The end of the stream tells that the last end is the last.
    if let Some(known) = locked(&history).jobs.get_mut(&name) {
        known.end = known.state.filter(|state| state.is_terminal());
        let state = known.state;
        if known.end.is_none() {
            locked(&history).violated(format!("the events of {name} end in the state {state:?}"));
        }
    }
}

/// Notes when nobody follows a job any more.
struct Watched {
    name: JobName,
    history: Arc<Mutex<History>>,
}

impl Drop for Watched {
    fn drop(&mut self) {
        if let Some(known) = locked(&self.history).jobs.get_mut(&self.name) {
            known.watched = false;
        }
    }
}
