//! The paper's figure: one column a sweep, one row a measure, one line a contestant. Self-contained SVG.

use std::fmt::Write;

use super::plan::{Contestant, Depths, Plan};
use super::summary::Cell;
use crate::report::html::escape;
use crate::synthetic::SceneOptions;

/// Size of one panel's plot and the room around it, in the units of the `viewBox`.
const PANEL: (f64, f64) = (210.0, 120.0);
const GAP: (f64, f64) = (62.0, 46.0);
const MARGIN: (f64, f64) = (66.0, 58.0);
/// Between the bars of two contestants on the same cell.
const BAR_DISTANCE: f64 = 1.2;
/// Columns that there is always room for, so that the legend fits.
const LEAST_COLUMNS: usize = 3;
/// Ratio of the largest to the smallest value on the horizontal axis from which it is logarithmic.
const LOGARITHMIC_FROM: f64 = 8.0;
/// Decades that a vertical axis shows below its largest value.
const MOST_DECADES: f64 = 4.0;

/// What a row of panels shows.
struct Measure {
    label: &'static str,
    of: fn(&Cell) -> Option<f64>,
    /// Its 95 % bootstrap interval.
    interval: fn(&Cell) -> Option<[f64; 2]>,
    /// Fixed bounds of a linear axis; `None`: logarithmic, by the values.
    bounds: Option<(f64, f64)>,
}

const MEASURES: [Measure; 4] = [
    Measure { label: "F1", of: |cell| Some(cell.mean_f1), interval: |cell| cell.f1_interval, bounds: Some((0.0, 1.0)) },
    Measure {
        label: "2D error (px)",
        of: |cell| cell.error_2d_px,
        interval: |cell| cell.error_2d_px_interval,
        bounds: None,
    },
    Measure { label: "3D error", of: |cell| cell.error_3d, interval: |cell| cell.error_3d_interval, bounds: None },
    Measure {
        label: "focal error",
        of: |cell| cell.focal_error,
        interval: |cell| cell.focal_error_interval,
        bounds: None,
    },
];

/// Colours that differ in lightness too (Okabe & Ito 2008), and dashes for whoever sees none.
fn stroke(contestant: Contestant) -> (&'static str, &'static str) {
    match contestant {
        Contestant::Oracle => ("#000000", "2 3"),
        Contestant::Auto => ("#d55e00", ""),
        Contestant::Geometry => ("#0072b2", ""),
        Contestant::Paper => ("#009e73", ""),
        Contestant::PaperWithoutDaq => ("#009e73", "5 3"),
        Contestant::Scpsfm => ("#e69f00", ""),
        Contestant::ScpsfmWithoutDaq => ("#e69f00", "5 3"),
        Contestant::Psfm => ("#cc79a7", ""),
        Contestant::AutoWithoutDaq => ("#d55e00", "8 3"),
        Contestant::AutoWithoutIrls => ("#56b4e9", ""),
        Contestant::AutoWithoutConsistency => ("#56b4e9", "5 3"),
        Contestant::AutoWithoutRigidity => ("#e69f00", ""),
        Contestant::AutoWithoutUniform => ("#e69f00", "5 3"),
        Contestant::AutoWithoutLearned => ("#d55e00", "1 3"),
        Contestant::LearnedAlone => ("#56b4e9", "1 3"),
        Contestant::NetworkAlone => ("#009e73", "2 2"),
    }
}

/// The figure of one way of giving depths.
///
/// Sweeps whose cells have names instead of values are left to the tables.
pub fn svg(plan: &Plan, cells: &[Cell], depths: Depths) -> String {
    let sweeps: Vec<_> = plan.sweeps.iter().filter(|sweep| sweep.names.is_empty()).collect();
    let width = MARGIN.0 + sweeps.len().max(LEAST_COLUMNS) as f64 * (PANEL.0 + GAP.0);
    let height = MARGIN.1 + MEASURES.len() as f64 * (PANEL.1 + GAP.1);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" role=\"img\" \
         font-family=\"sans-serif\" font-size=\"10\"><title>Depths {}: every method over every sweep</title>\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>",
        depths.name()
    );
    legend(&mut out, plan, depths);
    for (column, sweep) in sweeps.into_iter().enumerate() {
        let left = MARGIN.0 + column as f64 * (PANEL.0 + GAP.0);
        text(&mut out, (left + PANEL.0 / 2.0, MARGIN.1 - 12.0), "middle", "#000", &sweep.name.replace('-', " "));
        let x = Axis::horizontal(sweep.cells.iter().map(|(x, _)| *x), left);
        for (row, measure) in MEASURES.iter().enumerate() {
            let top = MARGIN.1 + row as f64 * (PANEL.1 + GAP.1);
            let here: Vec<&Cell> =
                cells.iter().filter(|cell| cell.sweep == sweep.name && cell.depths == depths).collect();
            panel(&mut out, &x, top, measure, &here);
            text(&mut out, (left + PANEL.0 / 2.0, top + PANEL.1 + 28.0), "middle", "#555", sweep.label);
            if column == 0 {
                let (x, y) = (left - 46.0, top + PANEL.1 / 2.0);
                let _ = write!(
                    out,
                    "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\" transform=\"rotate(-90 {x:.1} {y:.1})\">{}</text>",
                    measure.label
                );
            }
        }
    }
    out.push_str("</svg>\n");
    out
}

fn legend(out: &mut String, plan: &Plan, depths: Depths) {
    let mut left = MARGIN.0;
    let scene = SceneOptions::default();
    for contestant in plan.contestants_with(&scene, depths) {
        let (colour, dash) = stroke(contestant);
        let _ = write!(
            out,
            "<line x1=\"{left:.0}\" x2=\"{:.0}\" y1=\"16\" y2=\"16\" stroke=\"{colour}\" stroke-width=\"2\" \
             stroke-dasharray=\"{dash}\"/>",
            left + 24.0
        );
        text(out, (left + 29.0, 19.5), "start", "#000", contestant.name());
        left += 44.0 + 6.2 * contestant.name().len() as f64;
    }
    if plan.seeds > 1 {
        text(out, (MARGIN.0, 35.0), "start", "#555", "Bars: 95 % bootstrap intervals over the scenes of a cell");
    }
}

fn panel(out: &mut String, x: &Axis, top: f64, measure: &Measure, cells: &[&Cell]) {
    let interval = |cell: &Cell| (measure.interval)(cell).filter(|ends| ends.iter().all(|end| end.is_finite()));
    let values = cells.iter().filter_map(|cell| (measure.of)(cell)).filter(|value| value.is_finite());
    let ends = cells.iter().filter_map(|cell| interval(cell)).flatten();
    let Some(y) = Axis::vertical(values.chain(ends), top, measure.bounds) else {
        text(out, ((x.from + x.to) / 2.0, top + PANEL.1 / 2.0), "middle", "#888", "nothing reconstructed");
        frame(out, x, top);
        return;
    };
    for tick in y.ticks() {
        let at = y.place(tick);
        let _ = write!(
            out,
            "<line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/>",
            x.from, x.to
        );
        text(out, (x.from - 5.0, at + 3.5), "end", "#555", &number(tick));
    }
    for tick in x.ticks() {
        let at = x.place(tick);
        let _ = write!(
            out,
            "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"#888\"/>",
            top + PANEL.1,
            top + PANEL.1 + 4.0
        );
        text(out, (at, top + PANEL.1 + 15.0), "middle", "#555", &number(tick));
    }
    frame(out, x, top);
    let mut contestants: Vec<Contestant> = cells.iter().map(|cell| cell.contestant).collect();
    contestants.sort_unstable();
    contestants.dedup();
    let middle = (contestants.len().max(1) - 1) as f64 / 2.0;
    for (place, contestant) in contestants.into_iter().enumerate() {
        let own = || cells.iter().filter(|cell| cell.contestant == contestant);
        let points: Vec<(f64, f64)> = own()
            .filter_map(|cell| Some((x.place(cell.x), y.place((measure.of)(cell).filter(|value| value.is_finite())?))))
            .collect();
        line(out, contestant, &points);
        for (cell, ends) in own().filter_map(|cell| Some((cell, interval(cell)?))) {
            // Side by side: many lie at the same place.
            let beside = (place as f64 - middle) * BAR_DISTANCE;
            bar(out, contestant, x.place(cell.x) + beside, ends.map(|end| y.place(end)));
        }
    }
}

fn frame(out: &mut String, x: &Axis, top: f64) {
    let _ = write!(
        out,
        "<rect x=\"{:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"#888\"/>",
        x.from,
        x.to - x.from,
        PANEL.1
    );
}

fn line(out: &mut String, contestant: Contestant, points: &[(f64, f64)]) {
    let (colour, dash) = stroke(contestant);
    let path: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    let _ = write!(
        out,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\" stroke-dasharray=\"{dash}\"/>",
        path.join(" ")
    );
    for (x, y) in points {
        let _ = write!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.2\" fill=\"{colour}\"/>");
    }
}

/// The ends of an interval, joined.
fn bar(out: &mut String, contestant: Contestant, x: f64, [from, to]: [f64; 2]) {
    let (colour, _) = stroke(contestant);
    let _ = write!(out, "<path d=\"M{x:.1} {from:.1}V{to:.1}\" stroke=\"{colour}\"/>");
}

fn text(out: &mut String, (x, y): (f64, f64), anchor: &str, colour: &str, content: &str) {
    let _ = write!(
        out,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\">{}</text>",
        escape(content)
    );
}

/// A tick's number: short, without trailing zeros.
fn number(value: f64) -> String {
    if value != 0.0 && (value.abs() < 1e-3 || value.abs() >= 1e5) { format!("{value:.0e}") } else { format!("{value}") }
}

/// A range of values and where it lies in the drawing.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
    logarithmic: bool,
    /// Values of its own to put ticks at; empty: round ones.
    marks: Vec<f64>,
}

impl Axis {
    /// The axis of a sweep, with a tick at every cell.
    fn horizontal(values: impl Iterator<Item = f64>, left: f64) -> Self {
        let marks: Vec<f64> = values.collect();
        let low = marks.iter().copied().fold(f64::INFINITY, f64::min);
        let high = marks.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let logarithmic = low > 0.0 && high / low >= LOGARITHMIC_FROM;
        Self { low, high, from: left, to: left + PANEL.0, logarithmic, marks }.padded()
    }

    /// The axis of a measure; `None` without values.
    fn vertical(values: impl Iterator<Item = f64>, top: f64, bounds: Option<(f64, f64)>) -> Option<Self> {
        let (from, to) = (top + PANEL.1, top);
        if let Some((low, high)) = bounds {
            let marks = [0.0, 0.25, 0.5, 0.75, 1.0].map(|share| low + share * (high - low)).to_vec();
            return Some(Self { low, high, from, to, logarithmic: false, marks }.padded());
        }
        let positive: Vec<f64> = values.filter(|value| *value > 0.0).collect();
        let high = positive.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let low = positive.iter().copied().fold(f64::INFINITY, f64::min).max(high * 10f64.powf(-MOST_DECADES));
        high.is_finite().then(|| Self { low, high, from, to, logarithmic: true, marks: Vec::new() }.padded())
    }

    /// Four per cent of room on either side.
    fn padded(mut self) -> Self {
        let (low, high) = (self.scaled(self.low), self.scaled(self.high));
        let room = if high > low { 0.04 * (high - low) } else { 0.5 };
        let back = |value: f64| if self.logarithmic { value.exp() } else { value };
        (self.low, self.high) = (back(low - room), back(high + room));
        self
    }

    fn scaled(&self, value: f64) -> f64 {
        if self.logarithmic { value.ln() } else { value }
    }

    fn place(&self, value: f64) -> f64 {
        let (low, high) = (self.scaled(self.low), self.scaled(self.high));
        self.from + (self.scaled(value).clamp(low, high) - low) / (high - low) * (self.to - self.from)
    }

    /// The marks, or round values in the range; of marks that would overlap the later ones are left out.
    fn ticks(&self) -> Vec<f64> {
        if !self.marks.is_empty() {
            let mut kept: Vec<f64> = Vec::new();
            for &mark in &self.marks {
                if kept.last().is_none_or(|&last| (self.place(mark) - self.place(last)).abs() > 24.0) {
                    kept.push(mark);
                }
            }
            return kept;
        }
        let decades = (self.low.log10().ceil() as i32)..=(self.high.log10().floor() as i32);
        let tens: Vec<f64> = decades.map(|decade| 10f64.powi(decade)).collect();
        if tens.len() > 1 {
            return tens;
        }
        let first = self.low.log10().floor() as i32;
        (first..first + 3)
            .flat_map(|decade| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(decade)))
            .filter(|value| (self.low..=self.high).contains(value))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::sweeps::Sweep;

    fn cell(x: f64, contestant: Contestant, error: Option<f64>) -> Cell {
        Cell {
            sweep: "outliers",
            x,
            place: x.to_string(),
            depths: Depths::None,
            contestant,
            seeds: 1,
            mean_f1: x,
            least_f1: x,
            observation_f1: Some(x),
            reached: 1.0,
            seconds_to_reach: None,
            solved: 1.0,
            error_2d_px: error,
            error_3d: error,
            focal_error: error,
            f1_interval: Some([0.9 * x, x]),
            error_2d_px_interval: None,
            error_3d_interval: None,
            focal_error_interval: None,
            focal_ratio: None,
            focal_ratio_interval: None,
            metric: 1.0,
            weak: 0.0,
            projective_only: 0.0,
            median_seconds: 0.1,
        }
    }

    #[test]
    fn every_value_is_a_point_and_nothing_else() {
        let plan = Plan {
            sweeps: Sweep::paper(),
            depths: vec![Depths::None],
            contestants: vec![Contestant::Oracle, Contestant::Auto, Contestant::Psfm],
            seeds: 1,
            paper_width: 0.25,
        };
        let cells = [
            cell(0.5, Contestant::Auto, Some(1.0)),
            cell(0.9, Contestant::Auto, None),
            cell(0.9, Contestant::Oracle, Some(0.001)),
            cell(0.95, Contestant::Auto, Some(f64::NAN)),
        ];
        let svg = svg(&plan, &cells, Depths::None);
        // Four F1 values; two finite errors on each of the three other rows.
        assert_eq!(svg.matches("<circle").count(), 4 + 3 * 2);
        assert_eq!(svg.matches("<path").count(), 4, "F1 alone has intervals");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(svg.contains("nothing reconstructed"), "the other sweeps have no cells");
        // Another way of giving depths has no cells at all.
        assert!(!super::svg(&plan, &cells, Depths::Given).contains("<circle"));
        // The legend names who took part.
        let epipolar = super::svg(&plan, &cells, Depths::Epipolar);
        assert!(svg.contains(">oracle<") && !epipolar.contains(">oracle<") && epipolar.contains(">psfm<"));
    }

    #[test]
    fn an_axis_of_shares_has_its_ticks_from_0_to_1() {
        let axis = Axis::vertical(std::iter::empty(), 0.0, Some((0.0, 1.0))).expect("bounds");
        assert_eq!(axis.ticks(), [0.0, 0.25, 0.5, 0.75, 1.0]);
    }

    #[test]
    fn places_grow_with_values() {
        for axis in [
            Axis::horizontal([5.0, 10.0, 100.0].into_iter(), 0.0),
            Axis::horizontal([0.5, 0.9].into_iter(), 0.0),
            Axis::horizontal([3.0].into_iter(), 0.0),
        ] {
            let places: Vec<f64> = axis.marks.iter().map(|&mark| axis.place(mark)).collect();
            assert!(places.windows(2).all(|pair| pair[0] < pair[1]), "{places:?}");
            assert!(places.iter().all(|place| (0.0..=PANEL.0).contains(place)), "{places:?}");
        }
    }
}
