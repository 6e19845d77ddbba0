//! The calibration of every camera group, with its error bars.

use std::fmt::Write;

use super::html::{escape, short};
use super::words;
use crate::domain::{Calibration, Solution};
use crate::formats::LabelledInput;

/// Camera groups drawn and listed; a page is read by a person.
const MAX_GROUPS: usize = 100;

/// One camera group of the result.
struct Group<'a> {
    /// The caller's id, where the input is at hand.
    id: Option<u32>,
    /// Views of the input and registered ones among them.
    views: usize,
    registered: usize,
    calibration: &'a Calibration,
}

/// The groups in the order of the calibrations: ascending by id. A single calibration is everyone's.
fn groups<'a>(solution: &'a Solution, input: Option<&LabelledInput>) -> Vec<Group<'a>> {
    let ids: Vec<u32> = input.map_or_else(Vec::new, |input| input.raw.views.iter().map(|v| v.camera_group).collect());
    let mut distinct = ids.clone();
    distinct.sort_unstable();
    distinct.dedup();
    let several = solution.calibrations.len() > 1;
    let group = |(index, calibration): (usize, &'a Calibration)| {
        let id = distinct.get(index).copied().filter(|_| several || distinct.len() == 1);
        let of_group = |view: &usize| !several || (id.is_some() && ids.get(*view).copied() == id);
        let views: Vec<usize> = (0..solution.views.len()).filter(of_group).collect();
        let registered = views.iter().filter(|&&view| solution.views[view].projection.is_some()).count();
        Group { id, views: views.len(), registered, calibration }
    };
    solution.calibrations.iter().enumerate().map(group).collect()
}

/// The section: what the grade means, a row a group, and the focal lengths drawn.
pub fn section(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"calibration\">\n<h2>Calibration</h2>\n");
    if let Some(grade) = solution.grade {
        let _ = writeln!(html, "<p><strong>{}</strong> {}</p>", grade.name(), escape(words::outcome(solution)));
    }
    let groups = groups(solution, input);
    if groups.is_empty() {
        html.push_str("<p class=\"note\">There is no calibration to show.</p>\n</section>\n");
        return html;
    }
    html.push_str(
        "<div class=\"table\"><table>\n<tr><th>camera group</th><th>views</th><th>focal length (px)</th>\
         <th>principal point (px)</th><th>aspect</th><th>k1</th><th>k2</th></tr>\n",
    );
    for (index, group) in groups.iter().take(MAX_GROUPS).enumerate() {
        html.push_str(&row(index, group));
    }
    html.push_str("</table></div>\n");
    if groups.len() > MAX_GROUPS {
        let _ = writeln!(html, "<p class=\"note\">{MAX_GROUPS} of {} camera groups are shown.</p>", groups.len());
    }
    let _ = writeln!(html, "<figure>{}</figure>", bars(&groups[..groups.len().min(MAX_GROUPS)]));
    html.push_str(
        "<p class=\"note\">Errors are one standard deviation of the focal length; none is estimated for the rest. \
         Aspect is vertical over horizontal focal length; k1 and k2 are the radial distortion, 0 for a pinhole.</p>\n",
    );
    html.push_str(&own_focals(solution));
    html.push_str("</section>\n");
    html
}

fn name(index: usize, group: &Group) -> String {
    group.id.map_or_else(|| format!("{}", index + 1), |id| id.to_string())
}

fn row(index: usize, group: &Group) -> String {
    let Calibration { focal_px, sigma_log_focal, principal_point_px: [x, y], aspect, radial_k1, radial_k2 } =
        *group.calibration;
    let error = match sigma_log_focal {
        // A small deviation of the logarithm is one of the ratio.
        Some(sigma) => format!("\u{b1} {} ({} %)", short(sigma * focal_px), short(sigma * 100.0)),
        None => "(unobservable)".into(),
    };
    format!(
        "<tr><td>{}</td><td>{} of {}</td><td>{focal_px:.1} {error}</td><td>{x:.1}, {y:.1}</td><td>{}</td><td>{}</td><td>{}</td></tr>\n",
        name(index, group),
        group.registered,
        group.views,
        short(aspect),
        short(radial_k1),
        short(radial_k2)
    )
}

/// Focal lengths with whiskers of one standard deviation, one line a group.
fn bars(groups: &[Group]) -> String {
    const WIDTH: f64 = 460.0;
    const LINE: f64 = 18.0;
    const LEFT: f64 = 70.0;
    const RIGHT: f64 = 14.0;
    const TOP: f64 = 26.0;
    /// Standard deviations that the axis shows about every focal length.
    const SHOWN_SIGMA: f64 = 4.0;
    let interval = |group: &Group, sigmas: f64| {
        let focal = group.calibration.focal_px;
        let sigma = group.calibration.sigma_log_focal.filter(|sigma| sigma.is_finite()).unwrap_or(0.0);
        (focal * (-sigmas * sigma).exp(), focal * (sigmas * sigma).exp())
    };
    let finite =
        || groups.iter().map(|group| interval(group, SHOWN_SIGMA)).filter(|(a, b)| a.is_finite() && b.is_finite());
    let (low, high) =
        finite().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), (a, b)| (low.min(a), high.max(b)));
    // Where nothing is uncertain and all are alike, a range of a tenth about it.
    let (low, high) = if high > low { (low, high) } else { (low * 0.95, low * 1.05) };
    let bottom = TOP + LINE * groups.len() as f64;
    let height = bottom + 22.0;
    let place = |px: f64| LEFT + ((px - low) / (high - low)).clamp(0.0, 1.0) * (WIDTH - LEFT - RIGHT);
    let mut svg = format!(
        "<svg class=\"bars\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"focal lengths with one standard deviation; \
         the numbers stand in the table\"><text class=\"title\" x=\"8\" y=\"16\">Focal length (px), \u{b1} one sigma</text>"
    );
    if !(low.is_finite() && high.is_finite()) {
        return svg + "</svg>";
    }
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let px = low + share * (high - low);
        let at = place(px);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{TOP}\" y2=\"{bottom}\"/>\
             <text class=\"tick\" x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            bottom + 14.0,
            tick(px, high - low)
        );
    }
    for (index, group) in groups.iter().enumerate() {
        let y = TOP + LINE * (index as f64 + 0.5);
        let (from, to) = interval(group, 1.0);
        let (from, at, to) = (place(from), place(group.calibration.focal_px), place(to));
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">group {}</text>\
             <path class=\"line\" d=\"M{from:.1} {y}H{to:.1}M{from:.1} {}v8M{to:.1} {}v8\"/><circle class=\"dot\" cx=\"{at:.1}\" cy=\"{y}\" r=\"3.5\"/>",
            LEFT - 8.0,
            y + 3.5,
            name(index, group),
            y - 4.0,
            y - 4.0
        );
    }
    svg + "</svg>"
}

/// A tick with as many decimals as the range asks for.
fn tick(px: f64, range: f64) -> String {
    let decimals = if range < 1.0 {
        2
    } else if range < 20.0 {
        1
    } else {
        0
    };
    format!("{px:.decimals$}")
}

/// Where every view has a focal length of its own, the range of them.
fn own_focals(solution: &Solution) -> String {
    let own = || solution.views.iter().filter_map(|view| view.focal_px).filter(|px| px.is_finite());
    let (low, high) = own().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), px| (low.min(px), high.max(px)));
    if low > high {
        return String::new();
    }
    format!(
        "<p class=\"note\">Every view has a focal length of its own, {low:.1} to {high:.1} px; the table shows their geometric mean.</p>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn a_row_a_group_with_its_error() {
        let (mut input, mut solution) = fixture::solved();
        let first = solution.calibrations[0];
        let second = Calibration {
            focal_px: 2000.0,
            sigma_log_focal: Some(0.01),
            principal_point_px: [640.0, 480.5],
            aspect: 1.002,
            radial_k1: -0.125,
            radial_k2: 0.25,
        };
        solution.calibrations.push(second);
        solution.views[4].projection = None;
        input.raw.views.iter_mut().enumerate().for_each(|(k, view)| view.camera_group = if k < 2 { 4 } else { 9 });
        let html = section(&solution, Some(&input));
        let sigma = format!("{:.1} \u{b1} {} (0.4 %)", first.focal_px, short(first.focal_px * 0.004));
        assert!(html.contains(&format!("<tr><td>4</td><td>2 of 2</td><td>{sigma}</td>")), "{html}");
        let row = "<tr><td>9</td><td>2 of 3</td><td>2000.0 \u{b1} 20 (1 %)</td><td>640.0, 480.5</td><td>1.002</td><td>-0.125</td><td>0.25</td></tr>";
        assert!(html.contains(row), "{html}");
        assert_eq!(html.matches("<circle").count(), 2);
        let without = section(&solution, None);
        assert!(without.contains("<tr><td>2</td><td>0 of 0</td>"), "nothing tells which views are of which group");
    }

    #[test]
    fn one_calibration_is_every_groups() {
        let (mut input, mut solution) = fixture::solved();
        input.raw.views[0].camera_group = 5;
        solution.views[1].focal_px = Some(1000.0);
        solution.views[2].focal_px = Some(1250.5);
        let html = section(&solution, Some(&input));
        assert!(html.contains("<tr><td>1</td><td>5 of 5</td>"), "{html}");
        assert!(html.contains("1000.0 to 1250.5 px"));
    }

    #[test]
    fn a_focal_length_without_an_error_bar_is_said_to_be_so() {
        let (input, mut solution) = fixture::solved();
        solution.calibrations[0].sigma_log_focal = None;
        let html = section(&solution, Some(&input));
        assert!(html.contains("(unobservable)") && !html.contains("NaN") && !html.contains("inf"), "{html}");
        let (input, projective) = fixture::projective_only();
        let html = section(&projective, Some(&input));
        assert!(
            html.contains("PROJECTIVE_ONLY") && html.contains("no calibration to show") && !html.contains("<table")
        );
    }
}
