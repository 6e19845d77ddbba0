//! The losses against numbers that another program computed.
//!
//! The constants come from an evaluation in numpy that shares nothing with this code but the formulas: singular values
//! and the span from an SVD of `M diag(w)` itself instead of an eigen-decomposition of its scatter matrix; cameras in
//! the frame `P₁ = [I|0]` by a pseudo-inverse and a null vector; the DAQ as the 4x4 matrix of the paper's eq. 5 and
//! `S_i = P_i Q P_iᵀ`; every derivative by central differences of sixth order (steps of 4e-4 and 2e-4 agree to 5e-12).
//! The floors under square roots and the direction that fixes the sign of the fourth columns are the documented ones
//! of this folder: without them the two could not agree in the last digits.

use nalgebra::DMatrix;

use super::*;

const VIEWS: usize = 3;
const TRACKS: usize = 12;
/// The paper's own but for the slope of the sigmoid.
const TERMS: Terms = terms(20.0);

const fn terms(kappa: f64) -> Terms {
    Terms { count: CountTerm::Sigmoid { min_inliers: 6.0, kappa }, rank: RankTerm::TAIL, daq_moves_weights: true }
}

/// Logarithm of the focal length and plane at infinity at which the derivatives were taken and the descent began.
const LOG_FOCAL: f64 = 0.3;
const PLANE: [f64; 3] = [0.2, -0.1, 0.3];
/// Weights of L_proj and L_DAQ in the descent, and its step.
const ALPHA: f64 = 2.0;
const BETA: f64 = 1.0;
const RATE: f64 = 0.05;

/// Losses are to agree to this: the reference's were computed in f64 and written to 12 decimals.
const LOSS_TOLERANCE: f64 = 1e-9;
/// Derivatives: what finite differences are good for.
const SLOPE_TOLERANCE: f64 = 1e-9;
/// After ten steps along them, whose errors add up.
const TRACE_TOLERANCE: f64 = 1e-8;

const NUM: f64 = 1.348_328_270_090;
const PROJ: f64 = 0.820_572_660_133;
const DAQ: f64 = 1.903_708_488_626;
/// L_num with the paper's literal sigmoid, kappa = 1.
const NUM_LITERAL: f64 = 1.020_471_706_864;
const SLOPE_NUM: [f64; TRACKS] = [
    -0.577_433_141_116,
    -1.994_613_889_075,
    -5.526_848_345_413,
    -0.791_852_488_429,
    -0.811_237_286_542,
    -5.676_785_173_045,
    -1.913_666_401_772,
    -0.577_700_349_895,
    -2.079_605_349_918,
    -5.372_329_934_696,
    -0.773_591_914_884,
    -0.831_801_304_968,
];
const SLOPE_NUM_LITERAL: [f64; TRACKS] = [
    -0.252_829_880_977,
    -0.254_173_740_559,
    -0.254_986_999_391,
    -0.253_211_466_883,
    -0.253_239_563_317,
    -0.255_005_133_800,
    -0.254_135_351_785,
    -0.252_830_460_181,
    -0.254_211_967_281,
    -0.254_967_618_007,
    -0.253_184_212_168,
    -0.253_268_476_355,
];
const SLOPE_PROJ: [f64; TRACKS] = [
    0.112_696_866_106,
    0.076_159_060_707,
    0.079_358_491_004,
    0.090_051_933_629,
    0.095_185_561_301,
    0.171_849_645_535,
    0.073_417_544_120,
    0.016_501_898_591,
    0.035_549_099_779,
    0.230_287_486_401,
    0.419_626_180_601,
    0.608_211_023_323,
];
const SLOPE_DAQ: [f64; TRACKS] = [
    0.055_688_653_448,
    0.106_735_820_055,
    0.087_881_498_296,
    -0.162_563_645_048,
    0.166_428_426_516,
    0.060_306_717_120,
    0.123_501_299_972,
    0.042_828_919_152,
    -0.035_400_746_133,
    -0.321_929_985_148,
    -0.151_930_608_341,
    -0.193_726_343_208,
];
const SLOPE_LOG_FOCAL: f64 = 0.445_341_494_178;
const SLOPE_PLANE: [f64; 3] = [-0.108_914_027_532, -0.078_923_352_303, -0.282_870_460_629];
/// L_num, L_proj, L_DAQ before each step of the descent and after the last.
const TRACE: [[f64; 3]; 11] = [
    [1.348_328_270_090, 0.820_572_660_133, 1.903_708_488_626],
    [1.065_095_520_566, 0.829_412_555_402, 1.886_790_408_003],
    [0.854_021_300_705, 0.836_547_377_892, 1.869_450_391_204],
    [0.704_859_250_190, 0.842_040_384_766, 1.851_993_123_978],
    [0.600_815_223_764, 0.846_148_399_320, 1.834_502_204_788],
    [0.527_117_375_350, 0.849_169_490_576, 1.816_872_795_944],
    [0.473_474_827_403, 0.851_356_607_850, 1.798_878_644_269],
    [0.433_272_505_493, 0.852_901_343_525, 1.780_218_311_900],
    [0.402_314_530_292, 0.853_944_002_843, 1.760_540_003_244],
    [0.377_900_322_738, 0.854_587_394_988, 1.739_456_380_644],
    [0.358_247_778_094, 0.854_908_011_064, 1.716_557_705_320],
];
/// Where the descent ended.
const LAST_WEIGHTS: [f64; TRACKS] = [
    0.689_344_222_228,
    0.638_553_144_621,
    0.545_643_160_122,
    0.336_537_403_923,
    0.330_660_385_945,
    0.544_319_528_932,
    0.639_754_283_805,
    0.694_660_902_329,
    0.641_555_713_981,
    0.542_521_589_039,
    0.316_912_078_247,
    0.314_829_296_874,
];
const LAST_LOG_FOCAL: f64 = 0.110_762_807_852;
const LAST_PLANE: [f64; 3] = [0.217_183_199_860, 0.018_258_586_245, 0.475_949_212_091];

/// Entries `sin(1 + .7 i + 1.3 j + .11 i j)`, columns at unit norm: full rank, no two singular values close.
fn matrix() -> DMatrix<f64> {
    let entry = |i: usize, j: usize| (1.0 + 0.7 * i as f64 + 1.3 * j as f64 + 0.11 * (i * j) as f64).sin();
    let mut matrix = DMatrix::from_fn(3 * VIEWS, TRACKS, entry);
    for mut column in matrix.column_iter_mut() {
        column /= column.norm();
    }
    matrix
}

/// Logits `.8 cos(.9 j)` of the weights.
fn logits() -> Vec<f64> {
    (0..TRACKS).map(|j| 0.8 * (0.9 * j as f64).cos()).collect()
}

fn weights(logits: &[f64]) -> Vec<f64> {
    logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect()
}

fn assert_close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    for (k, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((found - expected).abs() < tolerance, "{what} [{k}]: {found:.12} is not {expected:.12}");
    }
}

#[test]
fn losses_and_derivatives_are_those_of_the_reference() {
    let (matrix, w) = (matrix(), weights(&logits()));
    let found = evaluate(&matrix, &w, LOG_FOCAL, PLANE, TERMS).expect("a finite matrix");
    let Losses { num, proj, daq } = found.losses;
    assert_close("losses", &[num, proj, daq], &[NUM, PROJ, DAQ], LOSS_TOLERANCE);
    assert_close("dL_num/dw", &found.grad_w_num, &SLOPE_NUM, SLOPE_TOLERANCE);
    assert_close("dL_proj/dw", &found.grad_w_proj, &SLOPE_PROJ, SLOPE_TOLERANCE);
    assert_close("dL_DAQ/dw", &found.grad_w_daq, &SLOPE_DAQ, SLOPE_TOLERANCE);
    assert_close("dL_DAQ/d log f", &[found.grad_log_focal], &[SLOPE_LOG_FOCAL], SLOPE_TOLERANCE);
    assert_close("dL_DAQ/dn", &found.grad_n_inf, &SLOPE_PLANE, SLOPE_TOLERANCE);

    let found = evaluate(&matrix, &w, LOG_FOCAL, PLANE, terms(1.0)).expect("a finite matrix");
    assert_close("literal L_num", &[found.losses.num], &[NUM_LITERAL], LOSS_TOLERANCE);
    assert_close("its slope", &found.grad_w_num, &SLOPE_NUM_LITERAL, SLOPE_TOLERANCE);
}

/// Ten steps of plain gradient descent over the logits of the weights, the logarithm of the focal length and the plane
/// at infinity.
#[test]
fn a_descent_takes_the_path_of_the_reference() {
    let matrix = matrix();
    let (mut logits, mut log_focal, mut plane) = (logits(), LOG_FOCAL, PLANE);
    for (step, expected) in TRACE.iter().enumerate() {
        let w = weights(&logits);
        let found = evaluate(&matrix, &w, log_focal, plane, TERMS).expect("a finite matrix");
        let Losses { num, proj, daq } = found.losses;
        assert_close(&format!("losses before step {step}"), &[num, proj, daq], expected, TRACE_TOLERANCE);
        if step + 1 == TRACE.len() {
            break;
        }
        for (j, logit) in logits.iter_mut().enumerate() {
            let slope = found.grad_w_num[j] + ALPHA * found.grad_w_proj[j] + BETA * found.grad_w_daq[j];
            *logit -= RATE * slope * w[j] * (1.0 - w[j]);
        }
        log_focal -= RATE * BETA * found.grad_log_focal;
        for (axis, slope) in found.grad_n_inf.iter().enumerate() {
            plane[axis] -= RATE * BETA * slope;
        }
    }
    assert_close("last weights", &weights(&logits), &LAST_WEIGHTS, TRACE_TOLERANCE);
    assert_close("last log f", &[log_focal], &[LAST_LOG_FOCAL], TRACE_TOLERANCE);
    assert_close("last plane", &plane, &LAST_PLANE, TRACE_TOLERANCE);
}
