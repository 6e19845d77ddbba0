//! The views: each one's figures, those left out with the reason, and the parts that they form.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::counts::{self, ViewCount};
use super::html::{escape, short};
use super::{labels, words};
use crate::domain::Solution;
use crate::formats::LabelledInput;

/// Rows of a table of views: as many as a sequence may have by default, at some 120 bytes each.
const MAX_ROWS: usize = 2_000;
/// Parts listed.
const MAX_PARTS: usize = 100;

/// The parts, and the views that are in none.
pub fn parts(solution: &Solution, input: Option<&LabelledInput>, counts: &[ViewCount]) -> String {
    let mut html = String::from("<section id=\"parts\">\n<h2>Parts and views left out</h2>\n");
    let parts = counts::parts(solution);
    match parts.len() {
        0 => html.push_str("<p>No view is registered.</p>\n"),
        1 => {
            let registered = parts.values().map(Vec::len).sum::<usize>();
            let _ = writeln!(html, "<p>All {registered} registered views form one reconstruction.</p>");
        }
        several => {
            let _ = writeln!(
                html,
                "<p>The views form {several} parts, each with a frame and a scale of its own: they share too few tracks to be put into one.</p>"
            );
            html.push_str(&part_table(solution, input));
        }
    }
    html.push_str(&left_out(solution, input, counts));
    html.push_str("</section>\n");
    html
}

fn part_table(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut points = BTreeMap::<u32, usize>::new();
    counts::points(solution).for_each(|point| *points.entry(point.part).or_default() += 1);
    let mut html = String::from(
        "<div class=\"table\"><table>\n<tr><th>part</th><th>views</th><th>from</th><th>to</th><th>points</th></tr>\n",
    );
    for (part, views) in counts::parts(solution).iter().take(MAX_PARTS) {
        let end =
            |view: Option<&usize>| view.map_or_else(String::new, |&view| escape(&labels::view(solution, input, view)));
        let placed = points.get(part).copied().unwrap_or(0);
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{placed}</td></tr>",
            part,
            views.len(),
            end(views.first()),
            end(views.last())
        );
    }
    html.push_str("</table></div>\n");
    html
}

fn left_out(solution: &Solution, input: Option<&LabelledInput>, counts: &[ViewCount]) -> String {
    let missing: Vec<usize> = (0..solution.views.len()).filter(|&v| solution.views[v].projection.is_none()).collect();
    if missing.is_empty() {
        return "<p>No view was left out.</p>\n".into();
    }
    let mut html = format!(
        "<p>{} of {} views were left out.</p>\n<div class=\"table\"><table>\n<tr><th>view</th><th>observations</th><th>reason</th></tr>\n",
        missing.len(),
        solution.views.len()
    );
    for &view in missing.iter().take(MAX_ROWS) {
        let observations = counts.get(view).map_or(0, |count| count.observations);
        let seen = if input.is_some() { observations.to_string() } else { "-".into() };
        let reason = match solution.views[view].left_out {
            Some(reason) => reason.to_string(),
            None => words::outcome(solution).to_owned(),
        };
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{seen}</td><td>{}</td></tr>",
            escape(&labels::view(solution, input, view)),
            escape(&reason)
        );
    }
    html.push_str("</table></div>\n");
    if missing.len() > MAX_ROWS {
        let _ = writeln!(html, "<p class=\"note\">{MAX_ROWS} of {} views left out are listed.</p>", missing.len());
    }
    html
}

/// A table of all views.
pub fn table(solution: &Solution, input: Option<&LabelledInput>, counts: &[ViewCount]) -> String {
    let mut html = String::from(
        "<section id=\"views\">\n<h2>Views</h2>\n<div class=\"table\"><table>\n<tr><th>view</th><th>registered</th>\
         <th>part</th><th>observations</th><th>inliers</th><th>mean (px)</th><th>RMS (px)</th></tr>\n",
    );
    let px = |value: Option<f64>| value.map_or_else(|| "-".into(), short);
    for (index, (view, count)) in solution.views.iter().zip(counts).take(MAX_ROWS).enumerate() {
        let (registered, part) = match view.projection {
            Some(_) => ("yes", view.part.to_string()),
            None => ("no", "-".into()),
        };
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{registered}</td><td>{part}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&labels::view(solution, input, index)),
            count.observations,
            count.inliers,
            px(count.mean_px()),
            px(count.rms_px())
        );
    }
    html.push_str("</table></div>\n");
    if solution.views.len() > MAX_ROWS {
        let _ = writeln!(html, "<p class=\"note\">{MAX_ROWS} of {} views are listed.</p>", solution.views.len());
    }
    html.push_str("</section>\n");
    html
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::LeftOut;
    use crate::formats::fixture;

    fn parts_of(solution: &Solution, input: &LabelledInput) -> String {
        parts(solution, Some(input), &counts::of_views(solution, Some(input)))
    }

    #[test]
    fn views_left_out_come_with_their_reason() {
        let (input, mut solution) = fixture::solved();
        assert!(parts_of(&solution, &input).contains("No view was left out"));
        solution.views[1] = fixture::left_out(LeftOut::NotRegistered { points: 0, agreeing: 0 });
        solution.views[3] = fixture::left_out(LeftOut::NotRegistered { points: 12, agreeing: 4 });
        solution.views[4] = fixture::left_out(LeftOut::NoObservations);
        let html = parts_of(&solution, &input);
        assert!(html.contains("3 of 5 views were left out"));
        let row = |view: &str| {
            let row = html.lines().find(|line| line.starts_with(&format!("<tr><td>{view}<"))).expect("a row");
            row.rsplit("<td>").next().expect("a cell").to_string()
        };
        assert_eq!(row("13"), "sees too few points of the reconstruction</td></tr>");
        assert_eq!(row("33"), "4 of the 12 points it sees agree on a pose</td></tr>");
        assert_eq!(row("43"), "nothing is observed in it</td></tr>");
    }

    #[test]
    fn parts_are_listed_with_their_views() {
        let (input, solution) = fixture::solved();
        assert!(parts_of(&solution, &input).contains("All 5 registered views form one reconstruction"));
        let (input, solution) = fixture::solved_in_two_parts();
        let html = parts_of(&solution, &input);
        let (most, rest) = (solution.inlier_track_count().div_ceil(2), solution.inlier_track_count() / 2);
        assert!(html.contains("form 2 parts"));
        assert!(html.contains(&format!("<tr><td>0</td><td>3</td><td>3</td><td>23</td><td>{most}</td></tr>")), "{html}");
        assert!(
            html.contains(&format!("<tr><td>1</td><td>2</td><td>33</td><td>43</td><td>{rest}</td></tr>")),
            "{html}"
        );
    }

    #[test]
    fn the_table_says_what_each_view_holds() {
        let (input, mut solution) = fixture::solved();
        solution.views[4] = Default::default();
        for (k, residual) in solution.observations.residual_px.iter_mut().enumerate() {
            *residual = (input.raw.view[k] == 1).then_some(0.5);
        }
        let html = table(&solution, Some(&input), &counts::of_views(&solution, Some(&input)));
        let inliers = solution.inlier_track_count();
        let row =
            format!("<tr><td>13</td><td>yes</td><td>0</td><td>40</td><td>{inliers}</td><td>0.5</td><td>0.5</td></tr>");
        assert!(html.contains(&row), "{html}");
        assert!(html.contains("<tr><td>43</td><td>no</td><td>-</td>"));
    }
}
