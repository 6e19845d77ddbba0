//! `report.html`: one self-contained page that shows a result to a person, without a network.
//!
//! May depend on `domain` and on what `formats` says of results: labels, warnings, counts. Every string is escaped on its
//! way into the page.

pub mod calibration;
pub mod chart;
pub mod counts;
pub mod covisibility;
pub mod html;
pub mod labels;
pub mod pack;
pub mod plan;
pub mod scene;
pub mod second_structures;
pub mod sections;
pub mod space;
pub mod splits;
pub mod views;
pub mod words;

#[cfg(test)]
mod tests;

use crate::domain::Solution;
use crate::formats::LabelledInput;

const STYLE: &str = include_str!("report.css");
const SCRIPT: &str = concat!(
    "(() => {\n",
    include_str!("script/common.js"),
    include_str!("script/images.js"),
    include_str!("script/space.js"),
    "})();\n"
);

/// Nothing may be fetched, from wherever the page is opened.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'";

/// Colours that tell parts apart, `p0` and on in the style sheet; more parts take them in turn.
const PART_COLOURS: u32 = 6;

/// The page. Without the input there is no picture of the tracks.
///
/// The same solution and input give the same page; times stand on two lines only, so that pages can be compared.
pub fn page(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let counts = counts::of_views(solution, input);
    let body = [
        sections::headline(solution, input),
        sections::warnings(solution, input),
        calibration::section(solution),
        space::section(solution, input),
        views::parts(solution, input, &counts),
        scene::section(solution, input, &counts),
        splits::section(solution, input),
        second_structures::section(solution),
        covisibility::section(solution, input),
        sections::convergence(solution),
        sections::weights(solution),
        views::table(solution, input, &counts),
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
