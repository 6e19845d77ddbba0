//! The engine over a real SQLite store and a solver that behaves as each job asks.

mod admission;
mod lifecycle;
mod memory;
mod prefetch;
mod sharing;
mod simulation;
mod survival;
mod tenants;
mod watching;

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use tempfile::TempDir;

use super::{Engine, Error, JobDescription, JobInput, NewJob, Options, Solver};
use crate::domain::job::{DEFAULT_TENANT, EventBody, Job, JobEvent, JobName, JobState};
use crate::domain::{
    Input, Limits, Method, Observer, Progress, RawInput, ReconstructionProgress, Solution, SolveSettings, Stage,
    Status, StopToken, View,
};
use crate::solver;
use crate::store::sqlite::Sqlite;

/// What the solver is to do with a job, passed as the job's seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behavior {
    /// One progress, then the solution.
    Succeed = 0,
    Fail = 1,
    Panic = 2,
    /// One progress, then nothing until it is stopped or released, then the solution.
    Wait = 3,
    /// The same, deaf to being stopped.
    Deaf = 4,
    /// Interim weights 1 to 50, then as [`Behavior::Wait`].
    Weights = 5,
    /// A thousand progress records at once, then as [`Behavior::Wait`].
    Chatter = 6,
}

/// A solver whose calls behave as their jobs ask, wait until they are released, and are counted.
#[derive(Debug, Default)]
struct FakeSolver {
    released: AtomicU32,
    calls: AtomicU64,
    /// Jobs that reached their waiting point.
    waiting: AtomicU32,
}

impl FakeSolver {
    fn release(&self) {
        self.released.store(1, Ordering::SeqCst);
    }

    /// Until `count` solvers in all have come to their waiting point.
    async fn until_waiting(&self, count: u32) {
        eventually(|| async { (self.waiting.load(Ordering::SeqCst) >= count).then_some(()) }).await;
    }

    fn solver_fn(self: &Arc<Self>) -> Solver {
        let solver = self.clone();
        Arc::new(move |input, settings, observer, stop| solver.solve(input, settings, observer, stop))
    }

    fn solve(
        &self,
        input: &Input,
        settings: &SolveSettings,
        observer: &mut dyn Observer,
        stop: &StopToken,
    ) -> Result<Solution, solver::Error> {
        let call = self.calls.fetch_add(1, Ordering::SeqCst) + 1;
        let is = |behavior: Behavior| settings.seed == behavior as u64;
        observer.stage(Stage::Prepare);
        if is(Behavior::Fail) {
            return Err(solver::Error::Internal("told to fail".into()));
        }
        if is(Behavior::Panic) {
            panic!("told to panic");
        }
        observer.stage(Stage::Search);
        for iteration in 1..=if is(Behavior::Chatter) { 1000 } else { 1 } {
            observer.progress(&progress(iteration));
        }
        if is(Behavior::Weights) {
            (1..=50).for_each(|iteration| observer.weights(iteration, &[iteration as f32; 3]));
        }
        self.waiting.fetch_add(1, Ordering::SeqCst);
        while !is(Behavior::Succeed) && self.released.load(Ordering::SeqCst) == 0 {
            if let Some(reason) = stop.reason().filter(|_| !is(Behavior::Deaf)) {
                return Err(solver::Error::Stopped(reason));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(solution(input, call))
    }
}

fn progress(iteration: u32) -> Progress {
    Progress {
        stage: Stage::Search,
        fraction: 0.1,
        iteration,
        losses: None,
        head: None,
        inliers: 2,
        focal_px: None,
        best_cost: None,
        elapsed_seconds: 0.0,
        reconstruction: ReconstructionProgress::default(),
    }
}

/// A result as these tests read it: which call of the solver made it.
fn encode(_: &JobName, solution: &Solution) -> Vec<u8> {
    solution.iterations.to_le_bytes().into()
}

/// Which call of the solver made a job's result.
async fn call_of(engine: &Engine, name: &JobName) -> u32 {
    let result = engine.result(&engine.job(name).await.expect("exists")).await.expect("ready");
    u32::from_le_bytes(result.bytes.try_into().expect("four bytes"))
}

/// A solution that tells which call of the solver made it, by its iterations.
fn solution(input: &Input, call: u64) -> Solution {
    Solution {
        status: Status::NoReconstruction,
        grade: None,
        method: Method::Auto,
        winning_proposal: None,
        iterations: call as u32,
        seed: 0,
        calibrations: Vec::new(),
        plane_at_infinity: Some([0.0, -1.5, f64::MIN_POSITIVE]),
        views: vec![Default::default(); input.view_count()],
        tracks: Default::default(),
        observations: Default::default(),
        splits: Vec::new(),
        two_view_tracks: Vec::new(),
        second_structures: Vec::new(),
        noise_px: None,
        reprojection_rms_px: Some(0.5),
        reprojection_mean_px: None,
        warnings: Vec::new(),
        seconds: 0.0,
        stages: Vec::new(),
        proposal_times: Vec::new(),
        history: vec![progress(1)],
        trained_network_sha256: None,
        input_content_sha256: None,
        joined_tracks: None,
    }
}

fn input() -> Input {
    let raw = RawInput {
        views: vec![View::default(); 2],
        track_count: 2,
        view: vec![0, 1, 0, 1],
        track: vec![0, 0, 1, 1],
        x: vec![1.0, 2.0, 3.0, 4.0],
        y: vec![5.0, 6.0, 7.0, 8.0],
        depth: Vec::new(),
        sigma: Vec::new(),
    };
    Input::new(raw, &Limits::default(), "test").expect("valid")
}

/// A job of the default tenant that is described so.
fn described(description: JobDescription) -> NewJob {
    NewJob {
        tenant: DEFAULT_TENANT.into(),
        description,
        input: JobInput::Inline(input()),
        trace_parent: None,
        cancel_on_disconnect: false,
    }
}

/// What makes the solver behave so.
fn behaving(behavior: Behavior) -> JobDescription {
    let settings = SolveSettings { seed: behavior as u64, ..SolveSettings::default() };
    JobDescription { settings, ..JobDescription::default() }
}

fn new_job(behavior: Behavior) -> NewJob {
    described(behaving(behavior))
}

impl Engine {
    /// Admits and stores one job.
    async fn submit(&self, new: NewJob) -> Result<Job, Error> {
        Ok(self.submit_batch(vec![new]).await?.pop().expect("one of one"))
    }
}

/// An engine over a store in a directory of its own.
struct TestEngine {
    engine: Engine,
    store: Arc<Sqlite>,
    solver: Arc<FakeSolver>,
    directory: TempDir,
}

impl TestEngine {
    async fn start(options: Options) -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let solver = Arc::new(FakeSolver::default());
        let (engine, store) = start(options, &directory, &solver).await;
        Self { engine, store, solver, directory }
    }

    async fn submit(&self, behavior: Behavior) -> JobName {
        self.engine.submit(new_job(behavior)).await.expect("admitted").name
    }

    /// The job once it has ended.
    async fn ended(&self, name: &JobName) -> Job {
        ended(&self.engine, name).await
    }
}

async fn start(options: Options, directory: &TempDir, solver: &Arc<FakeSolver>) -> (Engine, Arc<Sqlite>) {
    // The engine before may still be letting go of the directory.
    let store = eventually(|| async { Sqlite::open(directory.path()).ok() }).await;
    let store = Arc::new(store);
    let engine = Engine::start(options, store.clone(), solver.solver_fn(), encode).await.expect("starts");
    (engine, store)
}

fn workers(workers: usize) -> Options {
    Options { workers, ..Options::default() }
}

async fn ended(engine: &Engine, name: &JobName) -> Job {
    eventually(|| async { Some(engine.job(name).await.expect("exists")).filter(|job| job.state.is_terminal()) }).await
}

/// Asks until there is an answer; the bound is for a hang, nothing is expected to come near it.
async fn eventually<T, F: Future<Output = Option<T>>>(mut ask: impl FnMut() -> F) -> T {
    let asking = async {
        loop {
            if let Some(answer) = ask().await {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(120), asking).await.expect("an answer within two minutes")
}

/// The rest of a watch, which must end with a terminal state.
async fn rest(watch: &mut super::Watch) -> Vec<JobEvent> {
    let reading = async {
        let mut events = Vec::new();
        while let Some(event) = watch.next().await {
            events.push(event.expect("no error"));
        }
        events
    };
    let events = tokio::time::timeout(Duration::from_secs(120), reading).await.expect("an end within two minutes");
    assert!(events.last().is_none_or(|event| terminal(event).is_some()), "{events:?}");
    events
}

fn terminal(event: &JobEvent) -> Option<JobState> {
    match event.body {
        EventBody::State { state, .. } => Some(state).filter(|state| state.is_terminal()),
        _ => None,
    }
}

/// Numbered events must be `first..`, one after the other.
fn assert_contiguous(events: &[JobEvent], first: u64) {
    let sequences: Vec<u64> = events.iter().filter_map(|event| event.sequence).collect();
    let expected: Vec<u64> = (first..first + sequences.len() as u64).collect();
    assert_eq!(sequences, expected);
}
