//! The views: each one's figures, those left out with the reason, and the parts that they form.

use std::fmt::Write;

use super::counts::{self, ViewCount};
use super::html::{escape, short};
use super::{labels, words};
use crate::domain::{Solution, WarningCode};
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
    let mut tracks = std::collections::BTreeMap::<u32, usize>::new();
    for part in counts::parts_of_tracks(solution, input).into_iter().flatten() {
        *tracks.entry(part).or_default() += 1;
    }
    let mut html = String::from(
        "<div class=\"table\"><table>\n<tr><th>part</th><th>views</th><th>from</th><th>to</th><th>inlier tracks</th></tr>\n",
    );
    for (part, views) in counts::parts(solution).iter().take(MAX_PARTS) {
        let end = |view: Option<&usize>| view.map_or_else(String::new, |&view| escape(&labels::view(input, view)));
        let seen = input.map_or_else(|| "-".into(), |_| tracks.get(part).copied().unwrap_or(0).to_string());
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{seen}</td></tr>",
            part + 1,
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
        let reason = match reason(solution, view) {
            Some(reason) => reason,
            None if input.is_some() && observations == 0 => "nothing is observed in it",
            None => words::warning(WarningCode::ViewsLeftOut),
        };
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{seen}</td><td>{}</td></tr>",
            escape(&labels::view(input, view)),
            escape(reason)
        );
    }
    html.push_str("</table></div>\n");
    for warning in solution.warnings.iter().filter(|warning| warning.code == WarningCode::ViewsLeftOut) {
        let _ = writeln!(
            html,
            "<p class=\"note\">In the solver's words, views counted from 0: {}</p>",
            escape(&warning.detail)
        );
    }
    html
}

/// What the warning says of one view: it lists views as `17 (the reason)`, counted from 0, or as numbers alone. What it
/// lists otherwise stands below the table as it is.
fn reason(solution: &Solution, view: usize) -> Option<&str> {
    let warnings = solution.warnings.iter().filter(|warning| warning.code == WarningCode::ViewsLeftOut);
    let number = view.to_string();
    warnings.filter_map(|warning| warning.detail.split_once(": ")).find_map(|(sentence, list)| {
        let entry = list.split(", ").find_map(|entry| entry.strip_prefix(&number))?;
        match entry.strip_prefix(" (").and_then(|reason| reason.strip_suffix(')')) {
            Some(reason) => Some(reason),
            None => entry.is_empty().then(|| sentence.split_once(" views are ").map_or(sentence, |(_, why)| why)),
        }
    })
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
            Some(_) => ("yes", (view.part + 1).to_string()),
            None => ("no", "-".into()),
        };
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{registered}</td><td>{part}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&labels::view(input, index)),
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
    use crate::domain::Warning;
    use crate::formats::fixture;

    fn parts_of(solution: &Solution, input: &LabelledInput) -> String {
        parts(solution, Some(input), &counts::of_views(solution, Some(input)))
    }

    #[test]
    fn views_left_out_come_with_their_reason() {
        let (input, mut solution) = fixture::solved();
        assert!(parts_of(&solution, &input).contains("No view was left out"));
        for view in [1, 3, 4] {
            solution.views[view] = Default::default();
        }
        let detail = "3 of 5 views could not be registered: 1 (sees no point of the reconstruction), \
                      3 (4 of the 12 points it sees agree on a pose), and 1 more";
        solution.warnings.push(Warning::new(WarningCode::ViewsLeftOut, detail));
        let html = parts_of(&solution, &input);
        assert!(html.contains("3 of 5 views were left out"));
        let row = |view: &str| {
            let row = html.lines().find(|line| line.starts_with(&format!("<tr><td>{view}<"))).expect("a row");
            row.rsplit("<td>").next().expect("a cell").to_string()
        };
        assert_eq!(row("13"), "sees no point of the reconstruction</td></tr>");
        assert_eq!(row("33"), "4 of the 12 points it sees agree on a pose</td></tr>");
        assert!(row("43").starts_with(words::warning(WarningCode::ViewsLeftOut)));
        solution.warnings = vec![Warning::new(
            WarningCode::ViewsLeftOut,
            "2 of 5 views are outside the block that was solved and were left out: 1, 13",
        )];
        assert_eq!(reason(&solution, 1), Some("outside the block that was solved and were left out"));
        assert_eq!(reason(&solution, 3), None, "13 is not 3");
    }

    #[test]
    fn parts_are_listed_with_their_views() {
        let (input, mut solution) = fixture::solved();
        assert!(parts_of(&solution, &input).contains("All 5 registered views form one reconstruction"));
        solution.views.iter_mut().skip(3).for_each(|view| view.part = 1);
        let html = parts_of(&solution, &input);
        let inliers = solution.inlier_track_count();
        assert!(html.contains("form 2 parts"));
        assert!(
            html.contains(&format!("<tr><td>1</td><td>3</td><td>3</td><td>23</td><td>{inliers}</td></tr>")),
            "{html}"
        );
        assert!(html.contains("<tr><td>2</td><td>2</td><td>33</td><td>43</td><td>0</td></tr>"), "{html}");
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
            format!("<tr><td>13</td><td>yes</td><td>1</td><td>40</td><td>{inliers}</td><td>0.5</td><td>0.5</td></tr>");
        assert!(html.contains(&row), "{html}");
        assert!(html.contains("<tr><td>43</td><td>no</td><td>-</td>"));
    }
}
