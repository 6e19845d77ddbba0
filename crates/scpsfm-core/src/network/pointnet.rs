//! PointNet (Qi et al. 2017) with a segmentation head for the weights and a classification head for the plane at
//! infinity: the paper's architecture, every column of the measurement matrix being one point.
//!
//! Arrays are features x columns, like the measurement matrix itself, so a layer is `W X` and its statistics are taken
//! along rows.
//!
//! # The global feature and the batch statistics
//! PointNet feeds its segmentation head the concatenation of each point's local feature x and the cloud's global
//! feature g. The head's first layer is then `W_p x + W_g g`, where the second term is one vector for the whole cloud.
//! With statistics over the columns of one cloud, as here, the mean that the layer subtracts contains that vector, so
//! it cancels exactly and `W_g` never has a gradient. It is therefore not computed (a test shows that it changes
//! nothing); what the columns know of each other comes through the batch statistics. The fan-in that sets the initial
//! scale of `W_p` is still that of the concatenation.
//!
//! Subtracting the mean commutes with `W`: `W X - mean(W X) = W (X - mean X)`. The layers here centre their input,
//! which is the narrower side.

use burn_tensor::{Device, Tensor, TensorData};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Error;
use super::parameter::Parameter;

/// Features of the trunk at full width; the local feature is what leaves layer [`LOCAL_LAYER`].
const TRUNK: [usize; 5] = [64, 64, 64, 128, 1024];
/// Layer of the trunk, counted from 0, after which the local feature is taken.
pub const LOCAL_LAYER: usize = 1;
/// Hidden features of the segmentation head at full width.
const SEGMENTATION: [usize; 3] = [512, 256, 128];
/// Hidden features of the classification head at full width.
const CLASSIFICATION: [usize; 2] = [512, 256];
/// Features of a layer at least, however narrow the network.
const MIN_FEATURES: usize = 8;
/// Added to a variance before it divides. Small next to the variances of the first layers (about 1), large enough to
/// leave a feature that hardly varies alone.
pub const VARIANCE_FLOOR: f32 = 1e-3;
/// He et al. 2015: variance of a weight times its fan-in, for layers that rectify.
const RECTIFIED_GAIN: f64 = 2.0;
/// The same for the logits: small, so that all weights start near 1/2.
const LOGIT_GAIN: f64 = 0.1;
/// The same for the plane at infinity: smaller still, so that it starts near (0, 0, 0), a camera whose views differ by
/// a small rotation.
const PLANE_GAIN: f64 = 0.01;
/// Focal length at the start, in image widths: the middle of what lenses have.
const INITIAL_FOCAL: f64 = 1.5;

/// Weights of one layer; `gain` where it normalises.
#[derive(Debug, Clone)]
pub struct Layer<T> {
    pub weight: T,
    pub gain: Option<T>,
    pub bias: T,
}

/// The network's arrays, or something for each of them.
#[derive(Debug, Clone)]
pub struct PointNet<T> {
    pub trunk: Vec<Layer<T>>,
    pub segmentation: Vec<Layer<T>>,
    pub logit: Layer<T>,
    pub classification: Vec<Layer<T>>,
    pub plane: Layer<T>,
}

/// Logarithm of the focal length, the one parameter outside the PointNet.
pub fn initial_log_focal() -> Parameter {
    Parameter::constant([1, 1], INITIAL_FOCAL.ln() as f32)
}

/// Features of a layer that has `full` at width 1.
fn features(full: usize, width: f64) -> usize {
    MIN_FEATURES.max((full as f64 * width) as usize)
}

impl PointNet<Parameter> {
    /// A network for columns of `rows` entries.
    ///
    /// Every weight comes from one ChaCha8 stream in the order of the layers, so that a seed means the same network on
    /// every backend.
    pub fn new(rows: usize, width: f64, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let of_width = |full: &[usize]| full.iter().map(|&full| features(full, width)).collect::<Vec<_>>();
        let (trunk, segmentation, classification) =
            (of_width(&TRUNK), of_width(&SEGMENTATION), of_width(&CLASSIFICATION));
        let (local, global) = (trunk[LOCAL_LAYER], trunk[TRUNK.len() - 1]);
        let mut chain = |inputs: usize, sizes: &[usize], normalised: bool| {
            let mut inputs = inputs;
            let mut layers = Vec::with_capacity(sizes.len());
            for &outputs in sizes {
                layers.push(Layer::new([outputs, inputs], inputs, RECTIFIED_GAIN, normalised, &mut rng));
                inputs = outputs;
            }
            layers
        };
        let trunk = chain(rows, &trunk, true);
        let mut rest = chain(segmentation[0], &segmentation[1..], true);
        let classification_layers = chain(global, &classification, false);
        let first = Layer::new([segmentation[0], local], local + global, RECTIFIED_GAIN, true, &mut rng);
        let mut segmentation_layers = vec![first];
        segmentation_layers.append(&mut rest);
        let last = segmentation[segmentation.len() - 1];
        let logit = Layer::new([1, last], last, LOGIT_GAIN, false, &mut rng);
        let last = classification[classification.len() - 1];
        let plane = Layer::new([3, last], last, PLANE_GAIN, false, &mut rng);
        Self { trunk, segmentation: segmentation_layers, logit, classification: classification_layers, plane }
    }
}

impl Layer<Parameter> {
    fn new(shape: [usize; 2], fan_in: usize, gain: f64, normalised: bool, rng: &mut ChaCha8Rng) -> Self {
        let deviation = (gain / fan_in as f64).sqrt();
        let weights = (0..shape[0] * shape[1]).map(|_| (deviation * standard_normal(rng)) as f32).collect();
        Self {
            weight: Parameter::new(shape, weights),
            gain: normalised.then(|| Parameter::constant([shape[0], 1], 1.0)),
            bias: Parameter::constant([shape[0], 1], 0.0),
        }
    }
}

impl<T> PointNet<T> {
    /// Every array, in a fixed order that [`Self::arrays_mut`] shares.
    pub fn into_arrays(self) -> impl Iterator<Item = T> {
        let Self { trunk, segmentation, logit, classification, plane } = self;
        let layers = trunk.into_iter().chain(segmentation).chain([logit]).chain(classification).chain([plane]);
        layers.flat_map(|layer| [Some(layer.weight), layer.gain, Some(layer.bias)]).flatten()
    }

    /// Every array, to be changed.
    pub fn arrays_mut(&mut self) -> impl Iterator<Item = &mut T> {
        let Self { trunk, segmentation, logit, classification, plane } = self;
        let layers = trunk.iter_mut().chain(segmentation).chain([logit]).chain(classification).chain([plane]);
        layers.flat_map(|layer| [Some(&mut layer.weight), layer.gain.as_mut(), Some(&mut layer.bias)]).flatten()
    }
}

/// A constant `rows` x `columns` tensor from values row by row.
pub fn constant(values: Vec<f32>, shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The values of a tensor, row by row.
///
/// # Errors
/// [`Error::Backend`] when the tensor does not hold f32.
pub fn values_of(tensor: Tensor<2>) -> Result<Vec<f32>, Error> {
    tensor.into_data().try_into_vec().map_err(|error| Error::Backend(format!("{error:?}")))
}

/// Box-Muller; one of the pair is enough here.
pub fn standard_normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_shares_of_the_original() {
        let shapes = |width| PointNet::new(30, width, 0).trunk.iter().map(|layer| layer.bias.values().len()).collect();
        let (full, quarter, narrowest): (Vec<_>, Vec<_>, Vec<_>) = (shapes(1.0), shapes(0.25), shapes(0.01));
        assert_eq!(full, TRUNK);
        assert_eq!(quarter, [16, 16, 16, 32, 256]);
        assert_eq!(narrowest, [8, 8, 8, 8, 10]);
    }
}
