//! Tells the observer where the solve stands and keeps what the result reports of its course.

use std::time::{Duration, Instant};

use crate::domain::result::StageTime;
use crate::domain::{HeadProgress, Losses, Observer, Progress, ReconstructionProgress, Solution, Stage, Step, Task};

/// Share of the whole that is done when each stage begins; the rest of each interval fills as the stage goes on.
/// From the measured shares of time at 10 views, 200 tracks, 90 % outliers.
fn fraction_at(stage: Stage) -> f64 {
    match stage {
        Stage::Prepare => 0.0,
        Stage::Search => 0.02,
        Stage::Refine => 0.85,
        Stage::Calibrate => 0.93,
        Stage::Extend => 0.97,
        Stage::Classify => 0.98,
    }
}

/// Share of a sequence's solve that its blocks take; the rest is their extension.
const BLOCKS_OF_SEQUENCE: f64 = 0.4;

/// The same as [`fraction_at`] for an extension.
fn fraction_of_extension_at(stage: Stage) -> f64 {
    match stage {
        Stage::Prepare | Stage::Search | Stage::Refine | Stage::Extend => 0.0,
        Stage::Calibrate => 0.85,
        Stage::Classify => 0.95,
    }
}

/// Time between two heartbeats within a stage: often enough for eyes, and nothing beside the work between them.
const HEARTBEAT_PERIOD: Duration = Duration::from_millis(100);

/// Verdicts that a track gets at most.
const JUDGED_TIMES: usize = 2;

/// Wraps the caller's observer for one solve.
pub struct Recorder<'a> {
    observer: &'a mut dyn Observer,
    started: Instant,
    stage_started: Instant,
    stages: Vec<StageTime>,
    /// Share of the whole that the blocks have: all, or what an extension leaves them.
    share_of_blocks: f64,
    extending: bool,
    /// State before the block of a further component, while that is solved.
    before_component: Option<Progress>,
    history: Vec<Progress>,
    /// Every so many records go into the history; doubled whenever it is full.
    stride: usize,
    records: usize,
    /// What is reported next; the seconds are added then.
    pub progress: Progress,
    last_report: Instant,
}

impl<'a> Recorder<'a> {
    /// * `views`: how many can be registered
    pub fn new(observer: &'a mut dyn Observer, views: usize) -> Self {
        let now = Instant::now();
        observer.stage(Stage::Prepare);
        Self {
            observer,
            started: now,
            stage_started: now,
            stages: Vec::new(),
            share_of_blocks: 1.0,
            extending: false,
            before_component: None,
            history: Vec::new(),
            stride: 1,
            records: 0,
            progress: Progress {
                reconstruction: ReconstructionProgress { views: views as u32, ..ReconstructionProgress::default() },
                ..Progress::default()
            },
            last_report: now,
        }
    }

    /// Begins another block, `block` of at most `blocks`, counted from 0.
    pub fn begin_block(&mut self, block: usize, blocks: usize) {
        self.progress.reconstruction = ReconstructionProgress {
            block: block as u32 + 1,
            blocks: blocks.max(1) as u32,
            views: self.progress.reconstruction.views,
            ..ReconstructionProgress::default()
        };
        self.extending = false;
        self.begin_again();
    }

    /// Begins the search of a block anew: its course so far counts as work.
    pub fn begin_again(&mut self) {
        self.progress =
            Progress { losses: None, head: None, inliers: 0, focal_px: None, best_cost: None, ..self.progress };
    }

    /// Says beforehand that the best block will be extended.
    pub fn expect_extension(&mut self) {
        self.share_of_blocks = BLOCKS_OF_SEQUENCE;
    }

    /// Begins the extension of a block.
    pub fn begin_extension(&mut self) {
        self.extending = true;
    }

    /// Begins the block of a further component: its course counts as work, and moves the share done no further.
    pub fn begin_component(&mut self, component: u32) {
        self.progress.reconstruction.part = component;
        self.before_component = Some(self.progress);
        self.begin_again();
    }

    /// Ends it: what stands is again what stood before.
    pub fn end_component(&mut self) {
        if let Some(before) = self.before_component.take() {
            let Progress { stage, iteration, .. } = self.progress;
            self.progress = Progress { stage, iteration, ..before };
        }
        self.enter(Stage::Extend);
    }

    /// All components there are to be are built.
    pub fn end_components(&mut self) {
        self.progress.reconstruction.part = 0;
    }

    /// An iteration of the network is done; told with the next [`Self::report`].
    pub fn optimised(&mut self, head: HeadProgress, losses: Losses) {
        self.progress.iteration += 1;
        self.progress.losses = Some(losses);
        self.progress.head = Some(head);
    }

    /// Records what stands now instead of what the search found: after every step that changes it, and before
    /// [`Self::finish`] with the numbers of the solution.
    ///
    /// * `inliers`: tracks
    /// * `focal_px`: of the first camera that has one; `None` where the focal length is not determined
    pub fn found(&mut self, inliers: usize, focal_px: Option<f64>) {
        self.progress.inliers = inliers as u32;
        self.progress.focal_px = focal_px;
    }

    /// So many views have a camera. What a block of a further component has counts once it is among the others.
    pub fn registered(&mut self, views: usize) {
        if self.before_component.is_none() {
            self.progress.reconstruction.registered_views = views as u32;
        }
    }

    /// Enters a stage, ending the one before.
    pub fn enter(&mut self, stage: Stage) {
        self.close_stage();
        self.progress.reconstruction.step = None;
        self.progress.stage = stage;
        self.observer.stage(stage);
        self.report(0.0);
    }

    /// Reports the current state to the observer; `within` is the share of the stage that is done.
    pub fn report(&mut self, within: f64) {
        self.advance(within);
        let progress = self.report_progress();
        self.keep(progress);
    }

    /// Begins a step of a task, or tells how many are done; see [`Step`]. `within` as for [`Self::report`].
    pub fn step(&mut self, task: Task, step: usize, steps: usize, within: f64) {
        self.begin_step(task, step, steps);
        self.advance(within);
        self.heartbeat();
    }

    /// The same, reported with the next [`Self::report`].
    pub fn begin_step(&mut self, task: Task, step: usize, steps: usize) {
        self.progress.reconstruction.step = Some(Step { task, step: step as u32, steps: steps as u32 });
    }

    /// Tells how many verdicts there are; `tracks`: how many are judged.
    pub fn judged(&mut self, verdicts: usize, tracks: usize) {
        let most = JUDGED_TIMES * tracks;
        self.step(Task::Classify, verdicts, most, verdicts as f64 / most.max(1) as f64);
    }

    /// Reports the current state to the observer if it got nothing for a while.
    ///
    /// When that is depends on the machine, so that none of it goes into the history: one input has one answer.
    pub fn heartbeat(&mut self) {
        if self.last_report.elapsed() >= HEARTBEAT_PERIOD {
            self.report_progress();
        }
    }

    /// Reports the current state to the observer, and returns what was reported.
    fn report_progress(&mut self) -> Progress {
        let progress = Progress { elapsed_seconds: self.seconds(), ..self.progress };
        self.observer.progress(&progress);
        self.last_report = Instant::now();
        progress
    }

    fn advance(&mut self, within: f64) {
        self.progress.fraction = self.progress.fraction.max(self.fraction_done(within.clamp(0.0, 1.0)));
    }

    fn fraction_done(&self, within: f64) -> f64 {
        if self.before_component.is_some() {
            return self.progress.fraction;
        }
        let at = if self.extending { fraction_of_extension_at } else { fraction_at };
        let begin = at(self.progress.stage);
        let end = Stage::ALL.into_iter().map(at).find(|&at| at > begin).unwrap_or(1.0);
        let done = begin + (end - begin) * within;
        if self.extending {
            self.share_of_blocks + (1.0 - self.share_of_blocks) * done
        } else {
            // Each block has an equal share. Before the first, both numbers are 0.
            let ReconstructionProgress { block, blocks, .. } = self.progress.reconstruction;
            self.share_of_blocks * (f64::from(block.max(1) - 1) + done) / f64::from(blocks.max(1))
        }
    }

    /// Hands interim weights on.
    pub fn weights(&mut self, weights: &[f32]) {
        self.observer.weights(self.progress.iteration, weights);
    }

    /// Seconds since the solve began.
    pub fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Ends the last stage and gives back times and curves.
    pub fn finish(mut self) -> (Vec<StageTime>, Vec<Progress>) {
        self.progress.fraction = 1.0;
        self.progress.reconstruction.step = None;
        self.report(1.0);
        self.close_stage();
        (self.stages, self.history)
    }

    /// Adds the seconds of the current stage; a stage that is entered twice has one entry.
    fn close_stage(&mut self) {
        let seconds = self.stage_started.elapsed().as_secs_f64();
        self.stage_started = Instant::now();
        let stage = self.progress.stage;
        match self.stages.iter_mut().find(|entry| entry.stage == stage) {
            Some(entry) => entry.seconds += seconds,
            None => self.stages.push(StageTime { stage, seconds }),
        }
    }

    fn keep(&mut self, progress: Progress) {
        if self.records.is_multiple_of(self.stride) {
            if self.history.len() == Solution::MAX_HISTORY {
                let mut odd = false;
                self.history.retain(|_| {
                    odd = !odd;
                    odd
                });
                self.stride *= 2;
            }
            self.history.push(progress);
        }
        self.records += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Fractions(Vec<f64>);

    impl Observer for Fractions {
        fn progress(&mut self, progress: &Progress) {
            self.0.push(progress.fraction);
        }
    }

    #[test]
    fn what_is_found_last_is_told_last() {
        let mut silent = crate::domain::Silent;
        let mut recorder = Recorder::new(&mut silent, 10);
        (recorder.progress.inliers, recorder.progress.focal_px) = (20, Some(700.0));
        recorder.enter(Stage::Calibrate);
        recorder.found(180, Some(812.5));
        let told = |history: &[Progress]| history.last().map(|record| (record.inliers, record.focal_px));
        assert_eq!(told(&recorder.finish().1), Some((180, Some(812.5))));
    }

    #[test]
    fn fractions_never_decrease_and_history_is_bounded() {
        let mut seen = Fractions::default();
        let mut recorder = Recorder::new(&mut seen, 10);
        for block in 0..2 {
            recorder.begin_block(block, 2);
            for stage in [Stage::Search, Stage::Refine, Stage::Calibrate] {
                recorder.enter(stage);
                for step in 0..1000 {
                    recorder.report(f64::from(step) / 1000.0);
                }
            }
        }
        let (stages, history) = recorder.finish();
        assert_eq!(stages.len(), 4);
        assert!(history.len() <= Solution::MAX_HISTORY);
        assert!(seen.0.windows(2).all(|pair| pair[0] <= pair[1]));
        assert_eq!(seen.0.last(), Some(&1.0));
    }
}
