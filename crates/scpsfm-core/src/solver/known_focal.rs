//! What focal priors of the views of one camera say of it together.

use crate::domain::{FocalPrior, View, Warning, WarningCode};

/// What is known beforehand of the one focal length of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownFocal {
    pub prior: FocalPrior,
    /// Views that have a prior.
    views: usize,
    /// The one whose prior is farthest from their mean, in its own standard deviations; how far, and its focal length
    /// in pixels.
    pub farthest: usize,
    deviations: f64,
    farthest_px: f64,
}

/// What is known of the one focal length of these views, each with its number; `None` where nothing is.
///
/// The priors of one camera's views tell one piece of knowledge several times: their mean, weighted by information,
/// has the standard deviation of one of them, not that of a mean. Where they differ, by so much more.
pub fn known_focal<'a>(views: impl Iterator<Item = (usize, &'a View)>) -> Option<KnownFocal> {
    let known: Vec<(usize, FocalPrior)> =
        views.filter_map(|(number, view)| Some((number, view.focal_prior?))).collect();
    let information = |prior: &FocalPrior| prior.sigma_log.powi(-2);
    let total: f64 = known.iter().map(|(_, prior)| information(prior)).sum();
    let weighted = |of: &dyn Fn(&FocalPrior) -> f64| {
        known.iter().map(|(_, prior)| information(prior) * of(prior)).sum::<f64>() / total
    };
    let mean = weighted(&|prior| prior.focal_px.ln());
    let spread = weighted(&|prior| (prior.focal_px.ln() - mean).powi(2));
    let of_one = known.len() as f64 / total;
    let deviations = |prior: &FocalPrior| (prior.focal_px.ln() - mean).abs() / prior.sigma_log;
    let (farthest, of_farthest) = known.iter().max_by(|a, b| deviations(&a.1).total_cmp(&deviations(&b.1)))?;
    Some(KnownFocal {
        prior: FocalPrior { focal_px: mean.exp(), sigma_log: (of_one + spread).sqrt() },
        views: known.len(),
        farthest: *farthest,
        deviations: deviations(of_farthest),
        farthest_px: of_farthest.focal_px,
    })
}

impl KnownFocal {
    /// Says that the priors contradict each other, where one differs from their mean by more than so many of its
    /// standard deviations, and by what the farthest of as many views may differ more.
    pub fn contradiction(&self, contradicted: f64) -> Option<Warning> {
        let FocalPrior { focal_px, sigma_log } = self.prior;
        let detail = format!(
            "the focal lengths that were given for views of one camera contradict each other: that of view {}, {:.1} \
             px, is {:.1} of its standard deviations from their mean; together they count as {focal_px:.1} px +- {:.0} %",
            self.farthest,
            self.farthest_px,
            self.deviations,
            100.0 * sigma_log
        );
        // Near the quantile of a normal distribution at the same share of false warnings, whatever the views.
        let most = (contradicted.powi(2) + 2.0 * (self.views as f64).ln()).sqrt();
        (self.deviations > most).then(|| Warning::new(WarningCode::FocalPriorContradicted, detail))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known(views: &[Option<(f64, f64)>]) -> Option<KnownFocal> {
        let view = |prior: &Option<(f64, f64)>| View {
            focal_prior: prior.map(|(focal_px, sigma_log)| FocalPrior { focal_px, sigma_log }),
            ..View::default()
        };
        let views: Vec<View> = views.iter().map(view).collect();
        known_focal(views.iter().enumerate())
    }

    #[test]
    fn priors_of_several_views_are_one_piece_of_knowledge() {
        assert_eq!(known(&[None, None]), None);
        let same = known(&[Some((800.0, 0.1)), None, Some((800.0, 0.1))]).expect("a prior");
        let FocalPrior { focal_px, sigma_log } = same.prior;
        assert!((focal_px - 800.0).abs() < 1e-9 && (sigma_log - 0.1).abs() < 1e-12, "{same:?}");
        assert_eq!(same.contradiction(3.0), None);
        let vague = known(&[Some((800.0, 0.01)), Some((1600.0, 1.0))]).expect("a prior");
        assert!((vague.prior.focal_px - 800.0).abs() < 1.0, "the vaguer one hardly counts: {vague:?}");
        assert_eq!(vague.contradiction(3.0), None);
    }

    #[test]
    fn priors_that_contradict_each_other_are_said_to() {
        let torn = known(&[Some((1600.0, 0.01)), None, Some((800.0, 0.01)), Some((1600.0, 0.01))]).expect("a prior");
        assert!((torn.prior.sigma_log - 2f64.sqrt() / 3.0 * 2f64.ln()).abs() < 1e-3, "{torn:?}");
        let warning = torn.contradiction(3.0).expect("a warning");
        assert_eq!(warning.code, WarningCode::FocalPriorContradicted);
        let told = "that of view 2, 800.0 px, is 46.2 of its standard deviations from their mean; together they count \
                    as 1269.9 px +- 33 %";
        assert!(warning.detail.ends_with(told), "{warning:?}");
        // One of a hundred.
        let mut views = vec![Some((800.0, 0.01)); 100];
        views[40] = Some((1000.0, 0.01));
        let warning = known(&views).and_then(|known| known.contradiction(3.0)).expect("a warning");
        assert!(warning.detail.contains("view 40, 1000.0 px"), "{warning:?}");
    }
}
