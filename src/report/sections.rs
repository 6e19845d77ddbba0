//! The sections of the page, top to bottom.

use std::fmt::Write;

use super::chart::{self, LineChart, Series};
use super::html::{escape, script_json, short};
use super::{scene, words};
use crate::domain::{Grade, Progress, Solution, Stage, Status};
use crate::formats::LabelledInput;
use crate::formats::result_json::view_label;

/// A focal length beyond this factor of the final one is drawn at the edge of its chart.
const FOCAL_CLIP: f64 = 2.5;

/// Title, outcome and the figures that matter.
pub fn headline(solution: &Solution) -> String {
    let (badge, tone) = match (solution.status, solution.grade) {
        (Status::NoReconstruction, _) => ("NO_RECONSTRUCTION", "bad"),
        (_, Some(Grade::Metric)) => ("METRIC", "good"),
        (_, Some(Grade::Weak)) => ("WEAK", "fair"),
        (_, Some(Grade::ProjectiveOnly)) => ("PROJECTIVE_ONLY", "fair"),
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
    for calibration in solution.calibrations.iter().take(1) {
        let note = match calibration.sigma_log_focal {
            Some(sigma) => format!("\u{b1} {} % (one sigma)", short(sigma * 100.0)),
            None => "unobservable".into(),
        };
        card("focal length", format!("{:.1} px", calibration.focal_px), note);
    }
    let observations = solution.observations.inlier.len();
    card(
        "inlier tracks",
        format!("{} of {}", solution.inlier_track_count(), solution.tracks.inlier.len()),
        format!("{} of {observations} observations", solution.inlier_observation_count()),
    );
    let registered = solution.registered_views().len();
    card("views", format!("{registered} of {}", solution.views.len()), "registered".into());
    if let Some(rms_px) = solution.reprojection_rms_px {
        let noise = solution.noise_px.map_or_else(String::new, |px| format!("RMS; noise {} px", short(px)));
        card("reprojection error", format!("{} px", short(rms_px)), noise);
    }
    let prior =
        solution.winning_prior.map_or_else(String::new, |prior| format!(", found by the prior {}", prior.name()));
    card("method", solution.method.name().into(), format!("{} network iterations{prior}", solution.iterations));
    card("time", format!("{:.2} s", solution.seconds), stage_times(solution));
    html.push_str("</dl>\n</header>\n");
    html
}

fn stage_times(solution: &Solution) -> String {
    let times: Vec<String> =
        solution.stages.iter().map(|time| format!("{} {:.2}", time.stage.name(), time.seconds)).collect();
    times.join(", ")
}

/// The warnings, in plain words and in the solver's own.
pub fn warnings(solution: &Solution) -> String {
    let mut html = String::from("<section id=\"warnings\">\n<h2>Warnings</h2>\n");
    if solution.warnings.is_empty() {
        html.push_str("<p>None.</p>\n");
    } else {
        html.push_str("<ul>\n");
        for warning in &solution.warnings {
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

/// The curves: losses over the network's iterations, the rest over the share of work done.
///
/// Neither axis is time: two runs of one input then give the same page.
pub fn convergence(solution: &Solution) -> String {
    let history = &solution.history;
    let loss = |pick: fn(&crate::domain::Losses) -> f64| -> Vec<(f64, f64)> {
        history.iter().filter_map(|record| Some((f64::from(record.iteration), pick(record.losses.as_ref()?)))).collect()
    };
    let over_work = |pick: fn(&Progress) -> Option<f64>| -> Vec<(f64, f64)> {
        history.iter().filter_map(|record| Some((record.fraction, pick(record)?))).collect()
    };
    let losses = LineChart {
        title: "Losses",
        x_label: "network iteration",
        series: vec![
            Series { name: "L_num", points: loss(|losses| losses.num) },
            Series { name: "L_proj", points: loss(|losses| losses.proj) },
            Series { name: "L_DAQ", points: loss(|losses| losses.daq) },
        ],
        logarithmic: true,
        clip: None,
        marks: Vec::new(),
    };
    let single = |title: &'static str, points: Vec<(f64, f64)>, clip: Option<(f64, f64)>| LineChart {
        title,
        x_label: "share of the work done",
        series: vec![Series { name: title, points }],
        logarithmic: false,
        clip,
        marks: stage_starts(history),
    };
    let clip = solution.calibrations.first().map(|camera| (camera.focal_px / FOCAL_CLIP, camera.focal_px * FOCAL_CLIP));
    let charts = [
        losses,
        single("Inliers of the best hypothesis", over_work(|record| Some(f64::from(record.inliers))), None),
        single("Focal length of the best hypothesis (px)", over_work(|record| record.focal_px), clip),
        single("Score of the best hypothesis (0 best, 1 none)", over_work(|record| record.best_score), None),
    ];
    let svgs: Vec<String> = charts.iter().map(|chart| format!("<figure>{}</figure>\n", chart.svg())).collect();
    format!(
        "<section id=\"convergence\">\n<h2>Convergence</h2>\n<div class=\"grid\">\n{}</div>\n</section>\n",
        svgs.concat()
    )
}

/// Where on the axis of work each stage began.
fn stage_starts(history: &[Progress]) -> Vec<(f64, &'static str)> {
    Stage::ALL
        .into_iter()
        .filter_map(|stage| Some((history.iter().find(|record| record.stage == stage)?.fraction, stage.name())))
        .collect()
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

/// The tracks in the images.
pub fn images(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"images\">\n<h2>Tracks in the images</h2>\n");
    let Some(input) = input else {
        html.push_str(
            "<p class=\"note\">This page was made without the input: there are no points to draw.</p>\n</section>\n",
        );
        return html;
    };
    let tracks = scene::tracks(solution, input);
    let _ = write!(
        html,
        "<p class=\"tools\"><label>View <select id=\"view\"></select></label>\n\
         <label>Colour by <select id=\"colour\"><option value=\"inlier\">inlier</option><option value=\"weight\">weight</option></select></label>\n\
         <label><input type=\"checkbox\" id=\"outliers\" checked> outliers</label>\n\
         <label><input type=\"checkbox\" id=\"flow\" checked> flow to the next view</label></p>\n\
         <canvas id=\"image\" role=\"img\" aria-label=\"tracks of the chosen view\"></canvas>\n\
         <p class=\"note\" id=\"hover\">Blue: inlier. Orange: outlier track. Red: an observation left out of an inlier track. \
         Point at one to see its track.</p>\n<p class=\"note\">{} of {} tracks are drawn.</p>\n\
         <script type=\"application/json\" id=\"tracks-data\">{}</script>\n</section>\n",
        tracks.shown,
        tracks.all,
        script_json(&tracks.json)
    );
    html
}

/// Cameras and points.
pub fn space(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"space\">\n<h2>Cameras and points</h2>\n");
    match scene::space(solution, input) {
        Some(json) => {
            let _ = write!(
                html,
                "<canvas id=\"solid\" role=\"img\" aria-label=\"cameras and points in space\"></canvas>\n\
                 <p class=\"note\">Drag to turn, wheel to zoom. Points are coloured by weight.</p>\n\
                 <script type=\"application/json\" id=\"space-data\">{}</script>\n",
                script_json(&json)
            );
        }
        None => html.push_str("<p class=\"note\">There is no metric reconstruction to show.</p>\n"),
    }
    html.push_str("</section>\n");
    html
}

/// What one view contributes.
#[derive(Default, Clone)]
struct ViewCount {
    observations: usize,
    inliers: usize,
    squares: f64,
    judged: usize,
}

/// A table of the views.
pub fn views(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut counts = vec![ViewCount::default(); solution.views.len()];
    for (k, &view) in input.map_or(&[][..], |input| &input.raw.view).iter().enumerate() {
        let Some(count) = counts.get_mut(view as usize) else { continue };
        count.observations += 1;
        if solution.observations.inlier.get(k) == Some(&true) {
            count.inliers += 1;
            if let Some(px) = solution.observations.residual_px.get(k).copied().flatten() {
                count.squares += px * px;
                count.judged += 1;
            }
        }
    }
    let mut html = String::from(
        "<section id=\"views\">\n<h2>Views</h2>\n<div class=\"table\"><table>\n<tr><th>view</th><th>registered</th>\
         <th>observations</th><th>inliers</th><th>RMS (px)</th></tr>\n",
    );
    for (index, (view, count)) in solution.views.iter().zip(&counts).enumerate() {
        let rms = if count.judged > 0 { short((count.squares / count.judged as f64).sqrt()) } else { "-".into() };
        let registered = if view.projection.is_some() { "yes" } else { "no" };
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{registered}</td><td>{}</td><td>{}</td><td>{rms}</td></tr>",
            view_label(input, index),
            count.observations,
            count.inliers
        );
    }
    html.push_str("</table></div>\n</section>\n");
    html
}

/// What made the page.
pub fn footer(solution: &Solution) -> String {
    format!("<footer>scpsfm {}, seed {}</footer>\n", env!("CARGO_PKG_VERSION"), solution.seed)
}
