//! Sums along a row of f32, several at a time.

/// Partial sums of a row, so that they can be added side by side: four registers of four numbers, or one of sixteen.
const LANES: usize = 16;

/// Sum of a row.
#[inline(always)]
pub fn sum(row: &[f32]) -> f32 {
    let mut sums = [0.0; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += value;
        }
    }
    rest + sums.iter().sum::<f32>()
}

/// Scalar product of two rows.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; LANES];
    let (a, b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a.zip(b) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    rest + sums.iter().sum::<f32>()
}

/// Largest of a row times a sign; what is not a number is passed over.
#[inline(always)]
pub fn maximum(row: &[f32], sign: f32) -> f32 {
    let mut highest = [f32::NEG_INFINITY; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest = chunks.remainder().iter().fold(f32::NEG_INFINITY, |highest, value| highest.max(value * sign));
    for chunk in chunks {
        for (highest, value) in highest.iter_mut().zip(chunk) {
            let value = value * sign;
            *highest = if value > *highest { value } else { *highest };
        }
    }
    highest.iter().fold(rest, |highest, &value| highest.max(value))
}
