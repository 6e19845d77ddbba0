use super::*;
use crate::evaluation::observations::FocalError;

fn answer(grade: Option<Grade>, log_errors: &[f64], bound: Option<f64>) -> Measured {
    let focal = |&log_error: &f64| FocalError { log_error, sigma: Some(0.01), bound };
    Measured {
        grade,
        focals: log_errors.iter().map(focal).collect(),
        bound,
        kept: 10,
        wanted: 10,
        due: 3,
        connected: 1.0,
        precision: 1.0,
        recall: 0.5,
        views: 1.0,
        ..Measured::default()
    }
}

#[test]
fn a_row_tells_refused_from_impossible_and_belied_from_covered() {
    let (metric, weak) = (Some(Grade::Metric), Some(Grade::Weak));
    let nothing = Measured { kept: 0, precision: 0.0, recall: 0.0, views: 0.0, ..answer(None, &[], Some(0.005)) };
    let answers = [
        answer(metric, &[0.005], Some(0.005)),
        answer(metric, &[0.035], Some(0.005)),
        Measured { second_structure: true, ..answer(metric, &[0.005, -0.05], Some(0.02)) },
        Measured { connected: 0.0, ..answer(weak, &[0.02], None) },
        nothing,
    ];
    let row = Row::of("all", Side::Scpsfm, &answers.iter().collect::<Vec<_>>());
    assert_eq!((row.scenes, row.metric, row.weak), (5, 3, 1));
    assert_eq!((row.carries, row.metric_of_carrying), (0.6, Some(2.0 / 3.0)));
    // 3.5 sigma, and the root mean square of .5 and 5: beyond 3; off by more than 4 sigma only the latter.
    assert_eq!((row.metric_belied, row.metric_wrong), (Some(2.0 / 3.0), 1));
    assert_eq!((row.coverage, row.weak_belied), (Some(1.0 / 3.0), Some(0.0)));
    assert_eq!(row.second_structure, Some(0.2));
    assert_eq!(Row::of("all", Side::Peer, &answers.iter().collect::<Vec<_>>()).second_structure, None);
    // What keeps nothing makes no false claim, and finds nothing.
    assert_eq!((row.precision, row.recall, row.views), (Some(1.0), Some(0.4), Some(0.8)));
    assert_eq!(row.connected, Some(0.8));
}

#[test]
fn peers_get_the_scenes_of_one_camera() {
    let plan = Plan { scenes: scenes(FIRST_SEED..FIRST_SEED + 60), peer: vec!["peer".to_owned()] };
    assert_eq!((plan.scenes.len(), plan.runs().len()), (60, 60 + 20));
}

#[test]
fn names_of_scenes_consist_of_the_words() {
    let words = words();
    let known: Vec<&str> = words.split([' ', ',', '(', ')']).collect();
    for scene in scenes(FIRST_SEED..FIRST_SEED + 60) {
        assert!(scene.name().split('/').all(|word| known.contains(&word)), "{} in {words}", scene.name());
    }
}
