//! The same network on burn's autodiff: what the pass that is written out is compared with.

use burn_tensor::activation::relu;
use burn_tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::parameter::Parameter;
use super::pointnet::{LOCAL_LAYER, Layer, PointNet, VARIANCE_FLOOR, constant, standard_normal, values_of};

/// What the network says of a cloud of m columns.
struct Output {
    /// Logits of the weights, 1 x m.
    logits: Tensor<2>,
    /// Plane at infinity, 3 x 1.
    plane: Tensor<2>,
}

impl PointNet<Parameter> {
    /// The arrays as leaves of a new graph.
    fn leaves(&self, device: &Device) -> PointNet<Tensor<2>> {
        let layer = |layer: &Layer<Parameter>| Layer {
            weight: layer.weight.tensor(device).require_grad(),
            gain: layer.gain.as_ref().map(|gain| gain.tensor(device).require_grad()),
            bias: layer.bias.tensor(device).require_grad(),
        };
        let layers = |layers: &[Layer<Parameter>]| layers.iter().map(layer).collect();
        PointNet {
            trunk: layers(&self.trunk),
            segmentation: layers(&self.segmentation),
            logit: layer(&self.logit),
            classification: layers(&self.classification),
            plane: layer(&self.plane),
        }
    }
}

impl PointNet<Tensor<2>> {
    /// Runs the network on a cloud (rows x m) whose rows have mean 0.
    ///
    /// `slope`: of the segmentation head's rectifiers below 0.
    fn forward_on_tape(&self, centred: Tensor<2>, slope: f64) -> Output {
        let mut features = self.trunk[0].normalised(centred, 0.0);
        for layer in &self.trunk[1..=LOCAL_LAYER] {
            features = layer.normalised(centre(features), 0.0);
        }
        let local = centre(features);

        let mut features = self.segmentation[0].normalised(local.clone(), slope);
        for layer in &self.segmentation[1..] {
            features = layer.normalised(centre(features), slope);
        }
        let logits = self.logit.affine(features);

        let upper = &self.trunk[LOCAL_LAYER + 1..];
        let mut global = global_feature(upper, local);
        for layer in &self.classification {
            global = relu(layer.affine(global));
        }
        Output { logits, plane: self.plane.affine(global) }
    }
}

/// The largest response of every feature of the trunk's upper layers to a cloud whose rows have mean 0.
fn global_feature(layers: &[Layer<Tensor<2>>], local: Tensor<2>) -> Tensor<2> {
    let mut features = local;
    for (index, layer) in layers.iter().enumerate() {
        let input = if index == 0 { features } else { centre(features) };
        features = layer.normalised(input, 0.0);
    }
    features.max_dim(1)
}

impl Layer<Tensor<2>> {
    /// `W X + b`.
    fn affine(&self, input: Tensor<2>) -> Tensor<2> {
        self.weight.clone().matmul(input) + self.bias.clone()
    }

    /// `gain · W X / sqrt(var(W X) + ε) + b`, rectified with this slope below 0, for an X whose rows have mean 0, so
    /// that those of W X have, too.
    fn normalised(&self, centred: Tensor<2>, slope: f64) -> Tensor<2> {
        let response = self.weight.clone().matmul(centred);
        let columns = response.dims()[1] as f64;
        let variance = (response.clone() * response.clone()).sum_dim(1).div_scalar(columns);
        let deviation = variance.add_scalar(f64::from(VARIANCE_FLOOR)).sqrt();
        let scale = match &self.gain {
            Some(gain) => gain.clone() / deviation,
            None => deviation.recip(),
        };
        let output = response * scale + self.bias.clone();
        relu(output.clone()) - relu(-output).mul_scalar(slope)
    }
}

/// Subtracts the mean over the columns from every row.
fn centre(features: Tensor<2>) -> Tensor<2> {
    let columns = features.dims()[1] as f64;
    let mean = features.clone().sum_dim(1).div_scalar(columns);
    features - mean
}

impl<T> PointNet<T> {
    /// Every array, in the order of [`Self::arrays_mut`].
    pub fn arrays(&self) -> impl Iterator<Item = &T> {
        self.layers().flat_map(|layer| [Some(&layer.weight), layer.gain.as_ref(), Some(&layer.bias)]).flatten()
    }

    fn layers(&self) -> impl Iterator<Item = &Layer<T>> {
        let heads = self.segmentation.iter().chain([&self.logit]).chain(&self.classification).chain([&self.plane]);
        self.trunk.iter().chain(heads)
    }
}

/// Cloud of `rows` x `columns` normal numbers whose rows have mean 0.
fn cloud(rows: usize, columns: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let mut values: Vec<f32> = (0..rows * columns).map(|_| standard_normal(rng) as f32).collect();
    for row in values.chunks_exact_mut(columns) {
        let mean = row.iter().sum::<f32>() / columns as f32;
        row.iter_mut().for_each(|value| *value -= mean);
    }
    values
}

/// Output and derivatives of both, ReLU and leaky; 37 columns leave a remainder in every sum.
#[test]
fn the_pass_written_out_agrees_with_the_tape() {
    const SHAPE: [usize; 2] = [12, 37];
    for (seed, slope) in [(2, 0.0), (3, 0.1)] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut network = PointNet::new(SHAPE[0], 0.25, seed);
        // Gains and biases off their symmetric start, some gains negative.
        for array in network.arrays_mut() {
            let gradient: Vec<f32> = array.values().iter().map(|_| standard_normal(&mut rng) as f32).collect();
            array.step(&gradient, 0.1);
        }
        for layer in &mut network.trunk {
            let size = layer.bias.values().len();
            let gains = (0..size).map(|_| 1.0 - f32::from(standard_normal(&mut rng) > 1.0) * 2.0).collect();
            layer.gain = Some(Parameter::new([size, 1], gains));
        }
        let values = cloud(SHAPE[0], SHAPE[1], &mut rng);
        let on_logits: Vec<f32> = (0..SHAPE[1]).map(|_| 0.3 + standard_normal(&mut rng) as f32).collect();
        let on_plane = [0.5, -1.0, 0.25];

        let device = Device::flex().autodiff();
        let leaves = network.leaves(&device);
        let output = leaves.forward_on_tape(constant(values.clone(), SHAPE, &device), slope);
        let surrogate = (output.logits.clone() * constant(on_logits.clone(), [1, SHAPE[1]], &device)).sum()
            + (output.plane.clone() * constant(on_plane.to_vec(), [3, 1], &device)).sum();
        let mut reached = surrogate.backward();
        let expected: Vec<Option<Vec<f32>>> = leaves
            .arrays()
            .map(|leaf| leaf.grad_remove(&mut reached).map(|gradient| values_of(gradient).expect("f32")))
            .collect();

        let device = Device::flex();
        let pass =
            network.forward(&constant(values.clone(), SHAPE, &device), true, slope as f32, &device).expect("a pass");
        assert_near(&pass.logits, &values_of(output.logits.inner()).expect("f32"), "logits");
        assert_near(pass.plane().expect("computed"), &values_of(output.plane.inner()).expect("f32"), "plane");
        let unused = network.forward(&constant(values, SHAPE, &device), false, slope as f32, &device).expect("a pass");
        assert_eq!((&unused.logits, unused.plane()), (&pass.logits, None));
        let gradient = pass.backward(on_logits, Some(on_plane)).expect("a gradient");
        assert_eq!(gradient.arrays().count(), expected.len());
        for (index, (found, expected)) in gradient.arrays().zip(&expected).enumerate() {
            assert_eq!(found.is_some(), expected.is_some(), "array {index}, seed {seed}");
            if let (Some(found), Some(expected)) = (found, expected) {
                assert_near(found, expected, &format!("array {index}, seed {seed}"));
            }
        }
    }
}

fn assert_near(found: &[f32], expected: &[f32], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|value| value * value).sum::<f32>().sqrt();
    let (size, apart) = (
        norm(&mut expected.iter().copied()),
        norm(&mut found.iter().zip(expected).map(|(found, expected)| found - expected)),
    );
    assert!(size > 0.0 && apart <= 1e-4 * size, "{what}: apart by {apart} of {size}");
}

/// The first segmentation layer on [local | global], as PointNet has it, says the same whatever the global feature.
#[test]
fn the_global_feature_cancels_in_the_segmentation_head() {
    const COLUMNS: usize = 40;
    let device = Device::flex();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut draw = |count: usize| (0..count).map(|_| standard_normal(&mut rng) as f32).collect::<Vec<f32>>();
    let tensor = |values: Vec<f32>, shape| constant(values, shape, &device);
    let (local, global) = (tensor(draw(6 * COLUMNS), [6, COLUMNS]), tensor(draw(9), [9, 1]));
    let (on_local, on_global) = (tensor(draw(12 * 6), [12, 6]), tensor(draw(12 * 9), [12, 9]));
    let bias = tensor(draw(12), [12, 1]);
    let layer = |weight| Layer { weight, gain: None, bias: bias.clone() };

    let every_column = global.repeat_dim(1, COLUMNS);
    let concatenated = layer(Tensor::cat(vec![on_local.clone(), on_global], 1))
        .normalised(centre(Tensor::cat(vec![local.clone(), every_column], 0)), 0.0);
    let alone = layer(on_local).normalised(centre(local), 0.0);
    let pair = values_of(concatenated).expect("f32").into_iter().zip(values_of(alone).expect("f32"));
    assert!(pair.clone().any(|(a, _)| a > 1.0));
    for (a, b) in pair {
        assert!((a - b).abs() < 1e-5, "{a} and {b}");
    }
}
