//! What each proposal found and what that cost, so that a result can say what each alone would have needed.

use super::OPTIONS;
use super::best::Best;
use crate::domain::Proposal;
use crate::domain::result::ProposalTime;

/// What one proposal found, and its cost.
pub struct ProposalStats {
    pub proposal: Proposal,
    pub seconds: f64,
    /// Network iterations, or hypotheses.
    pub work: u32,
    /// Every consensus better than its last.
    records: Vec<Record>,
}

/// A consensus of a proposal.
struct Record {
    /// Spent by then.
    seconds: f64,
    work: u32,
    inliers: usize,
    ln_false_alarms: f64,
}

impl ProposalStats {
    pub fn new(proposal: Proposal) -> Self {
        Self { proposal, seconds: 0.0, work: 0, records: Vec::new() }
    }

    /// Enters a consensus, if it is better than the last.
    pub fn record(&mut self, found: &Best) {
        if self.records.last().is_none_or(|last| found.ln_false_alarms < last.ln_false_alarms - OPTIONS.ln_margin) {
            self.records.push(Record {
                seconds: self.seconds,
                work: self.work,
                inliers: found.consensus.inlier_count(),
                ln_false_alarms: found.ln_false_alarms,
            });
        }
    }

    /// When this proposal first stood at a consensus as good as the accepted one.
    pub fn time(&self, accepted: Option<&Best>) -> ProposalTime {
        let sufficient = accepted.and_then(|accepted| {
            let inliers = OPTIONS.sufficient_share * accepted.consensus.inlier_count() as f64;
            let certainty = OPTIONS.sufficient_share * accepted.ln_false_alarms;
            let is_enough = |record: &&Record| record.inliers as f64 >= inliers && record.ln_false_alarms <= certainty;
            self.records.iter().find(is_enough)
        });
        ProposalTime {
            proposal: self.proposal,
            seconds: sufficient.map(|record| record.seconds),
            steps: sufficient.map_or(self.work, |record| record.work),
        }
    }
}
