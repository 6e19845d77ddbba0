//! Numbers, vectors and symmetric matrices of several tracks side by side: what is done, is done for all of them at
//! once in the processor's widest vectors. A track on its own fills a quarter of such a vector at best.
//!
//! Everything is inlined into its caller, which [`vectorised`](crate::simd::vectorised) compiles.

use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Sub};

/// Tracks side by side: two of the vectors of four that most processors have, so that one is computed with while the
/// other is on its way.
pub const LANES: usize = 8;

/// A number of every track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct F64x8(pub [f64; LANES]);

/// A truth of every track.
pub type Mask = [bool; LANES];

impl F64x8 {
    pub const ZERO: Self = Self([0.0; LANES]);
    pub const ONE: Self = Self([1.0; LANES]);

    #[inline(always)]
    pub fn map(self, f: impl Fn(f64) -> f64) -> Self {
        let mut mapped = self;
        let mut lane = 0;
        while lane < LANES {
            mapped.0[lane] = f(self.0[lane]);
            lane += 1;
        }
        mapped
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let mut zipped = self;
        let mut lane = 0;
        while lane < LANES {
            zipped.0[lane] = f(self.0[lane], other.0[lane]);
            lane += 1;
        }
        zipped
    }

    #[inline(always)]
    pub fn compare(self, other: Self, f: impl Fn(f64, f64) -> bool) -> Mask {
        let mut mask = [false; LANES];
        let mut lane = 0;
        while lane < LANES {
            mask[lane] = f(self.0[lane], other.0[lane]);
            lane += 1;
        }
        mask
    }

    /// This where the mask holds, the other elsewhere.
    #[inline(always)]
    pub fn or(self, mask: Mask, other: Self) -> Self {
        let mut chosen = self;
        let mut lane = 0;
        while lane < LANES {
            chosen.0[lane] = if mask[lane] { self.0[lane] } else { other.0[lane] };
            lane += 1;
        }
        chosen
    }

    #[inline(always)]
    pub fn sqrt(self) -> Self {
        self.map(f64::sqrt)
    }

    #[inline(always)]
    pub fn recip(self) -> Self {
        self.map(f64::recip)
    }
}

impl Add for F64x8 {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
}

impl Sub for F64x8 {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
}

impl Mul for F64x8 {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
}

impl Mul<f64> for F64x8 {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: f64) -> Self {
        self.map(|a| a * factor)
    }
}

impl Div for F64x8 {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
}

impl AddAssign for F64x8 {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl MulAssign for F64x8 {
    #[inline(always)]
    fn mul_assign(&mut self, other: Self) {
        *self = *self * other;
    }
}

/// A homogeneous point of every track.
pub type Points = [F64x8; 4];

/// Places of the diagonal in a [`Symmetric`] matrix.
pub const DIAGONAL: [usize; 4] = [0, 2, 5, 9];

/// A symmetric 4x4 matrix of every track: entry (a, b) with b <= a at a (a + 1) / 2 + b.
#[derive(Clone, Copy)]
pub struct Symmetric(pub [F64x8; 10]);

impl Symmetric {
    pub const ZERO: Self = Self([F64x8::ZERO; 10]);

    /// Where no camera tells the last unknown, as of cameras that are all at the origin, it stays what it is.
    #[inline(always)]
    pub fn hold_unseen(&mut self) {
        let last = &DIAGONAL[3];
        let is_unseen = self.0[*last].compare(F64x8::ZERO, |a, b| a == b);
        self.0[*last] = self.trace().or(is_unseen, self.0[*last]);
    }

    /// Adds `weight` times the outer product of a vector with itself.
    #[inline(always)]
    pub fn add_square(&mut self, weight: F64x8, v: Points) {
        let [a, b, c, d] = v;
        let [wa, wb, wc, wd] = [weight * a, weight * b, weight * c, weight * d];
        let m = &mut self.0;
        m[0] += wa * a;
        m[1] += wb * a;
        m[2] += wb * b;
        m[3] += wc * a;
        m[4] += wc * b;
        m[5] += wc * c;
        m[6] += wd * a;
        m[7] += wd * b;
        m[8] += wd * c;
        m[9] += wd * d;
    }

    #[inline(always)]
    pub fn trace(&self) -> F64x8 {
        let m = &self.0;
        m[0] + m[2] + m[5] + m[9]
    }

    #[inline(always)]
    pub fn times(&self, v: Points) -> Points {
        let m = &self.0;
        let [a, b, c, d] = v;
        [
            m[0] * a + m[1] * b + m[3] * c + m[6] * d,
            m[1] * a + m[2] * b + m[4] * c + m[7] * d,
            m[3] * a + m[4] * b + m[5] * c + m[8] * d,
            m[6] * a + m[7] * b + m[8] * c + m[9] * d,
        ]
    }

    #[inline(always)]
    pub fn columns(&self) -> [Points; 4] {
        let m = &self.0;
        [[m[0], m[1], m[3], m[6]], [m[1], m[2], m[4], m[7]], [m[3], m[4], m[5], m[8]], [m[6], m[7], m[8], m[9]]]
    }

    /// The matrix times itself.
    #[inline(always)]
    pub fn squared(&self) -> Self {
        let [a, b, c, d] = self.columns();
        Self([
            dot(a, a),
            dot(b, a),
            dot(b, b),
            dot(c, a),
            dot(c, b),
            dot(c, c),
            dot(d, a),
            dot(d, b),
            dot(d, c),
            dot(d, d),
        ])
    }

    #[inline(always)]
    pub fn scaled(&self, factor: F64x8) -> Self {
        let mut scaled = *self;
        let mut k = 0;
        while k < 10 {
            scaled.0[k] *= factor;
            k += 1;
        }
        scaled
    }

    /// Cholesky's factor (Golub & Van Loan, section 4.2); not a number where the matrix is not positive definite.
    #[inline(always)]
    pub fn factor(&self) -> Factor {
        let m = &self.0;
        let l00 = m[0].sqrt().recip();
        let (l10, l20, l30) = (m[1] * l00, m[3] * l00, m[6] * l00);
        let l11 = (m[2] - l10 * l10).sqrt().recip();
        let l21 = (m[4] - l20 * l10) * l11;
        let l31 = (m[7] - l30 * l10) * l11;
        let l22 = (m[5] - l20 * l20 - l21 * l21).sqrt().recip();
        let l32 = (m[8] - l30 * l20 - l31 * l21) * l22;
        let l33 = (m[9] - l30 * l30 - l31 * l31 - l32 * l32).sqrt().recip();
        Factor { inverted: [l00, l11, l22, l33], below: [l10, l20, l21, l30, l31, l32] }
    }
}

/// A lower triangular factor.
pub struct Factor {
    /// One over each entry of the diagonal.
    inverted: [F64x8; 4],
    /// The entries below it, row by row.
    below: [F64x8; 6],
}

impl Factor {
    #[inline(always)]
    pub fn solve(&self, right: Points) -> Points {
        let [d0, d1, d2, d3] = self.inverted;
        let [l10, l20, l21, l30, l31, l32] = self.below;
        let [a, b, c, d] = right;
        let a = a * d0;
        let b = (b - l10 * a) * d1;
        let c = (c - l20 * a - l21 * b) * d2;
        let d = (d - l30 * a - l31 * b - l32 * c) * d3;
        let d = d * d3;
        let c = (c - l32 * d) * d2;
        let b = (b - l21 * c - l31 * d) * d1;
        let a = (a - l10 * b - l20 * c - l30 * d) * d0;
        [a, b, c, d]
    }

    /// `L^-T L^-1`
    #[inline(always)]
    pub fn inverse(&self) -> Symmetric {
        let [d0, d1, d2, d3] = self.inverted;
        let [l10, l20, l21, l30, l31, l32] = self.below;
        // The inverse of the factor, below its diagonal.
        let i10 = F64x8::ZERO - l10 * d0 * d1;
        let i20 = F64x8::ZERO - (l20 * d0 + l21 * i10) * d2;
        let i21 = F64x8::ZERO - l21 * d1 * d2;
        let i30 = F64x8::ZERO - (l30 * d0 + l31 * i10 + l32 * i20) * d3;
        let i31 = F64x8::ZERO - (l31 * d1 + l32 * i21) * d3;
        let i32 = F64x8::ZERO - l32 * d2 * d3;
        Symmetric([
            d0 * d0 + i10 * i10 + i20 * i20 + i30 * i30,
            d1 * i10 + i21 * i20 + i31 * i30,
            d1 * d1 + i21 * i21 + i31 * i31,
            d2 * i20 + i32 * i30,
            d2 * i21 + i32 * i31,
            d2 * d2 + i32 * i32,
            d3 * i30,
            d3 * i31,
            d3 * i32,
            d3 * d3,
        ])
    }
}

#[inline(always)]
pub fn dot(v: Points, w: Points) -> F64x8 {
    v[0] * w[0] + v[1] * w[1] + v[2] * w[2] + v[3] * w[3]
}

#[inline(always)]
pub fn normalised(v: Points) -> Points {
    let factor = dot(v, v).sqrt().recip();
    [v[0] * factor, v[1] * factor, v[2] * factor, v[3] * factor]
}

#[inline(always)]
pub fn choose(mask: Mask, v: Points, w: Points) -> Points {
    [v[0].or(mask, w[0]), v[1].or(mask, w[1]), v[2].or(mask, w[2]), v[3].or(mask, w[3])]
}
