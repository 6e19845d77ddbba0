//! `report.html`: one self-contained page that shows a result to a person, without a network.
//!
//! May depend on `domain` and on the labels of `formats`. Every string is escaped on its way into the page.

pub mod chart;
pub mod html;
pub mod scene;
pub mod sections;
pub mod words;

use crate::domain::Solution;
use crate::formats::LabelledInput;

const STYLE: &str = include_str!("report.css");
const SCRIPT: &str = include_str!("report.js");

/// Nothing may be fetched, from wherever the page is opened.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'";

/// The page. Without the input there is no picture of the tracks.
///
/// The same solution and input give the same page; times stand on two lines only, so that pages can be compared.
pub fn page(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let body = [
        sections::headline(solution),
        sections::warnings(solution),
        sections::convergence(solution),
        sections::weights(solution),
        sections::images(solution, input),
        sections::space(solution, input),
        sections::views(solution, input),
        sections::footer(solution),
    ]
    .concat();
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">\n\
         <title>scpsfm report</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n\
         <script>\n{SCRIPT}</script>\n</body>\n</html>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Status, Warning, WarningCode};
    use crate::formats::{Label, fixture};
    use crate::synthetic::SceneOptions;

    #[test]
    fn fetches_nothing_and_escapes_everything() {
        let (mut input, mut solution) = fixture::solved();
        let hostile = "</script><script>alert(1)</script><img src=x onerror='a'>";
        // Image names come from files of others.
        input.view_labels[1] = Label::Name(hostile.into());
        solution.warnings.push(Warning::new(WarningCode::ViewsLeftOut, hostile));
        let page = page(&solution, Some(&input));
        for forbidden in ["http://", "https://", "//cdn", "<link", "@import", "url(", "<img", "fetch(", hostile] {
            assert!(!page.contains(forbidden), "the page holds {forbidden}");
        }
        assert!(page.contains("&lt;/script&gt;&lt;script&gt;alert(1)"));
        assert_eq!(page.matches("</script>").count(), page.matches("<script").count());
    }

    #[test]
    fn shows_every_part() {
        let (input, solution) = fixture::solved();
        let page = page(&solution, Some(&input));
        for part in [
            "id=\"headline\"",
            "id=\"warnings\"",
            "id=\"convergence\"",
            "id=\"weights\"",
            "id=\"images\"",
            "id=\"space\"",
            "id=\"views\"",
        ] {
            assert!(page.contains(part), "no {part}");
        }
        let focal = format!("{:.1}", solution.calibrations[0].focal_px);
        assert!(page.contains(&focal));
        for curve in ["L_num", "L_proj", "L_DAQ"] {
            assert!(page.contains(curve), "no curve {curve}");
        }
    }

    #[test]
    fn an_unsolved_scene_and_an_absent_input_make_a_page_too() {
        let (input, mut solution) = fixture::solved();
        solution.status = Status::NoReconstruction;
        solution.grade = None;
        solution.calibrations.clear();
        solution.views.iter_mut().for_each(|view| *view = Default::default());
        solution.tracks.inlier.iter_mut().for_each(|inlier| *inlier = false);
        solution.tracks.point.iter_mut().for_each(|point| *point = None);
        solution.history.clear();
        solution.tracks.network_weight.clear();
        let with = page(&solution, Some(&input));
        assert!(with.contains("NO_RECONSTRUCTION") && with.contains("nothing recorded"));
        let without = page(&solution, None);
        assert!(without.contains("without the input"));
        assert!(!without.contains("id=\"tracks-data\""));
    }

    #[test]
    fn a_projective_result_shows_no_focal_length_and_no_space() {
        let (input, solution) = fixture::projective_only();
        let page = page(&solution, Some(&input));
        assert!(page.contains(">PROJECTIVE_ONLY<"));
        assert!(page.contains("<dt>focal length</dt><dd>none</dd><p>unobservable</p>"));
        assert!(page.contains("no metric reconstruction to show") && !page.contains("id=\"space-data\""));
        assert!(page.contains("id=\"tracks-data\""));
    }

    #[test]
    fn a_large_input_makes_a_small_page() {
        let options = SceneOptions { views: 20, tracks: 20_000, outliers: 0.5, ..SceneOptions::default() };
        let (input, solution) = fixture::solved_with(&options);
        let page = page(&solution, Some(&input));
        assert!(page.len() < 5 * 1024 * 1024, "{} bytes", page.len());
        assert!(page.contains("of 20000 tracks are drawn"));
    }
}
