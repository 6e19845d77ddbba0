//! The calibration of every camera group, with its error bars.

use std::fmt::Write;

use super::chart::{WIDTH, anchor};
use super::html::{escape, short};
use super::words;
use crate::domain::{LensProjection, Solution};
use crate::formats::intrinsics_json::IntrinsicsJson;
use crate::formats::result_json::{CameraGroupJson, camera_groups};

/// Camera groups drawn and listed; a page is read by a person.
const MAX_GROUPS: usize = 100;
/// The lens's coefficients, in the order of [`coefficients`].
const COEFFICIENTS: [&str; 5] = ["k1", "k2", "k3", "p1", "p2"];
/// The first of them, which have a column even where they are 0.
const ALWAYS_SHOWN: usize = 2;

/// The section: what the grade means, a row a group, and the focal lengths drawn.
pub fn section(solution: &Solution) -> String {
    let mut html = String::from("<section id=\"calibration\">\n<h2>Calibration</h2>\n");
    if let Some(grade) = solution.grade {
        let _ = writeln!(html, "<p><strong>{}</strong> {}</p>", grade.name(), escape(words::outcome(solution)));
    }
    let groups = camera_groups(solution);
    if !solution.is_metric() {
        html.push_str("<p class=\"note\">There is no calibration to show.</p>\n</section>\n");
        return html;
    }
    let shown = &groups[..groups.len().min(MAX_GROUPS)];
    let columns = columns(shown);
    let heads: String = columns.iter().map(|&column| format!("<th>{}</th>", COEFFICIENTS[column])).collect();
    let _ = writeln!(
        html,
        "<div class=\"table\"><table>\n<tr><th>camera group</th><th>views</th><th>focal length (px)</th>\
         <th>principal point (px)</th><th>aspect</th>{heads}<th>grade</th><th>warnings</th></tr>"
    );
    for group in shown {
        html.push_str(&row(group, &columns));
    }
    html.push_str("</table></div>\n");
    if groups.len() > MAX_GROUPS {
        let _ = writeln!(html, "<p class=\"note\">{MAX_GROUPS} of {} camera groups are shown.</p>", groups.len());
    }
    let _ = writeln!(html, "<figure>{}</figure>", bars(shown));
    html.push_str(
        "<p class=\"note\">Errors are one standard deviation; what has none was not estimated but taken to be in \
         order, or an older version solved it, which did not tell. Aspect is vertical over horizontal focal length; \
         k1, k2 and k3 are the radial distortion, p1 and p2 the tangential one, all 0 for a pinhole; those of a fisheye scale powers of \
         the angle from the optical axis instead of its tangent. k3, p1 and p2 each \
         have a column only where a group has a value other than 0.</p>\n",
    );
    html.push_str(&own_focals(solution));
    html.push_str("</section>\n");
    html
}

/// Value and standard deviation of each of a group's [`COEFFICIENTS`].
fn coefficients(group: &CameraGroupJson) -> [(Option<f64>, Option<f64>); COEFFICIENTS.len()] {
    let IntrinsicsJson { lens, sigmas, .. } = &group.intrinsics;
    [
        (lens.radial_k1, sigmas.sigma_radial_k1),
        (lens.radial_k2, sigmas.sigma_radial_k2),
        (lens.radial_k3, sigmas.sigma_radial_k3),
        (lens.tangential_p1, sigmas.sigma_tangential_p1),
        (lens.tangential_p2, sigmas.sigma_tangential_p2),
    ]
}

/// Which of the [`COEFFICIENTS`] have a column.
fn columns(groups: &[CameraGroupJson]) -> Vec<usize> {
    let is_used = |column: usize| groups.iter().any(|group| coefficients(group)[column].0.is_some_and(|k| k != 0.0));
    (0..COEFFICIENTS.len()).filter(|&column| column < ALWAYS_SHOWN || is_used(column)).collect()
}

/// * `columns`: the coefficients to show
fn row(group: &CameraGroupJson, columns: &[usize]) -> String {
    let intrinsics = &group.intrinsics;
    let mut focal = intrinsics.focal_px.map_or_else(
        || "none".to_owned(),
        |focal_px| match intrinsics.sigma_log_focal {
            // A small deviation of the logarithm is one of the ratio.
            Some(sigma) => format!("{focal_px:.1} \u{b1} {} ({} %)", short(sigma * focal_px), short(sigma * 100.0)),
            None => format!("{focal_px:.1} (unobservable)"),
        },
    );
    if intrinsics.lens.lens_projection == Some(LensProjection::Fisheye) {
        focal.push_str(", fisheye");
    }
    let number = |value: Option<f64>, sigma: Option<f64>| {
        let error = sigma.map_or_else(String::new, |sigma| format!(" \u{b1} {}", short(sigma)));
        value.map_or_else(|| "-".into(), |value| short(value) + &error)
    };
    let point = |[x, y]: [f64; 2]| match intrinsics.sigmas.sigma_principal_point_px {
        Some([sigma_x, sigma_y]) => {
            format!("{x:.1} \u{b1} {}, {y:.1} \u{b1} {}", short(sigma_x), short(sigma_y))
        }
        None => format!("{x:.1}, {y:.1}"),
    };
    let coefficients = coefficients(group);
    let lens = columns.iter().map(|&column| coefficients[column]);
    let lens: String = lens.map(|(value, sigma)| format!("<td>{}</td>", number(value, sigma))).collect();
    let codes: Vec<&str> = group.warnings.iter().map(|code| code.name()).collect();
    format!(
        "<tr><td>{}</td><td>{} of {}</td><td>{focal}</td><td>{}</td><td>{}</td>{lens}<td>{}</td><td>{}</td></tr>\n",
        group.camera_group,
        group.registered_views,
        group.views,
        intrinsics.principal_point_px.map_or_else(|| "-".into(), point),
        number(intrinsics.aspect, intrinsics.sigmas.sigma_aspect),
        group.grade.map_or("-", |grade| grade.name()),
        if codes.is_empty() { "none".into() } else { codes.join(", ") }
    )
}

/// Focal lengths with whiskers of one standard deviation, one line a group that has one.
fn bars(groups: &[CameraGroupJson]) -> String {
    const LINE: f64 = 18.0;
    const LEFT: f64 = 70.0;
    const RIGHT: f64 = 14.0;
    const TOP: f64 = 26.0;
    /// Standard deviations that the axis shows about every focal length.
    const SHOWN_SIGMA: f64 = 4.0;
    let groups: Vec<(&CameraGroupJson, f64)> =
        groups.iter().filter_map(|group| Some((group, group.intrinsics.focal_px?))).collect();
    let interval = |(group, focal): &(&CameraGroupJson, f64), sigmas: f64| {
        let sigma = group.intrinsics.sigma_log_focal.filter(|sigma| sigma.is_finite()).unwrap_or(0.0);
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
             <text class=\"tick\" x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"{}\">{}</text>",
            bottom + 14.0,
            anchor(at),
            tick(px, high - low)
        );
    }
    for (index, group) in groups.iter().enumerate() {
        let y = TOP + LINE * (index as f64 + 0.5);
        let (from, to) = interval(group, 1.0);
        let (from, at, to) = (place(from), place(group.1), place(to));
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">group {}</text>\
             <path class=\"line\" d=\"M{from:.1} {y}H{to:.1}M{from:.1} {}v8M{to:.1} {}v8\"/><circle class=\"dot\" cx=\"{at:.1}\" cy=\"{y}\" r=\"3.5\"/>",
            LEFT - 8.0,
            y + 3.5,
            group.0.camera_group,
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
    let Some((low, high)) = solution.view_focals_px() else { return String::new() };
    format!(
        "<p class=\"note\">Every view has a focal length of its own, {low:.1} to {high:.1} px; the table shows their geometric mean.</p>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::result::Sigmas;
    use crate::domain::{Calibration, Grade, Warning, WarningCode};
    use crate::formats::fixture;

    #[test]
    fn a_row_a_group_with_its_error() {
        let (_, mut solution) = fixture::solved();
        solution.calibrations[0].camera_group = 4;
        let first = solution.calibrations[0];
        let second = Calibration {
            camera_group: 9,
            focal_px: 2000.0,
            sigma_log_focal: Some(0.01),
            principal_point_px: [640.0, 480.5],
            lens_projection: LensProjection::Fisheye,
            aspect: 1.002,
            radial_k1: -0.125,
            radial_k2: 0.25,
            radial_k3: 0.0,
            tangential_p1: 0.0,
            tangential_p2: 0.0,
            grade: Some(Grade::Weak),
            sigmas: Sigmas {
                principal_point_px: Some([2.5, 3.0]),
                aspect: None,
                radial_k1: Some(0.004),
                radial_k2: Some(0.03),
                ..Sigmas::default()
            },
        };
        solution.calibrations.push(second);
        solution.views[4].projection = None;
        solution.views.iter_mut().enumerate().for_each(|(k, view)| view.camera_group = if k < 2 { 4 } else { 9 });
        solution.warnings.push(Warning::new(WarningCode::Cheirality, "camera group 9: x").of_group(9));
        let html = section(&solution);
        let sigma = format!("{:.1} \u{b1} {} (0.4 %)", first.focal_px, short(first.focal_px * 0.004));
        assert!(html.contains(&format!("<tr><td>4</td><td>2 of 2</td><td>{sigma}</td>")), "{html}");
        let row = "<tr><td>9</td><td>2 of 3</td><td>2000.0 \u{b1} 20 (1 %), fisheye</td><td>640.0 \u{b1} 2.5, 480.5 \u{b1} 3</td><td>1.002</td>\
                   <td>-0.125 \u{b1} 0.004</td><td>0.25 \u{b1} 0.03</td><td>WEAK</td><td>CHEIRALITY</td></tr>";
        assert!(html.contains(row) && html.contains("<th>k2</th><th>grade</th>"), "{html}");
        assert_eq!(html.matches("<circle").count(), 2);
        solution.views[2].projection = None;
        solution.views[3].projection = None;
        solution.calibrations.pop();
        let html = section(&solution);
        assert!(html.contains("<tr><td>9</td><td>0 of 3</td><td>none</td>"), "{html}");
        assert_eq!(html.matches("<circle").count(), 1, "a camera without registered views has no focal length");
    }

    #[test]
    fn other_coefficients_have_a_column_where_a_group_has_them() {
        let (_, mut solution) = fixture::solved();
        let sigmas = Sigmas { tangential_p1: Some(0.0625), ..Sigmas::default() };
        let second = Calibration { camera_group: 9, tangential_p1: -0.5, sigmas, ..solution.calibrations[0] };
        solution.calibrations.push(second);
        solution.views[4].camera_group = 9;
        let html = section(&solution);
        assert!(html.contains("<th>k1</th><th>k2</th><th>p1</th><th>grade</th>"), "{html}");
        assert!(html.contains("<td>-0.02</td><td>0</td><td>0</td><td>METRIC</td>"), "{html}");
        assert!(html.contains("<td>-0.02</td><td>0</td><td>-0.5 \u{b1} 0.0625</td><td>METRIC</td>"), "{html}");
        let second = &mut solution.calibrations[1];
        (second.radial_k3, second.tangential_p2) = (0.25, 0.125);
        let html = section(&solution);
        assert!(html.contains("<th>k2</th><th>k3</th><th>p1</th><th>p2</th><th>grade</th>"), "{html}");
        assert!(html.contains("<td>0.25</td><td>-0.5 \u{b1} 0.0625</td><td>0.125</td><td>METRIC</td>"), "{html}");
    }

    #[test]
    fn focal_lengths_of_views_are_told() {
        let (_, mut solution) = fixture::solved();
        solution.views[1].focal_px = Some(1000.0);
        solution.views[2].focal_px = Some(1250.5);
        let html = section(&solution);
        assert!(html.contains("<tr><td>0</td><td>5 of 5</td>"), "{html}");
        assert!(html.contains("1000.0 to 1250.5 px"));
    }

    #[test]
    fn a_focal_length_without_an_error_bar_is_said_to_be_so() {
        let (_, mut solution) = fixture::solved();
        solution.calibrations[0].sigma_log_focal = None;
        let html = section(&solution);
        assert!(html.contains("(unobservable)") && !html.contains("NaN") && !html.contains("inf"), "{html}");
        let (_, projective) = fixture::projective_only();
        let html = section(&projective);
        assert!(
            html.contains("PROJECTIVE_ONLY") && html.contains("no calibration to show") && !html.contains("<table")
        );
    }
}
