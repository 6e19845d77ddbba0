//! The training itself: steps, the average of the weights along the way, validation, and a state that can be put aside.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::gradient::{Losses, Slope, differentiate};
use super::{Error, Objective, adam, initial};
use crate::network::Parameter;
use crate::network::subspace::{Cloud, Origin, PriorFile, Shape, SubspaceNet};
use crate::synthetic::metrics::average_precision;
use crate::synthetic::training_scenes::{self, TrainingScene};

/// Batches of scenes in a step, which are differentiated side by side. Part of what a seed means, so not the number of
/// cores.
const BATCHES_PER_STEP: u64 = 2;
/// Steps between two milestones.
const STEPS_PER_MILESTONE: u64 = 200;
/// Batches that the average of the weights is validated on.
const VALIDATION_BATCHES: u64 = 12;
/// Weight of the past in the average of the weights, once there is one.
const MOST_PAST: f64 = 0.998;
/// Steps without a finite gradient in a row that end a training.
const MOST_REJECTED: u64 = 50;
/// Version of this program.
const PROGRAM: &str = env!("CARGO_PKG_VERSION");
/// Bytes of the SHA-256 that a saved state begins with: of a damaged one another network would come, under the name of
/// the one that was asked for.
const DIGEST_BYTES: usize = 32;
/// Layout of what follows.
const STATE_VERSION: u32 = 3;

/// What is trained, how long and from what.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    pub seed: u64,
    pub steps: u64,
    pub shape: Shape,
    pub objective: Objective,
}

impl Settings {
    /// Arguments of `scpsfm train-prior` that stand for these.
    pub fn arguments(&self) -> String {
        let objective = match self.objective {
            Objective::Labels => "",
            Objective::PaperLosses => " --unlabelled",
        };
        let pairs = if self.shape.strides > 0 { " --pairs" } else { "" };
        format!("--seed {} --steps {}{objective}{pairs}", self.seed, self.steps)
    }

    /// Seed of the scenes that the training is validated on, which it never sees.
    fn validation_seed(&self) -> u64 {
        !self.seed
    }
}

/// How a training stood after a number of steps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Milestone {
    pub step: u64,
    /// Training scenes seen.
    pub scenes: u64,
    /// Means since the last milestone.
    pub loss: f64,
    /// See [`Objective::parts`].
    pub parts: [f64; 2],
    /// Mean average precision on scenes that training never sees, of the average of the weights.
    pub precision: f64,
}

/// A training on its way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trainer {
    version: u32,
    /// Version of the program: another one may draw other scenes.
    program: String,
    settings: Settings,
    network: SubspaceNet<Parameter>,
    /// Average of the weights along the way, heavier on the latest: what is shipped.
    average: SubspaceNet<Vec<f32>>,
    step: u64,
    scenes: u64,
    /// Since the last milestone.
    sums: [f64; 3],
    summed: u64,
    rejected: u64,
    milestones: Vec<Milestone>,
}

impl Trainer {
    pub fn new(settings: Settings) -> Self {
        let network = initial::initial(settings.shape, settings.seed);
        Self {
            version: STATE_VERSION,
            program: PROGRAM.to_owned(),
            settings,
            average: network.map(|parameter| parameter.values().to_vec()),
            network,
            step: 0,
            scenes: 0,
            sums: [0.0; 3],
            summed: 0,
            rejected: 0,
            milestones: Vec::new(),
        }
    }

    /// Takes up a training that was put aside by [`Self::state`].
    ///
    /// # Errors
    /// [`Error::State`] for the state of another training, or of none.
    pub fn resume(state: &[u8], settings: Settings) -> Result<Self, Error> {
        let (digest, encoded) = state.split_at(state.len().min(DIGEST_BYTES));
        if Sha256::digest(encoded).as_slice() != digest {
            return Err(Error::State(
                "it is damaged, or not the state of a training: its checksum does not fit".into(),
            ));
        }
        let trainer: Self = rmp_serde::from_slice(encoded)
            .map_err(|error| Error::State(format!("it is not the state of a training: {error}")))?;
        if trainer.version != STATE_VERSION {
            let version = trainer.version;
            return Err(Error::State(format!("its layout is {version}, this program reads {STATE_VERSION}")));
        }
        if trainer.program != PROGRAM {
            return Err(Error::State(format!("it is of scpsfm {}, this is {PROGRAM}", trainer.program)));
        }
        if trainer.settings != settings {
            let arguments = trainer.settings.arguments();
            return Err(Error::State(format!("it belongs to a training with {arguments}")));
        }
        let shapes = settings.shape.arrays();
        let (network, average) = (trainer.network.arrays(), trainer.average.arrays());
        let shapes = shapes.arrays();
        let counted = [network.len(), average.len()] == [shapes.len(); 2];
        let fits = |((parameter, average), shape): ((&&Parameter, &&Vec<f32>), &&[usize; 2])| {
            parameter.is_whole() && parameter.shape() == **shape && average.len() == shape[0] * shape[1]
        };
        if !counted || !network.iter().zip(&average).zip(&shapes).all(fits) {
            return Err(Error::State("its arrays do not have the shape that it names".into()));
        }
        Ok(trainer)
    }

    /// Everything, to be taken up later.
    ///
    /// # Errors
    /// [`Error::State`] for a defect of the encoder.
    pub fn state(&self) -> Result<Vec<u8>, Error> {
        let encoded = rmp_serde::to_vec(self).map_err(|error| Error::State(error.to_string()))?;
        Ok([Sha256::digest(&encoded).as_slice(), &encoded].concat())
    }

    pub fn step(&self) -> u64 {
        self.step
    }

    pub fn is_finished(&self) -> bool {
        self.step >= self.settings.steps
    }

    /// Every milestone so far.
    pub fn milestones(&self) -> &[Milestone] {
        &self.milestones
    }

    /// Takes a step; the milestone, where one is reached.
    ///
    /// # Errors
    /// [`Error::Diverged`]; [`Error::Backend`] for a defect of burn.
    pub fn advance(&mut self) -> Result<Option<Milestone>, Error> {
        let slopes = self.slopes()?;
        let (losses, gradient) = mean(&slopes);
        if adam::step(&mut self.network, &gradient, adam::rate(self.step, self.settings.steps)) {
            self.rejected = 0;
            let [first, second] = losses.parts;
            self.sums = [self.sums[0] + losses.total, self.sums[1] + first, self.sums[2] + second];
            self.summed += 1;
        } else {
            self.rejected += 1;
            if self.rejected >= MOST_REJECTED {
                return Err(Error::Diverged { step: self.step, rejected: self.rejected });
            }
        }
        self.step += 1;
        self.update_average();
        let is_milestone = self.step.is_multiple_of(STEPS_PER_MILESTONE) || self.is_finished();
        Ok(is_milestone.then(|| self.milestone()))
    }

    /// The network as it stands: the average of the weights.
    pub fn file(&self, command: String) -> PriorFile {
        let version = PROGRAM.to_owned();
        let origin = Origin { version, command, seed: self.settings.seed, steps: self.step };
        PriorFile { origin, shape: self.settings.shape, network: self.average.clone() }
    }

    /// Losses and derivatives of the step's batches, each on a thread where there is more than one core.
    fn slopes(&mut self) -> Result<Vec<Slope>, Error> {
        let Settings { seed, objective, .. } = self.settings;
        let first = self.step * BATCHES_PER_STEP;
        let network = &self.network;
        let work = |number: u64| {
            let scenes = training_scenes::batch(seed, number);
            differentiate(network, &scenes, objective).map(|slope| (slope, scenes.len() as u64))
        };
        let threads = std::thread::available_parallelism().map_or(1, |count| count.get() as u64);
        let results: Vec<_> = if threads == 1 {
            (first..first + BATCHES_PER_STEP).map(work).collect()
        } else {
            std::thread::scope(|scope| {
                let running: Vec<_> =
                    (first..first + BATCHES_PER_STEP).map(|number| scope.spawn(move || work(number))).collect();
                let panicked = |_| Err(Error::Backend("a thread panicked".into()));
                running.into_iter().map(|thread| thread.join().unwrap_or_else(panicked)).collect()
            })
        };
        let mut slopes = Vec::with_capacity(results.len());
        for result in results {
            let (slope, scenes) = result?;
            self.scenes += scenes;
            slopes.push(slope);
        }
        Ok(slopes)
    }

    fn update_average(&mut self) {
        // At first the average follows closely: what the weights started from means nothing.
        let past = MOST_PAST.min((1 + self.step) as f64 / (10 + self.step) as f64) as f32;
        for (average, parameter) in self.average.arrays_mut().into_iter().zip(self.network.arrays()) {
            for (average, value) in average.iter_mut().zip(parameter.values()) {
                *average = past * *average + (1.0 - past) * value;
            }
        }
    }

    fn milestone(&mut self) -> Milestone {
        let [loss, first, second] = self.sums.map(|sum| sum / self.summed.max(1) as f64);
        (self.sums, self.summed) = ([0.0; 3], 0);
        let precision = validate(&self.average, self.settings.validation_seed());
        let (step, scenes) = (self.step, self.scenes);
        let milestone = Milestone { step, scenes, loss, parts: [first, second], precision };
        self.milestones.push(milestone);
        milestone
    }
}

/// Means over the batches, in their order.
fn mean(slopes: &[Slope]) -> (Losses, SubspaceNet<Vec<f32>>) {
    let share = 1.0 / slopes.len().max(1) as f64;
    let mut losses = Losses::default();
    let mut gradient = slopes[0].gradient.map(|array| vec![0.0f32; array.len()]);
    for slope in slopes {
        losses.total += share * slope.losses.total;
        for (sum, part) in losses.parts.iter_mut().zip(slope.losses.parts) {
            *sum += share * part;
        }
        for (sum, array) in gradient.arrays_mut().into_iter().zip(slope.gradient.arrays()) {
            for (sum, slope) in sum.iter_mut().zip(array) {
                *sum += share as f32 * slope;
            }
        }
    }
    (losses, gradient)
}

/// Mean average precision over the scenes of validation.
fn validate(network: &SubspaceNet<Vec<f32>>, seed: u64) -> f64 {
    let precision = |scene: &TrainingScene| {
        let cloud = Cloud::new(scene.views, scene.tracks, &scene.points, &scene.visible);
        let scores: Vec<f64> = network.forward(&cloud).tracks.into_iter().map(f64::from).collect();
        average_precision(&scores, &scene.inlier)
    };
    let found: Vec<f64> = (0..VALIDATION_BATCHES)
        .flat_map(|number| training_scenes::batch(seed, number))
        .filter_map(|scene| precision(&scene))
        .collect();
    found.iter().sum::<f64>() / found.len().max(1) as f64
}
