//! The best consensus so far, and when it is good enough.

use super::OPTIONS;
use crate::domain::Proposal;
use crate::solver::a_contrario::FalseAlarmOptions;
use crate::solver::consensus::{Consensus, LEAST_INLIERS};

const VERIFICATION: FalseAlarmOptions = FalseAlarmOptions::DEFAULT;

/// What a consensus was verified by.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum VerifiedBy {
    /// Image points alone, under projective cameras.
    #[default]
    ImagePoints,
    /// Image points and depths, under one focal length and rigid motion.
    Depths {
        /// Of the calibrated cameras that the consensus has, normalised units.
        focal: f64,
    },
}

/// A consensus, where it came from and how likely it is to be chance.
pub struct Best {
    pub consensus: Consensus,
    pub proposal: Proposal,
    pub ln_false_alarms: f64,
    pub verified_by: VerifiedBy,
    /// Inliers that count where few are verified, see
    /// [`TrackScores::counted`](crate::solver::learned::TrackScores::counted).
    pub counted: usize,
}

impl Best {
    pub fn decides(&self) -> bool {
        self.is_verified() && self.ln_false_alarms < VERIFICATION.ln_decisive
    }

    pub fn is_acceptable(&self) -> bool {
        self.is_verified() && self.ln_false_alarms < VERIFICATION.ln_acceptable
    }

    /// Its inliers and how many of them count, where that is what keeps it from being accepted.
    pub fn rejected_by_network(&self) -> Option<(usize, usize)> {
        let inliers = self.consensus.inlier_count();
        let only_by_count =
            inliers >= LEAST_INLIERS && !self.is_verified() && self.ln_false_alarms < VERIFICATION.ln_acceptable;
        only_by_count.then_some((inliers, self.counted))
    }

    /// Whether there are enough inliers for its kind of evidence.
    fn is_verified(&self) -> bool {
        match self.verified_by {
            VerifiedBy::ImagePoints => self.counted >= LEAST_INLIERS,
            VerifiedBy::Depths { .. } => true,
        }
    }

    /// Whether it displaces another: clearly less likely to be chance, the proposal that came first wins. Of different
    /// evidence, what image points alone verify beyond doubt is better: it holds whatever the depths are worth. An
    /// extension, which is not tested against chance, is not (`Attempt::outweighs`).
    ///
    /// Costs would not do to compare by: they depend on the noise that each was grown at.
    pub fn displaces(&self, other: &Self) -> bool {
        match (self.verified_by, other.verified_by) {
            (VerifiedBy::ImagePoints, VerifiedBy::Depths { .. }) => self.decides(),
            (VerifiedBy::Depths { .. }, VerifiedBy::ImagePoints) => self.is_acceptable() && !other.decides(),
            // What cannot be accepted keeps nothing out that can.
            _ if self.is_verified() != other.is_verified() => self.is_verified(),
            _ if self.is_acceptable() != other.is_acceptable() => self.is_acceptable(),
            _ => self.ln_false_alarms < other.ln_false_alarms - OPTIONS.ln_margin,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_verified_keeps_nothing_out_that_is() {
        let best = |counted, ln_false_alarms| Best {
            consensus: Consensus {
                cameras: Vec::new(),
                points: Vec::new(),
                squared: Vec::new(),
                inlier: vec![true; 12],
                noise: 1e-3,
                score: 0.5,
            },
            proposal: Proposal::Uniform,
            ln_false_alarms,
            verified_by: VerifiedBy::ImagePoints,
            counted,
        };
        let (rejected, verified) = (best(7, -100.0), best(9, -50.0));
        assert!(verified.displaces(&rejected) && !rejected.displaces(&verified));
        assert!(verified.decides() && !rejected.decides() && !rejected.is_acceptable());
        // As of cameras that admit any track.
        let (vetoed, barely) = (best(9, -7.0), best(9, -8.0));
        assert!(barely.displaces(&vetoed) && !vetoed.displaces(&barely));
        assert!(best(9, -60.0).displaces(&verified) && !best(9, -51.0).displaces(&verified));
    }
}
