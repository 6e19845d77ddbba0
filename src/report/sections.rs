//! The sections of the page, top to bottom.

use std::fmt::Write;

use super::chart::{self, LineChart, Series};
use super::html::{escape, short};
use super::words;
use crate::domain::result::ProposalTime;
use crate::domain::{Calibration, Grade, HeadProgress, LensProjection, Losses, Progress, Solution, Status, counted};
use crate::formats::LabelledInput;
use crate::formats::track_counts::TrackCounts;
use crate::formats::warnings::named;

/// A focal length beyond this factor of the final one is drawn at the edge of its chart.
const FOCAL_CLIP: f64 = 2.5;
const NETWORK_ITERATION: &str = "network iteration";

/// Title, outcome and the figures that matter.
pub fn headline(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let (badge, tone) = match (solution.status, solution.grade) {
        (Status::NoReconstruction, _) => ("NO_RECONSTRUCTION", "bad"),
        (_, Some(grade)) => (grade.name(), if grade == Grade::Metric { "good" } else { "fair" }),
        (_, None) => ("SOLVED", "fair"),
    };
    let mut html = format!(
        "<header id=\"headline\">\n<h1>scpsfm report <span class=\"badge {tone}\">{badge}</span></h1>\n<p>{}</p>\n<dl>\n",
        escape(words::outcome(solution))
    );
    let mut card = |name: &str, figure: String, note: String| {
        let _ =
            writeln!(html, "<div><dt>{}</dt><dd>{}</dd><p>{}</p></div>", escape(name), escape(&figure), escape(&note));
    };
    if let Some(calibration) = solution.calibrations.first() {
        let note = match calibration.sigma_log_focal {
            Some(sigma) => format!("\u{b1} {} % (one sigma)", short(sigma * 100.0)),
            None => "unobservable".into(),
        };
        let note = match solution.cameras().len() {
            1 => note,
            several => format!("{note}; the first of {several} cameras, see Calibration"),
        };
        card("focal length", format!("{:.1} px", calibration.focal_px), note);
        for (name, figure, note) in distortions(calibration) {
            card(name, figure, note);
        }
    } else if solution.is_focal_unobservable() {
        card("focal length", "none".into(), "unobservable".into());
    }
    let tracks = TrackCounts::new(solution, input);
    let observations = solution.observations.inlier.len();
    card(
        "inlier tracks",
        format!("{} of {}", tracks.inlier, solution.tracks.inlier.len()),
        format!("{} of {}", solution.inlier_observation_count(), counted(observations, "observation")),
    );
    if let (Some(rejected), Some(unclassified)) = (tracks.rejected, tracks.unclassified) {
        let others =
            [(tracks.two_view, "of two views, consistent"), (unclassified, "unclassified: too few views see them")];
        let others = others.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}"));
        card("rejected tracks", rejected.to_string(), others.collect::<Vec<_>>().join("; "));
    } else if solution.status == Status::Solved {
        let note = "rejected or unclassified: the input, which was not at hand, tells them apart";
        card("tracks not counted", tracks.others.to_string(), note.into());
    }
    let registered = solution.registered_views().len();
    card("views", format!("{registered} of {}", solution.views.len()), "registered".into());
    if let Some(rms_px) = solution.reprojection_rms_px {
        let noise = solution.noise_px.map_or_else(String::new, |px| format!("RMS; noise {} px", short(px)));
        card("reprojection error", format!("{} px", short(rms_px)), noise);
    }
    let proposal = solution
        .winning_proposal
        .map_or_else(String::new, |proposal| format!(", found by the proposal {}", proposal.name()));
    card(
        "method",
        solution.method.name().into(),
        format!("{}{proposal}", counted(solution.iterations, "network iteration")),
    );
    card("time", format!("{:.2} s", solution.seconds), stage_times(solution));
    html.push_str("</dl>\n</header>\n");
    html
}

/// Name, figure and note of a fisheye and of the lens's distortions that are not 0.
fn distortions(calibration: &Calibration) -> Vec<(&'static str, String, String)> {
    let sigmas = &calibration.sigmas;
    let radial = [
        ("k1", calibration.radial_k1, sigmas.radial_k1),
        ("k2", calibration.radial_k2, sigmas.radial_k2),
        ("k3", calibration.radial_k3, sigmas.radial_k3),
    ];
    let tangential = [
        ("p1", calibration.tangential_p1, sigmas.tangential_p1),
        ("p2", calibration.tangential_p2, sigmas.tangential_p2),
    ];
    let mut cards = Vec::new();
    if calibration.lens_projection == LensProjection::Fisheye {
        cards.push(("lens", "fisheye".to_owned(), "equidistant, before distortion".to_owned()));
    }
    for (name, coefficients) in [("radial distortion", &radial[..]), ("tangential distortion", &tangential[..])] {
        let (mut figures, mut errors) = (Vec::new(), Vec::new());
        for (name, value, sigma) in coefficients.iter().filter(|(_, value, _)| *value != 0.0) {
            figures.push(format!("{name} {}", short(*value)));
            errors.extend(sigma.map(|sigma| format!("\u{b1} {}", short(sigma))));
        }
        if !figures.is_empty() {
            let note =
                if errors.is_empty() { "estimated".into() } else { format!("{} (one sigma)", errors.join(", ")) };
            cards.push((name, figures.join(", "), note));
        }
    }
    cards
}

fn stage_times(solution: &Solution) -> String {
    let times: Vec<String> =
        solution.stages.iter().map(|time| format!("{} {:.2}", time.stage.name(), time.seconds)).collect();
    times.join(", ")
}

/// The warnings, in plain words and in the solver's own.
pub fn warnings(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"warnings\">\n<h2>Warnings</h2>\n");
    let warnings = named(solution, input);
    if warnings.is_empty() {
        html.push_str("<p>None.</p>\n");
    } else {
        html.push_str("<ul>\n");
        for warning in &warnings {
            let _ = writeln!(
                html,
                "<li><strong>{}</strong> {} <span class=\"detail\">{}</span></li>",
                escape(warning.code.name()),
                escape(words::warning(warning.code)),
                escape(&warning.detail)
            );
        }
        html.push_str("</ul>\n");
    }
    html.push_str("</section>\n");
    html
}

/// The curves: losses over the network's iterations, the rest over the reports of the solver.
///
/// Neither axis is time: two runs of one input then give the same page. Nor is it the share of work done, which stands
/// still where the solver tries again with other views.
pub fn convergence(solution: &Solution) -> String {
    let history = &solution.history;
    let iterations = iterations_in_all(history);
    let phases = phase_starts(history, &iterations);
    let loss = |pick: fn(&Losses) -> f64| -> Vec<(f64, f64)> {
        history.iter().zip(&iterations).filter_map(|(record, &at)| Some((at, pick(record.losses.as_ref()?)))).collect()
    };
    let over_steps = |pick: fn(&Progress) -> Option<f64>| -> Vec<(f64, f64)> {
        history.iter().enumerate().filter_map(|(step, record)| Some((step as f64, pick(record)?))).collect()
    };
    let losses = LineChart {
        title: "Losses (logarithmic)",
        x_label: NETWORK_ITERATION,
        series: vec![
            Series { name: "L_num", points: loss(|losses| losses.num) },
            Series { name: "L_proj", points: loss(|losses| losses.proj) },
            Series { name: "L_DAQ", points: loss(|losses| losses.daq) },
        ],
        logarithmic: true,
        clip: None,
        marks: phases.clone(),
    };
    let single = |title: &'static str, points: Vec<(f64, f64)>, clip: Option<(f64, f64)>| LineChart {
        title,
        x_label: "report of the solver",
        series: vec![Series { name: title, points }],
        logarithmic: false,
        clip,
        marks: stage_starts(history),
    };
    let clip = solution.calibrations.first().map(|camera| (camera.focal_px / FOCAL_CLIP, camera.focal_px * FOCAL_CLIP));
    let charts = [
        losses,
        single("Inliers of the best hypothesis", over_steps(|record| Some(f64::from(record.inliers))), None),
        single("Focal length of the best hypothesis (px)", over_steps(|record| record.focal_px), clip),
        single(
            "Cost of the best hypothesis (share of that without inliers)",
            over_steps(|record| record.best_cost),
            None,
        ),
    ];
    let mut svgs: Vec<String> = charts.iter().map(LineChart::svg).collect();
    svgs.extend(of_heads(history, &iterations, &phases));
    let figures: Vec<String> = svgs.iter().map(|svg| format!("<figure>{svg}</figure>\n")).collect();
    format!(
        "<section id=\"convergence\">\n<h2>Convergence</h2>\n<div class=\"grid\">\n{}</div>\n{}</section>\n",
        figures.concat(),
        proposal_times(solution)
    )
}

/// What the heads of the network went through: their weights, and what their continuation and their choice go by.
/// Nothing where no head was optimised.
///
/// * `phases`: see [`phase_starts`]
fn of_heads(history: &[Progress], iterations: &[f64], phases: &[(f64, String)]) -> Vec<String> {
    let heads: Vec<(f64, &HeadProgress)> =
        history.iter().zip(iterations).filter_map(|(record, &at)| Some((at, record.head.as_ref()?))).collect();
    if heads.is_empty() {
        return Vec::new();
    }
    let curve = |pick: fn(&HeadProgress) -> Option<f64>| -> Vec<(f64, f64)> {
        heads.iter().filter_map(|&(at, head)| Some((at, pick(head)?))).collect()
    };
    let chart = |title, series, logarithmic| LineChart {
        title,
        x_label: NETWORK_ITERATION,
        series,
        logarithmic,
        clip: None,
        marks: phases.to_vec(),
    };
    let sums = vec![Series { name: "N", points: curve(|head| Some(head.weight_sum)) }];
    let residuals = vec![
        Series { name: "tau", points: curve(|head| head.tolerance) },
        Series { name: "DAQ", points: curve(|head| head.best_daq_residual) },
    ];
    let histograms: Vec<(f64, &[u32])> = heads.iter().map(|&(at, head)| (at, &head.weight_histogram[..])).collect();
    let mut svgs = vec![
        chart("Sum N of the weights", sums, false).svg(),
        chart::heat_map("Weights of the tracks over the iterations", NETWORK_ITERATION, &histograms),
    ];
    if residuals.iter().any(|series| !series.points.is_empty()) {
        svgs.push(chart("Residuals: tau, DAQ of the best head", residuals, true).svg());
    }
    svgs
}

/// Where among the network's iterations each head and each phase of its continuation began.
fn phase_starts(history: &[Progress], iterations: &[f64]) -> Vec<(f64, String)> {
    let mut marks = Vec::new();
    let mut last = None;
    for (record, &at) in history.iter().zip(iterations) {
        let Some(HeadProgress { head, phase, .. }) = record.head else { continue };
        if last.is_none_or(|(of, _)| of != head) {
            marks.push((at, format!("head {head}")));
        } else if last != Some((head, phase)) {
            marks.push((at, phase.map_or_else(String::new, |phase| phase.name().to_owned())));
        }
        last = Some((head, phase));
    }
    marks
}

/// The network's iterations over all tries; each try counts its own from 0.
fn iterations_in_all(history: &[Progress]) -> Vec<f64> {
    let (mut before, mut last) = (0, 0);
    let in_all = |record: &Progress| {
        if record.iteration < last {
            before += last;
        }
        last = record.iteration;
        f64::from(before + last)
    };
    history.iter().map(in_all).collect()
}

/// Where among the reports each stage began.
fn stage_starts(history: &[Progress]) -> Vec<(f64, String)> {
    let begins = |step: usize| step == 0 || history[step - 1].stage != history[step].stage;
    (0..history.len())
        .filter(|&step| begins(step))
        .map(|step| (step as f64, history[step].stage.name().to_owned()))
        .collect()
}

/// What each proposal alone would have needed, on one line: it holds times.
fn proposal_times(solution: &Solution) -> String {
    if solution.proposal_times.is_empty() {
        return String::new();
    }
    let sentence = |time: &ProposalTime| {
        let when = match time.seconds {
            Some(seconds) => format!("{seconds:.2} s ({})", counted(time.steps, "step")),
            None if time.steps == 0 => "not asked".to_owned(),
            None => format!("never ({})", counted(time.steps, "step")),
        };
        format!("{} {when}", time.proposal.name())
    };
    let times: Vec<String> = solution.proposal_times.iter().map(sentence).collect();
    format!(
        "<p class=\"note\" id=\"proposal-times\">Until a consensus as good as the accepted one, each proposal alone: {}.</p>\n",
        escape(&times.join(", "))
    )
}

/// How the weights are distributed.
pub fn weights(solution: &Solution) -> String {
    let tracks = &solution.tracks;
    let split = |weights: &[f32]| -> [Vec<f64>; 2] {
        let of = |wanted: bool| {
            weights
                .iter()
                .zip(&tracks.inlier)
                .filter(|(_, inlier)| **inlier == wanted)
                .map(|(weight, _)| f64::from(*weight))
                .collect()
        };
        [of(true), of(false)]
    };
    let draw = |title: &str, weights: &[f32]| {
        let [inliers, outliers] = split(weights);
        let svg = chart::histogram(title, "weight of a track", [("inliers", &inliers), ("outliers", &outliers)]);
        format!("<figure>{svg}</figure>\n")
    };
    let mut html = String::from("<section id=\"weights\">\n<h2>Weights of the tracks</h2>\n<div class=\"grid\">\n");
    html.push_str(&draw("Weights", &tracks.weight));
    if !tracks.network_weight.is_empty() {
        html.push_str(&draw("The network's own weights", &tracks.network_weight));
    }
    html.push_str("</div>\n<p class=\"note\">Heights are square roots of the counts, so that small bars stay visible.</p>\n</section>\n");
    html
}

/// What made the page.
pub fn footer(solution: &Solution) -> String {
    format!("<footer>scpsfm {}, seed {}</footer>\n", env!("CARGO_PKG_VERSION"), solution.seed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Stage;
    use crate::domain::result::Sigmas;
    use crate::formats::fixture;

    #[test]
    fn tries_follow_each_other_on_the_axes() {
        let (_, solution) = fixture::solved();
        let mut history = solution.history[..4].to_vec();
        for (record, (iteration, stage)) in
            history.iter_mut().zip([(25, Stage::Search), (50, Stage::Refine), (25, Stage::Search), (30, Stage::Search)])
        {
            (record.iteration, record.stage) = (iteration, stage);
        }
        assert_eq!(iterations_in_all(&history), [25.0, 50.0, 75.0, 80.0]);
        let starts = [(0.0, "search"), (1.0, "refine"), (2.0, "search")].map(|(at, name)| (at, name.to_owned()));
        assert_eq!(stage_starts(&history), starts);
        assert!(iterations_in_all(&[]).is_empty() && stage_starts(&[]).is_empty());
    }

    #[test]
    fn heads_and_phases_are_marked_where_they_begin() {
        let (_, solution) = fixture::solved();
        let history = &solution.history;
        let iterations = iterations_in_all(history);
        let phases = phase_starts(history, &iterations);
        let named: Vec<&str> = phases.iter().map(|(_, name)| name.as_str()).collect();
        assert_eq!(named, ["head 1", "rank", "growth", "head 2", "rank", "growth"]);
        let svgs = of_heads(history, &iterations, &phases);
        assert_eq!(svgs.len(), 3);
        assert!(svgs[0].contains("head 2"), "{}", svgs[0]);
        // Three kinds of weights in each of the columns.
        assert!(svgs[1].matches("<rect class=\"cell\"").count() > 100, "{}", svgs[1]);
        let without: Vec<Progress> = history.iter().map(|record| Progress { head: None, ..*record }).collect();
        assert!(of_heads(&without, &iterations, &[]).is_empty() && phase_starts(&without, &iterations).is_empty());
    }

    #[test]
    fn distortions_that_are_0_have_no_card() {
        let (_, mut solution) = fixture::solved();
        let html = headline(&solution, None);
        assert!(html.contains("<dt>radial distortion</dt><dd>k1 -0.02</dd><p>estimated</p>"), "{html}");
        assert!(!html.contains("tangential"), "{html}");
        let calibration = &mut solution.calibrations[0];
        (calibration.radial_k3, calibration.tangential_p1, calibration.tangential_p2) = (0.25, 0.5, -0.125);
        calibration.sigmas = Sigmas { radial_k1: Some(0.004), radial_k3: Some(0.03), ..Sigmas::default() };
        let html = headline(&solution, None);
        assert!(html.contains("<dd>k1 -0.02, k3 0.25</dd><p>\u{b1} 0.004, \u{b1} 0.03 (one sigma)</p>"), "{html}");
        assert!(html.contains("<dt>tangential distortion</dt><dd>p1 0.5, p2 -0.125</dd><p>estimated</p>"), "{html}");
        solution.calibrations[0].radial_k1 = 0.0;
        solution.calibrations[0].radial_k3 = 0.0;
        assert!(!headline(&solution, None).contains("radial distortion"));
    }

    #[test]
    fn proposals_that_never_sufficed_say_so() {
        let (_, mut solution) = fixture::solved();
        assert!(proposal_times(&solution).contains("uniform never (600 steps)"));
        solution.proposal_times.iter_mut().for_each(|time| (time.seconds, time.steps) = (None, 0));
        assert!(proposal_times(&solution).contains("uniform not asked"));
        solution.proposal_times.clear();
        assert!(proposal_times(&solution).is_empty());
    }
}
