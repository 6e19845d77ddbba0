//! Which views share how many inlier tracks: a heat map, views by views.

use std::fmt::Write;

use super::html::escape;
use super::{counts, labels};
use crate::domain::Solution;
use crate::formats::LabelledInput;

/// Rows of the map; more views share rows. At 460 units across, a row is some 4 pixels on the screen.
const MAX_BINS: usize = 120;
/// Shades of the map; the eye tells few more apart.
const SHADES: usize = 12;
/// Side of the map and its margins, in the units of the `viewBox`. The strip beside the map tells the parts.
const SIDE: f64 = 440.0;
const MARGIN: f64 = 12.0;
const STRIP: f64 = 4.0;

/// Shared tracks by bins of consecutive views.
struct Map {
    /// Views a bin.
    span: usize,
    bins: usize,
    /// Row by row; on the diagonal the tracks of the bin.
    counts: Vec<u32>,
}

impl Map {
    fn new(of_tracks: &[Vec<u32>], views: usize) -> Self {
        let span = views.div_ceil(MAX_BINS).max(1);
        let bins = views.div_ceil(span);
        let mut counts = vec![0u32; bins * bins];
        let mut seen = Vec::new();
        for views in of_tracks {
            seen.clear();
            seen.extend(views.iter().map(|&view| view as usize / span));
            seen.dedup();
            for &row in &seen {
                for &column in &seen {
                    counts[row * bins + column] += 1;
                }
            }
        }
        Self { span, bins, counts }
    }

    fn at(&self, row: usize, column: usize) -> u32 {
        self.counts[row * self.bins + column]
    }

    /// The most that two different bins share.
    fn most(&self) -> u32 {
        let pairs = (0..self.bins).flat_map(|row| (0..row).map(move |column| (row, column)));
        pairs.map(|(row, column)| self.at(row, column)).max().unwrap_or(0)
    }

    /// Shade of a cell, 0 for nothing; by the square root, so that weak links stay visible.
    fn shade(&self, row: usize, column: usize, most: u32) -> usize {
        let share = f64::from(self.at(row, column)) / f64::from(most.max(1));
        ((share.sqrt() * SHADES as f64).ceil() as usize).min(SHADES)
    }

    /// One path a shade; equal neighbours in a row are one rectangle.
    fn paths(&self, svg: &mut String) {
        let most = self.most();
        let mut paths = vec![String::new(); SHADES + 1];
        for row in 0..self.bins {
            let mut from = 0;
            while from < self.bins {
                let shade = self.shade(row, from, most);
                let to = (from..self.bins).find(|&to| self.shade(row, to, most) != shade).unwrap_or(self.bins);
                if shade > 0 {
                    let run = to - from;
                    let _ = write!(paths[shade], "M{from} {row}h{run}v1h-{run}z");
                }
                from = to;
            }
        }
        for (shade, path) in paths.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
            let opacity = shade as f64 / SHADES as f64;
            let _ = write!(svg, "<path class=\"cell\" fill-opacity=\"{opacity:.2}\" d=\"{path}\"/>");
        }
    }
}

/// Shared tracks of two registered views of one part that follow each other in the input.
struct Link {
    from: usize,
    to: usize,
    tracks: u32,
}

fn links(solution: &Solution, of_tracks: &[Vec<u32>]) -> Vec<Link> {
    let mut next = vec![None; solution.views.len()];
    for views in counts::parts(solution).values() {
        for pair in views.windows(2) {
            next[pair[0]] = Some(pair[1]);
        }
    }
    let mut shared = vec![0u32; solution.views.len()];
    for views in of_tracks {
        for &view in views {
            let follower = next[view as usize].map(|to| to as u32);
            if follower.is_some_and(|to| views.binary_search(&to).is_ok()) {
                shared[view as usize] += 1;
            }
        }
    }
    let link = |(from, to): (usize, &Option<usize>)| Some(Link { from, to: (*to)?, tracks: shared[from] });
    next.iter().enumerate().filter_map(link).collect()
}

/// The section; a note where the input is not at hand.
pub fn section(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"covisibility\">\n<h2>Tracks that views share</h2>\n");
    let Some(input) = input else {
        html.push_str("<p class=\"note\">This page was made without the input: nothing tells which views share tracks.</p>\n</section>\n");
        return html;
    };
    let of_tracks = counts::inlier_views(solution, input);
    let map = Map::new(&of_tracks, solution.views.len());
    if map.most() == 0 {
        html.push_str("<p class=\"note\">No two views share an inlier track.</p>\n</section>\n");
        return html;
    }
    let summary = summary(solution, input, &of_tracks);
    let _ = write!(
        html,
        "<div class=\"grid\"><figure>{}</figure>\n<div>{}<p class=\"note\">{} Darker: more shared inlier tracks, up to {} \
         between two {} (by the square root). On the diagonal, a view's own. The strips are coloured by part; grey: not \
         registered.</p></div></div>\n</section>\n",
        drawing(solution, &map),
        summary,
        match map.span {
            1 => "Rows and columns are the views in the input's order.".to_string(),
            span => format!("Rows and columns are {span} consecutive views each, in the input's order."),
        },
        map.most(),
        if map.span == 1 { "views" } else { "groups of views" },
    );
    html
}

fn drawing(solution: &Solution, map: &Map) -> String {
    let views = solution.views.len();
    let size = SIDE + MARGIN + STRIP;
    let mut svg = format!(
        "<svg class=\"heat\" viewBox=\"0 0 {size} {size}\" role=\"img\" aria-label=\"inlier tracks that {views} views \
         share, views by views; the weakest links stand in the text\">"
    );
    let cell = SIDE / map.bins as f64;
    for bin in 0..map.bins {
        let registered = (bin * map.span..((bin + 1) * map.span).min(views))
            .find_map(|view| solution.views[view].projection.map(|_| solution.views[view].part));
        let class = registered.map_or_else(|| "none".to_string(), |part| format!("p{}", part % super::PART_COLOURS));
        let at = MARGIN + cell * bin as f64;
        let _ = write!(
            svg,
            "<rect class=\"{class}\" x=\"{at:.2}\" y=\"2\" width=\"{cell:.2}\" height=\"{STRIP}\"/>\
             <rect class=\"{class}\" x=\"2\" y=\"{at:.2}\" width=\"{STRIP}\" height=\"{cell:.2}\"/>"
        );
    }
    let _ = write!(
        svg,
        "<rect class=\"frame\" x=\"{MARGIN}\" y=\"{MARGIN}\" width=\"{SIDE}\" height=\"{SIDE}\"/>\
         <g transform=\"translate({MARGIN} {MARGIN}) scale({cell:.5})\">"
    );
    map.paths(&mut svg);
    svg.push_str("</g></svg>");
    svg
}

/// The weakest links in words.
fn summary(solution: &Solution, input: &LabelledInput, of_tracks: &[Vec<u32>]) -> String {
    /// Links listed: the few that a sequence may break at.
    const WEAKEST: usize = 5;
    let mut links = links(solution, of_tracks);
    if links.is_empty() {
        return String::new();
    }
    let mean = links.iter().map(|link| f64::from(link.tracks)).sum::<f64>() / links.len() as f64;
    links.sort_by_key(|link| (link.tracks, link.from));
    let mut html = format!(
        "<p>Registered views that follow each other share {mean:.0} inlier tracks on average. The weakest links:</p>\n\
         <table id=\"links\"><tr><th>view</th><th>next view</th><th>shared tracks</th></tr>\n"
    );
    for link in links.iter().take(WEAKEST) {
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&labels::view(solution, Some(input), link.from)),
            escape(&labels::view(solution, Some(input), link.to)),
            link.tracks
        );
    }
    html.push_str("</table>\n");
    html
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn pairs_are_counted_once_a_track() {
        let map = Map::new(&[vec![0, 2], vec![0, 1, 2], vec![2]], 3);
        assert_eq!(map.counts, [2, 1, 2, 1, 1, 1, 2, 1, 3]);
        assert_eq!(map.most(), 2);
    }

    #[test]
    fn many_views_share_rows() {
        let map = Map::new(&[vec![0, 1, 2, 999], vec![998, 999]], 1000);
        assert_eq!((map.span, map.bins), (9, 112));
        assert_eq!((map.at(0, 0), map.at(0, 111), map.at(111, 0), map.at(111, 111)), (1, 1, 1, 2));
        assert_eq!(map.at(110, 111), 1, "998 and 999 lie in different bins");
        let mut svg = String::new();
        Map::new(&vec![(0..1000).collect(); 3], 1000).paths(&mut svg);
        assert_eq!(svg.matches("<path").count(), 1, "equal cells are of one shade");
        assert_eq!(svg.matches('M').count(), 112, "equal neighbours are one rectangle");
    }

    #[test]
    fn the_weakest_link_is_named_first() {
        let (input, mut solution) = fixture::solved();
        let inliers = solution.inlier_track_count();
        // Of view 2 all but one inlier go.
        let of_view = |k: &usize| input.raw.view[*k] == 2 && solution.observations.inlier[*k];
        let gone: Vec<usize> = (0..input.raw.view.len()).filter(of_view).skip(1).collect();
        gone.into_iter().for_each(|k| solution.observations.inlier[k] = false);
        let html = section(&solution, Some(&input));
        let row = html.split("<tr><td>").nth(1).expect("a row");
        assert!(row.starts_with("13</td><td>23</td><td>1<"), "{row}");
        assert!(html.contains(&format!("<td>{inliers}</td>")), "{html}");
        // Views of different parts are no link.
        solution.views.iter_mut().skip(2).for_each(|view| view.part = 1);
        assert!(!section(&solution, Some(&input)).contains("<td>13</td><td>23</td>"));
        assert!(section(&solution, None).contains("without the input"));
    }
}
