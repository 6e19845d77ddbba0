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

/// Average precision of scores that should rank the right ones first: the mean, over the right ones, of the share of
/// right ones among all that are ranked no lower. Equal scores keep their order. `None` where nothing is right.
///
/// # Panics
/// When the slices differ in length.
pub fn average_precision(scores: &[f64], truth: &[bool]) -> Option<f64> {
    assert_eq!(scores.len(), truth.len(), "scores and truth are of different lengths");
    let mut ranked: Vec<usize> = (0..scores.len()).collect();
    ranked.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    let (mut found, mut sum) = (0u32, 0.0);
    for (place, _) in ranked.iter().enumerate().filter(|&(_, &index)| truth[index]) {
        found += 1;
        sum += f64::from(found) / (place + 1) as f64;
    }
    (found > 0).then(|| sum / f64::from(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn average_precision_is_that_of_the_definition() {
        assert_eq!(average_precision(&[3.0, 2.0, 1.0], &[true, true, false]), Some(1.0));
        // Right ones at places 2 and 3: (1/2 + 2/3) / 2.
        let found = average_precision(&[3.0, 2.0, 1.0], &[false, true, true]).expect("right ones");
        assert!((found - 7.0 / 12.0).abs() < 1e-12, "{found}");
        assert_eq!(average_precision(&[1.0], &[false]), None);
    }

    #[test]
    fn counts_hits_misses_and_false_alarms() {
        let score = agreement(&[true, true, false, false], &[true, false, true, false]);
        assert_eq!((score.precision, score.recall, score.f1), (0.5, 0.5, 0.5));
        assert_eq!(agreement(&[false, false], &[true, false]).f1, 0.0);
    }
}
