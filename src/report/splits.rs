//! Tracks that join several points: the points of each, and who sees them.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use super::html::{escape, short};
use super::labels;
use crate::domain::{Solution, counted};
use crate::formats::LabelledInput;

/// Tracks listed; observations.csv has them all.
const MAX_TRACKS: usize = 200;

/// A point of a track, by the track's index and the point's number among its points, 0 for its own.
type Key = (u32, u32);

/// Observations of a point, and the first and the last view that shows it.
type Seen = BTreeMap<Key, (usize, u32, u32)>;

/// The section; nothing where no track joins several points.
pub fn section(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let tracks: BTreeSet<u32> = solution.splits.iter().map(|split| split.track).collect();
    if tracks.is_empty() {
        return String::new();
    }
    let seen = seen(solution, input, &tracks);
    let mut html = format!(
        "<section id=\"splits\">\n<h2>Tracks that join several points</h2>\n<p>Wrong links join {} to {}. \
         Each is a point of its own here and in the exports, with the observations that show it.</p>\n\
         <div class=\"table\"><table>\n<tr><th>track</th><th>point</th><th>weight</th><th>observations</th><th>first view</th>\
         <th>last view</th></tr>\n",
        counted(solution.splits.len(), "further point"),
        counted(tracks.len(), "track")
    );
    for &track in tracks.iter().take(MAX_TRACKS) {
        let weight = solution.tracks.weight.get(track as usize).copied().unwrap_or(0.0);
        html.push_str(&row(solution, (track, 0), weight, &seen, input));
        for split in solution.splits.iter().filter(|split| split.track == track) {
            html.push_str(&row(solution, (track, split.number), split.weight, &seen, input));
        }
    }
    html.push_str("</table></div>\n");
    if tracks.len() > MAX_TRACKS {
        let _ = writeln!(html, "<p class=\"note\">{MAX_TRACKS} of {} tracks are listed.</p>", tracks.len());
    }
    html.push_str("</section>\n");
    html
}

fn row(solution: &Solution, key: Key, weight: f32, seen: &Seen, input: Option<&LabelledInput>) -> String {
    let (count, first, last) = match seen.get(&key) {
        Some(&(count, first, last)) => (
            count.to_string(),
            labels::view(solution, input, first as usize),
            labels::view(solution, input, last as usize),
        ),
        None => ("-".to_owned(), "-".to_owned(), "-".to_owned()),
    };
    format!(
        "<tr><td>{}</td><td>{}</td><td>{}</td><td>{count}</td><td>{}</td><td>{}</td></tr>\n",
        escape(&labels::track(input, key.0 as usize)),
        if key.1 == 0 { "its own".to_owned() } else { key.1.to_string() },
        short(f64::from(weight)),
        escape(&first),
        escape(&last)
    )
}

/// Who sees the points of these tracks; nothing without the input.
fn seen(solution: &Solution, input: Option<&LabelledInput>, tracks: &BTreeSet<u32>) -> Seen {
    let mut seen = Seen::new();
    let Some(raw) = input.map(|input| &input.raw) else { return seen };
    for (k, (&view, &track)) in raw.view.iter().zip(&raw.track).enumerate() {
        let number = match solution.observations.split.get(k) {
            _ if solution.observations.inlier.get(k) == Some(&true) => 0,
            Some(&number) if number > 0 => number,
            _ => continue,
        };
        if tracks.contains(&track) {
            let (count, first, last) = seen.entry((track, number)).or_insert((0, view, view));
            (*count, *first, *last) = (*count + 1, view.min(*first), view.max(*last));
        }
    }
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn both_points_are_listed_with_their_views() {
        let (input, solution) = fixture::solved_with_a_split();
        let html = section(&solution, Some(&input));
        let name = labels::track(Some(&input), solution.splits[0].track as usize);
        assert!(
            html.contains(&format!("<tr><td>{name}</td><td>its own</td><td>0.98</td><td>3</td><td>3</td><td>23</td>")),
            "{html}"
        );
        assert!(
            html.contains(&format!("<tr><td>{name}</td><td>1</td><td>0.9</td><td>2</td><td>33</td><td>43</td>")),
            "{html}"
        );
        assert!(section(&solution, None).contains("<td>-</td>"), "without the input nobody knows who sees it");
        assert_eq!(section(&fixture::solved().1, None), "");
    }
}
