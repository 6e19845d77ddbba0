//! Training scenes as tensors, and the derivatives of their loss.

use burn_tensor::{DType, Device, Tensor};

use super::labelled::{self, Labels};
use super::tape::{Batch, constant, numbers};
use super::{Error, Objective, unlabelled};
use crate::network::Parameter;
use crate::network::subspace::{Cloud, SubspaceNet};
use crate::synthetic::training_scenes::TrainingScene;

/// The losses of some scenes, each a mean over them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Losses {
    /// What is minimised.
    pub total: f64,
    /// By the last block, see [`Objective::parts`].
    pub parts: [f64; 2],
}

/// The losses at one point and their derivatives.
pub struct Slope {
    pub losses: Losses,
    pub gradient: SubspaceNet<Vec<f32>>,
}

/// Losses and derivatives of a network on scenes of one size.
///
/// # Errors
/// [`Error::Backend`] for a defect of burn; [`Error::NoDecomposition`] without labels, for columns that are not finite.
pub fn differentiate(
    network: &SubspaceNet<Parameter>,
    scenes: &[TrainingScene],
    objective: Objective,
) -> Result<Slope, Error> {
    let device = Device::flex().autodiff();
    let leaves = network.map(|parameter| parameter.tensor(&device).require_grad());
    let (batch, labels) = tensors(scenes, DType::F32, &device);
    let output = leaves.on_tape(&batch, DType::F32)?;
    let loss = match objective {
        Objective::Labels => labelled::loss(output, &labels),
        Objective::PaperLosses => unlabelled::loss(output, DType::F32)?,
    };
    let [first, second] = &loss.parts;
    let losses = Losses { total: number(&loss.total)?, parts: [number(first)?, number(second)?] };
    let mut reached = loss.total.backward();
    let mut failed = None;
    let gradient = leaves.map(|leaf| {
        let [rows, columns] = leaf.dims();
        match leaf.grad_remove(&mut reached).map(|gradient| gradient.into_data().try_into_vec()) {
            Some(Ok(gradient)) => gradient,
            // The last block's depths reach nothing; nor do the observations' layers, without labels.
            None => vec![0.0; rows * columns],
            Some(Err(error)) => {
                failed = Some(Error::Backend(format!("{error:?}")));
                Vec::new()
            }
        }
    });
    failed.map_or(Ok(Slope { losses, gradient }), Err)
}

/// What the network sees of scenes of one size, and what it should say.
pub fn tensors(scenes: &[TrainingScene], dtype: DType, device: &Device) -> (Batch, Labels) {
    let (views, tracks) = scenes.first().map_or((0, 0), |scene| (scene.views, scene.tracks));
    let count = scenes.len();
    let (mut places, mut visible) = (Vec::new(), Vec::new());
    let (mut inlier, mut of_tracks, mut right, mut of_observations) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let label = |right: &bool| f64::from(u8::from(*right));
    for scene in scenes {
        let cloud = Cloud::new(views, tracks, &scene.points, &scene.visible);
        places.extend(cloud.places().iter().map(|&place| f64::from(place)));
        visible.extend(cloud.visible().iter().map(|&seen| f64::from(seen)));
        inlier.extend(scene.inlier.iter().map(label));
        right.extend(scene.right.iter().map(label));
        let weights = labelled::weights(&scene.inlier, &vec![true; tracks]);
        let total: f64 = weights.iter().sum();
        of_tracks.extend(weights.into_iter().map(|weight| weight / (total * count as f64)));
        of_observations.extend(labelled::weights(&scene.right, &scene.visible));
    }
    let total: f64 = of_observations.iter().sum();
    of_observations.iter_mut().for_each(|weight| *weight /= total);
    let by_view = |values, features| constant(values, [count, views, features, tracks], dtype, device);
    let labels = Labels {
        tracks: constant(inlier, [count, 1, tracks], dtype, device),
        track_weights: constant(of_tracks, [count, 1, tracks], dtype, device),
        observations: by_view(right, 1),
        observation_weights: by_view(of_observations, 1),
    };
    (Batch { places: by_view(places, 2), visible: by_view(visible, 1) }, labels)
}

/// The value of a loss.
fn number(loss: &Tensor<1>) -> Result<f64, Error> {
    numbers(loss.clone())?.first().copied().ok_or_else(|| Error::Backend("a loss without a value".into()))
}
