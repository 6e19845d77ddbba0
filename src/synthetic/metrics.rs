//! How good an answer is, given the truth.

/// Precision, recall and their harmonic mean over a set of yes/no answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    pub precision: f64,
    pub recall: f64,
    pub f1: f64,
}

/// Compares answers with the truth, element by element. Nothing found, or nothing to find, counts as 0.
///
/// # Panics
/// When the slices differ in length.
pub fn agreement(found: &[bool], truth: &[bool]) -> Agreement {
    assert_eq!(found.len(), truth.len(), "answers and truth are of different lengths");
    let hits = found.iter().zip(truth).filter(|(found, truth)| **found && **truth).count() as f64;
    let claimed = found.iter().filter(|found| **found).count() as f64;
    let real = truth.iter().filter(|truth| **truth).count() as f64;
    let ratio = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
    Agreement { precision: ratio(hits, claimed), recall: ratio(hits, real), f1: ratio(2.0 * hits, claimed + real) }
}

#[cfg(test)]
mod tests {
    use super::agreement;

    #[test]
    fn counts_hits_misses_and_false_alarms() {
        let score = agreement(&[true, true, false, false], &[true, false, true, false]);
        assert_eq!((score.precision, score.recall, score.f1), (0.5, 0.5, 0.5));
        assert_eq!(agreement(&[false, false], &[true, false]).f1, 0.0);
    }
}
