//! Sums along a row of f32, several at a time.

/// Partial sums of a row, so that they can be added side by side: four registers of four numbers, or one of sixteen.
const LANES: usize = 16;

/// Sum of a row.
#[inline(always)]
pub fn sum(row: &[f32]) -> f32 {
    let (chunks, rest) = row.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for chunk in chunks {
        let mut lane = 0;
        while lane < LANES {
            sums[lane] += chunk[lane];
            lane += 1;
        }
    }
    let mut total = 0.0;
    for value in rest {
        total += value;
    }
    total + across(&sums)
}

/// Scalar product of two rows of one length.
///
/// Loops by hand: iterators are not always inlined where this is, and then take three times as long.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, rest_of_a), (b, rest_of_b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    let mut chunk = 0;
    while chunk < a.len().min(b.len()) {
        let (a, b) = (&a[chunk], &b[chunk]);
        let mut lane = 0;
        while lane < LANES {
            sums[lane] += a[lane] * b[lane];
            lane += 1;
        }
        chunk += 1;
    }
    let mut total = 0.0;
    let mut k = 0;
    while k < rest_of_a.len().min(rest_of_b.len()) {
        total += rest_of_a[k] * rest_of_b[k];
        k += 1;
    }
    total + across(&sums)
}

/// Sum of the partial sums, in their order.
#[inline(always)]
fn across(sums: &[f32; LANES]) -> f32 {
    let mut total = 0.0;
    let mut lane = 0;
    while lane < LANES {
        total += sums[lane];
        lane += 1;
    }
    total
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
