//! Inputs with their truth.

use nalgebra::Vector3;
use scpsfm_core::evaluation::bound;
use scpsfm_core::evaluation::connection::connected_views;
use serde::{Deserialize, Serialize};

use crate::domain::error::InvalidInput;
use crate::domain::{ImageSize, RawInput};
use crate::synthetic::photographed::IMAGE_SIZE;
use crate::synthetic::scene::IMAGE_SIDE_PX;
use crate::synthetic::{Photographed, PhotographedOptions, Scene, SceneOptions, Sequence, SequenceOptions};

/// Right observations of tracks with three of them that a photographed view needs to count among those that shall be
/// registered.
const REGISTRABLE: usize = 15;

/// Images of all scenes and sequences but the photographed ones.
const SQUARE: ImageSize = ImageSize { width_px: IMAGE_SIDE_PX, height_px: IMAGE_SIDE_PX };

/// What makes an input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Generator {
    Scene(SceneOptions),
    Sequence(SequenceOptions),
    Photographed(PhotographedOptions),
}

impl Generator {
    /// The same with another seed.
    pub fn with_seed(&self, seed: u64) -> Self {
        match self {
            Generator::Scene(options) => Generator::Scene(SceneOptions { seed, ..options.clone() }),
            Generator::Sequence(options) => Generator::Sequence(SequenceOptions { seed, ..options.clone() }),
            Generator::Photographed(_) => Generator::Photographed(PhotographedOptions::drawn(seed)),
        }
    }

    /// The input and its truth.
    ///
    /// # Errors
    /// Options out of range.
    pub fn generate(&self) -> Result<Sample, InvalidInput> {
        Ok(match self {
            Generator::Scene(options) => {
                let scene = Scene::generate(options)?;
                let bounds = if options.own_cameras { bound::of_scene(&scene) } else { None };
                let Scene { input, truth, .. } = scene;
                Sample { bounds, ..Sample::new(SQUARE, input, truth.inlier, truth.observation_right, truth.focals_px) }
            }
            Generator::Sequence(options) => {
                let Sequence { input, truth, .. } = Sequence::generate(options)?;
                Sample::new(SQUARE, input, truth.inlier, truth.observation_right, truth.focals_px)
            }
            Generator::Photographed(options) => {
                let scene = Photographed::generate(options)?;
                let bounds = bound::of_photographed(&scene);
                let Photographed { input, truth, .. } = scene;
                let wanted = truth.verifiable(&input.track);
                let mut of_view = vec![0; input.views.len()];
                let views = input.view.iter().zip(&wanted).filter(|(_, wanted)| **wanted);
                views.for_each(|(&view, _)| of_view[view as usize] += 1);
                let due: Vec<bool> = of_view.into_iter().map(|count| count >= REGISTRABLE).collect();
                let places = input.view.iter().copied().zip(input.track.iter().copied()).zip(&wanted);
                let seen: Vec<(u32, u32)> = places.filter(|(_, wanted)| **wanted).map(|(place, _)| place).collect();
                let sets = connected_views(&seen, due.len()).into_iter();
                let largest = sets.map(|set| set.iter().filter(|&&view| due[view]).count()).max().unwrap_or(0);
                let connected = largest as f64 / due.iter().filter(|&&due| due).count().max(1) as f64;
                let centres = Some(truth.centres());
                let right = truth.observation_right;
                let sample = Sample::new(IMAGE_SIZE, input, truth.inlier, right, truth.focals_px);
                Sample { bounds, wanted, due, connected, centres, ..sample }
            }
        })
    }
}

/// An input and its truth.
#[derive(Debug, Clone)]
pub struct Sample {
    /// Of all images.
    pub size: ImageSize,
    pub input: RawInput,
    /// Whether a track is right.
    pub inlier: Vec<bool>,
    /// Whether an observation is right.
    pub right: Vec<bool>,
    /// Whether an observation shall be kept.
    pub wanted: Vec<bool>,
    /// Whether a view shall be registered.
    pub due: Vec<bool>,
    /// Share of these views that right observations connect, at most.
    pub connected: f64,
    /// True focal length of each view.
    pub focals_px: Vec<f64>,
    /// Cramer-Rao bound of the standard deviation of each view's log focal length, where it is known.
    pub bounds: Option<Vec<f64>>,
    /// Where the camera of each view is, where it is known.
    pub centres: Option<Vec<Vector3<f64>>>,
}

impl Sample {
    /// Of all views, and of the right observations of right tracks, an answer is expected; no bound is known.
    fn new(size: ImageSize, input: RawInput, inlier: Vec<bool>, right: Vec<bool>, focals_px: Vec<f64>) -> Self {
        let wanted = right.iter().zip(&input.track).map(|(&right, &k)| right && inlier[k as usize]).collect();
        let due = vec![true; input.views.len()];
        Self { size, due, connected: 1.0, input, inlier, right, wanted, focals_px, bounds: None, centres: None }
    }

    /// True focal length of each view and the bound of its estimate.
    pub fn focals(&self) -> impl Iterator<Item = (f64, Option<f64>)> {
        let bound = |view: usize| self.bounds.as_ref().map(|bounds| bounds[view]);
        self.focals_px.iter().enumerate().map(move |(view, &focal_px)| (focal_px, bound(view)))
    }
}
