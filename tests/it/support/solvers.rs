//! Stand-ins for the solver.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use scpsfm::domain::result::{ObservationResults, TrackResults, ViewResult};
use scpsfm::domain::{
    Grade, Input, Method, Observer, Progress, Proposal, ReconstructionProgress, Solution, SolveSettings, Stage, Status,
    StopToken,
};
use scpsfm::engine::Solver;
use scpsfm::solver::Error;

/// Answers at once; the answer depends on the input and on the seed.
pub fn quick() -> Solver {
    Arc::new(|input, settings, observer, _stop| {
        observer.stage(Stage::Search);
        observer.progress(&progress(0.5));
        observer.weights(1, &vec![0.5; input.track_count()]);
        Ok(solution(input, settings))
    })
}

/// Runs until it is let go or stopped.
pub fn held() -> (Solver, Arc<Hold>) {
    let hold = Arc::new(Hold::default());
    let inner = Arc::clone(&hold);
    let solver: Solver = Arc::new(move |input, settings, observer, stop| inner.solve(input, settings, observer, stop));
    (solver, hold)
}

/// Lets a held solver go.
#[derive(Debug, Default)]
pub struct Hold {
    open: AtomicBool,
}

impl Hold {
    pub fn let_go(&self) {
        self.open.store(true, Ordering::SeqCst);
    }

    fn solve(
        &self,
        input: &Input,
        settings: &SolveSettings,
        observer: &mut dyn Observer,
        stop: &StopToken,
    ) -> Result<Solution, Error> {
        observer.stage(Stage::Search);
        observer.progress(&progress(0.25));
        while !self.open.load(Ordering::SeqCst) {
            if let Some(reason) = stop.reason() {
                return Err(Error::Stopped(reason));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(solution(input, settings))
    }
}

fn progress(fraction: f64) -> Progress {
    Progress {
        stage: Stage::Search,
        fraction,
        iteration: 10,
        losses: None,
        head: None,
        inliers: 3,
        focal_px: Some(1000.0),
        best_cost: Some(0.5),
        elapsed_seconds: 0.0,
        reconstruction: ReconstructionProgress::default(),
    }
}

/// A made-up answer of the input's shape.
pub fn solution(input: &Input, settings: &SolveSettings) -> Solution {
    let tracks = input.track_count();
    Solution {
        status: Status::Solved,
        grade: Some(Grade::ProjectiveOnly),
        method: Method::Auto,
        winning_proposal: Some(Proposal::Uniform),
        iterations: 10,
        seed: settings.seed,
        calibrations: Vec::new(),
        plane_at_infinity: None,
        views: vec![ViewResult::default(); input.view_count()],
        tracks: TrackResults {
            weight: (0..tracks).map(|track| track as f32 / tracks as f32).collect(),
            inlier: (0..tracks).map(|track| track % 2 == 0).collect(),
            network_weight: Vec::new(),
            point: vec![None; tracks],
            part: Vec::new(),
            second_structure: Vec::new(),
        },
        observations: ObservationResults {
            inlier: vec![true; input.observation_count()],
            residual_px: (0..input.observation_count()).map(|k| Some(input.point_px(k)[0])).collect(),
            ..ObservationResults::unjudged(input.observation_count())
        },
        splits: Vec::new(),
        two_view_tracks: Vec::new(),
        second_structures: Vec::new(),
        noise_px: Some(0.5),
        reprojection_rms_px: Some(0.75),
        reprojection_mean_px: None,
        warnings: Vec::new(),
        seconds: 0.0,
        stages: Vec::new(),
        proposal_times: Vec::new(),
        history: Vec::new(),
        trained_network_sha256: None,
        input_content_sha256: None,
        joined_tracks: input.joined_tracks(),
    }
}
