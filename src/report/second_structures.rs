//! Second structures: how each moves, and how much of it is reconstructed.

use std::fmt::Write;

use crate::domain::Solution;
use crate::formats::second_structures;

/// The section; nothing where there is none.
pub fn section(solution: &Solution) -> String {
    let structures = second_structures::counts(solution);
    if structures.is_empty() {
        return String::new();
    }
    let mut html = String::from(
        "<section id=\"second-structures\">\n<h2>Second structures</h2>\n<p>Rejected tracks that agree on rigid motions \
         of their own. Each has a frame and a scale of its own; second-structures.json holds poses and points.</p>\n\
         <div class=\"table\"><table>\n<tr><th>number</th><th>kind</th><th>tracks</th><th>views with poses</th>\
         <th>points</th></tr>\n",
    );
    for structure in structures {
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            structure.number,
            structure.kind.map_or("-", second_structures::kind_words),
            structure.tracks,
            structure.views,
            structure.points
        );
    }
    html.push_str("</table></div>\n</section>\n");
    html
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn each_has_a_row() {
        let html = section(&fixture::solved_with_second_structures().1);
        for row in [
            "<tr><td>1</td><td>moving body</td><td>10</td><td>2</td><td>1</td></tr>",
            "<tr><td>2</td><td>-</td><td>10</td><td>0</td><td>0</td></tr>",
        ] {
            assert!(html.contains(row), "{html}");
        }
        assert_eq!(section(&fixture::solved().1), "");
    }
}
