//! What `scpsfm evaluate` lets one choose from: sweeps, ways of giving depths, methods.

use clap::ValueEnum;

use crate::evaluation::plan::{Contestant, Depths};

/// [`Sweep`](crate::evaluation::Sweep) on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum SweepArg {
    /// Tracks m, 50 to 1000 in 20 views
    Points,
    /// Share of outliers, .5 to .98
    Outliers,
    /// Noise, .1 to 2 % of the width
    Noise,
    /// Views n, 5 to 100 of 500 tracks
    Views,
    /// Noise, 3 to 11 % (the supplement)
    StrongNoise,
    /// Rotations to 3.1 rad, .5 to .97 outliers
    Orbit,
    /// Uniform, slid, repeated outliers, a second motion
    Structured,
    /// Outliers that are wrong in 1, 2, 5 of 10 views
    Partial,
    /// Noise, 1 to 5 %, of 8 right tracks among 200
    NoiseOfFew,
    /// Noise that is not Gaussian
    NoiseKind,
    /// Critical motions and a planar scene
    Motion,
    /// Displaced principal points, distortion, zooms
    Lens,
}

/// [`Depths`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DepthsArg {
    /// True up to noise
    Given,
    /// Image points alone
    None,
    /// Estimated from fundamental matrices and epipoles
    Epipolar,
}

/// [`Contestant`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ContestantArg {
    /// Knows the truth: the limit
    Oracle,
    /// The network's prior and geometry together
    Auto,
    /// Geometry alone
    Geometry,
    /// The paper's network under its objective as printed
    Paper,
    /// The same without its self-calibration term
    PaperWithoutDaq,
    /// The paper's network by itself under a continued objective
    Scpsfm,
    /// The same without its self-calibration term
    ScpsfmWithoutDaq,
    /// Plain projective factorisation at its best threshold
    Psfm,
}

impl From<DepthsArg> for Depths {
    fn from(depths: DepthsArg) -> Self {
        match depths {
            DepthsArg::Given => Depths::Given,
            DepthsArg::None => Depths::None,
            DepthsArg::Epipolar => Depths::Epipolar,
        }
    }
}

impl From<ContestantArg> for Contestant {
    fn from(contestant: ContestantArg) -> Self {
        match contestant {
            ContestantArg::Oracle => Contestant::Oracle,
            ContestantArg::Auto => Contestant::Auto,
            ContestantArg::Geometry => Contestant::Geometry,
            ContestantArg::Paper => Contestant::Paper,
            ContestantArg::PaperWithoutDaq => Contestant::PaperWithoutDaq,
            ContestantArg::Scpsfm => Contestant::Scpsfm,
            ContestantArg::ScpsfmWithoutDaq => Contestant::ScpsfmWithoutDaq,
            ContestantArg::Psfm => Contestant::Psfm,
        }
    }
}
