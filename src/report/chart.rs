//! Line charts and histograms as inline SVG, coloured by the page's style sheet.

use std::fmt::Write;

use super::html::{escape, short};

/// Outer size of a chart and its margins, in the units of its `viewBox`.
pub const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 238.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 14.0;
/// Room for the title, and the names of marks below it.
const TOP: f64 = 38.0;
const BOTTOM: f64 = 34.0;
/// Room for the name of a mark.
const MARK_NAME: f64 = 40.0;
/// Ticks that an axis aims at.
const TICKS: f64 = 5.0;
/// Decades below the largest value that a logarithmic axis shows; what is smaller is drawn at its lower end.
const DECADES: f64 = 8.0;

/// One curve: a name for the legend and its points.
pub struct Series<'a> {
    pub name: &'a str,
    pub points: Vec<(f64, f64)>,
}

/// What a line chart shows.
pub struct LineChart<'a> {
    pub title: &'a str,
    pub x_label: &'a str,
    pub series: Vec<Series<'a>>,
    pub logarithmic: bool,
    /// Bounds that values are clipped to before the axis is chosen, so that a wild start hides nothing.
    pub clip: Option<(f64, f64)>,
    /// Vertical marks: position and name.
    pub marks: Vec<(f64, String)>,
}

/// A range of values on an axis and where it lies in the drawing.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn place(&self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    /// Round values within the range, a 1-2-5 step apart.
    fn ticks(&self) -> Vec<f64> {
        let rough = (self.high - self.low) / TICKS;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|k| k * power).into_iter().find(|&step| step >= rough).unwrap_or(rough);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last).map(|k| k as f64 * step).collect()
    }
}

impl LineChart<'_> {
    /// The chart; a note in its place when there is nothing to draw.
    pub fn svg(&self) -> String {
        let series: Vec<(&str, Vec<(f64, f64)>)> =
            self.series.iter().map(|series| (series.name, self.transformed(&series.points))).collect();
        let mut svg = open(self.title);
        let all = || series.iter().flat_map(|(_, points)| points.iter().copied());
        if all().next().is_none() {
            text(&mut svg, WIDTH / 2.0, HEIGHT / 2.0, "middle", "mute", "nothing recorded");
            return close(svg);
        }
        let x = axis(all().map(|(x, _)| x), LEFT, WIDTH - RIGHT, 0.0);
        let y = axis(all().map(|(_, y)| y), HEIGHT - BOTTOM, TOP, 0.06);
        self.frame(&mut svg, &x, &y);
        self.draw_marks(&mut svg, &x);
        for (index, (_, points)) in series.iter().enumerate() {
            let path: Vec<String> =
                points.iter().map(|&(px, py)| format!("{:.1},{:.1}", x.place(px), y.place(py))).collect();
            let _ = write!(svg, "<polyline class=\"line c{index}\" points=\"{}\"/>", path.join(" "));
        }
        self.legend(&mut svg);
        close(svg)
    }

    /// Clipped, logarithms taken, what is not finite left out.
    fn transformed(&self, points: &[(f64, f64)]) -> Vec<(f64, f64)> {
        let clip = |y: f64| self.clip.map_or(y, |(low, high)| y.clamp(low, high));
        let finite = points.iter().filter(|(x, y)| x.is_finite() && y.is_finite()).map(|&(x, y)| (x, clip(y)));
        if !self.logarithmic {
            return finite.collect();
        }
        let largest = self.series.iter().flat_map(|series| &series.points).map(|point| point.1);
        let top = largest.filter(|y| y.is_finite()).fold(f64::MIN_POSITIVE, f64::max).log10();
        finite.map(|(x, y)| (x, if y > 0.0 { y.log10().max(top - DECADES) } else { top - DECADES })).collect()
    }

    fn frame(&self, svg: &mut String, x: &Axis, y: &Axis) {
        for tick in y.ticks() {
            if self.logarithmic && tick.fract() != 0.0 {
                continue;
            }
            let at = y.place(tick);
            let _ = write!(
                svg,
                "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/>",
                WIDTH - RIGHT
            );
            let label = if self.logarithmic { format!("1e{tick:.0}") } else { short(tick) };
            text(svg, LEFT - 6.0, at + 3.5, "end", "tick", &label);
        }
        for tick in x.ticks() {
            let at = x.place(tick);
            text(svg, at, HEIGHT - BOTTOM + 14.0, anchor(at), "tick", &short(tick));
        }
        text(svg, (LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 5.0, "middle", "mute", self.x_label);
    }

    /// Vertical lines, named above the plot where there is room.
    fn draw_marks(&self, svg: &mut String, x: &Axis) {
        let mut free_from = f64::NEG_INFINITY;
        for (position, name) in &self.marks {
            let at = x.place(*position);
            if !(LEFT..=WIDTH - RIGHT).contains(&at) {
                continue;
            }
            let bottom = HEIGHT - BOTTOM;
            let _ = write!(svg, "<line class=\"mark\" x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{TOP}\" y2=\"{bottom}\"/>");
            if at >= free_from && at + MARK_NAME <= WIDTH {
                text(svg, at, TOP - 3.0, "start", "tiny", name);
                free_from = at + MARK_NAME;
            }
        }
    }

    fn legend(&self, svg: &mut String) {
        if self.series.len() < 2 {
            return;
        }
        /// Room for one entry, line and name.
        const ENTRY: f64 = 62.0;
        for (index, series) in self.series.iter().enumerate() {
            let at = WIDTH - RIGHT - ENTRY * (self.series.len() - index) as f64;
            let _ = write!(
                svg,
                "<line class=\"line c{index}\" x1=\"{at:.1}\" x2=\"{:.1}\" y1=\"14\" y2=\"14\"/>",
                at + 14.0
            );
            text(svg, at + 18.0, 18.0, "start", "tick", series.name);
        }
    }
}

/// What the classes of a chart mean outside the page.
const STANDALONE_STYLE: &str = "text{font:11px system-ui,sans-serif;fill:#444}.title{font-size:13px;font-weight:600}\
.grid{stroke:#ddd}.line{fill:none;stroke-width:1.8;stroke:#1668b8}.line.c1{stroke:#c2410c}.line.c2{stroke:#4d7c0f}";

/// Charts one below the other as a file of their own, on white.
pub fn standalone(charts: &[String]) -> String {
    let height = HEIGHT * charts.len() as f64;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" \
         height=\"{height}\">\n<style>{STANDALONE_STYLE}</style>\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (place, chart) in charts.iter().enumerate() {
        let _ = writeln!(svg, "<g transform=\"translate(0 {})\">", HEIGHT * place as f64);
        let sized = format!("<svg width=\"{WIDTH}\" height=\"{HEIGHT}\" ");
        let _ = writeln!(svg, "{}\n</g>", chart.replacen("<svg ", &sized, 1));
    }
    svg + "</svg>\n"
}

/// Which point of a tick's label stands at `at`: its middle, or near the right border, which would clip it, its end.
pub fn anchor(at: f64) -> &'static str {
    /// Half a label of seven digits.
    const HALF_LABEL: f64 = 22.0;
    if at + HALF_LABEL > WIDTH { "end" } else { "middle" }
}

/// A histogram over 0..1 of two kinds, stacked; heights are square roots, so that small bars stay visible.
pub fn histogram(title: &str, x_label: &str, kinds: [(&str, &[f64]); 2]) -> String {
    const BINS: usize = 25;
    let mut counts = [[0usize; 2]; BINS];
    for (kind, (_, values)) in kinds.iter().enumerate() {
        for value in values.iter().filter(|value| value.is_finite()) {
            let bin = ((value.clamp(0.0, 1.0) * BINS as f64) as usize).min(BINS - 1);
            counts[bin][kind] += 1;
        }
    }
    let tallest = counts.iter().map(|bin| bin[0] + bin[1]).max().unwrap_or(0).max(1) as f64;
    let x = Axis { low: 0.0, high: 1.0, from: LEFT, to: WIDTH - RIGHT };
    let y = Axis { low: 0.0, high: tallest.sqrt(), from: HEIGHT - BOTTOM, to: TOP };
    let mut svg = open(title);
    for share in [0.25, 0.5, 0.75, 1.0] {
        let count = (tallest * share * share).round();
        let at = y.place(count.sqrt());
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/>",
            WIDTH - RIGHT
        );
        text(&mut svg, LEFT - 6.0, at + 3.5, "end", "tick", &format!("{count}"));
    }
    let width = (x.to - x.from) / BINS as f64;
    for (bin, count) in counts.iter().enumerate() {
        let left = x.from + width * bin as f64 + 1.0;
        let mut below = 0.0;
        for (kind, &number) in count.iter().enumerate().filter(|(_, number)| **number > 0) {
            let above = below + number as f64;
            let (bottom, top) = (y.place(f64::sqrt(below)), y.place(above.sqrt()));
            let _ = write!(
                svg,
                "<rect class=\"bar k{kind}\" x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\"><title>{number} {}</title></rect>",
                width - 2.0,
                bottom - top,
                escape(kinds[kind].0)
            );
            below = above;
        }
    }
    for tick in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let at = x.place(tick);
        text(&mut svg, at, HEIGHT - BOTTOM + 14.0, anchor(at), "tick", &short(tick));
    }
    text(&mut svg, (LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 5.0, "middle", "mute", x_label);
    for (kind, (name, _)) in kinds.iter().enumerate() {
        let at = WIDTH - RIGHT - 74.0 * (2 - kind) as f64;
        let _ = write!(svg, "<rect class=\"bar k{kind}\" x=\"{at:.1}\" y=\"9\" width=\"10\" height=\"10\"/>");
        text(&mut svg, at + 14.0, 18.0, "start", "tick", name);
    }
    close(svg)
}

/// Counts in equal intervals of 0..1 over time, as columns of cells that are the darker the larger their share of the
/// column.
///
/// * `columns`: position, increasing, and counts; all of the same length
pub fn heat_map(title: &str, x_label: &str, columns: &[(f64, &[u32])]) -> String {
    /// Columns that are drawn; of those that share one, the first is.
    const DRAWN: usize = 80;
    let x = axis(columns.iter().map(|(at, _)| *at), LEFT, WIDTH - RIGHT, 0.0);
    let y = Axis { low: 0.0, high: 1.0, from: HEIGHT - BOTTOM, to: TOP };
    let mut svg = open(title);
    let width = (x.to - x.from) / DRAWN as f64;
    let mut free_from = f64::NEG_INFINITY;
    for (at, counts) in columns {
        let left = x.from + width * ((x.place(*at) - x.from) / width).floor().min(DRAWN as f64 - 1.0);
        if left < free_from {
            continue;
        }
        free_from = left + 0.5 * width;
        let total = counts.iter().sum::<u32>().max(1);
        let cell = 1.0 / counts.len() as f64;
        for (place, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
            let top = y.place(cell * (place + 1) as f64);
            let height = y.place(cell * place as f64) - top;
            // Square roots, so that few tracks stay visible.
            let shade = (f64::from(count) / f64::from(total)).sqrt();
            let _ = write!(
                svg,
                "<rect class=\"cell\" x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.2}\" height=\"{height:.1}\" \
                 opacity=\"{shade:.2}\"/>"
            );
        }
    }
    for tick in [0.0, 0.5, 1.0] {
        text(&mut svg, LEFT - 6.0, y.place(tick) + 3.5, "end", "tick", &short(tick));
    }
    for tick in x.ticks() {
        let at = x.place(tick);
        text(&mut svg, at, HEIGHT - BOTTOM + 14.0, anchor(at), "tick", &short(tick));
    }
    text(&mut svg, (LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 5.0, "middle", "mute", x_label);
    close(svg)
}

/// The range of values, widened by a share on both sides; a single value gets a range of its own size.
fn axis(values: impl Iterator<Item = f64>, from: f64, to: f64, margin: f64) -> Axis {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    let span = high - low;
    let pad = if span > 0.0 { span * margin } else { (low.abs() * 0.1).max(0.5) };
    Axis { low: low - pad, high: high + pad, from, to }
}

fn open(title: &str) -> String {
    let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">", escape(title));
    text(&mut svg, 8.0, 18.0, "start", "title", title);
    svg
}

fn close(mut svg: String) -> String {
    svg.push_str("</svg>");
    svg
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, class: &str, content: &str) {
    let _ = write!(
        svg,
        "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>",
        escape(content)
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(points: Vec<(f64, f64)>, logarithmic: bool) -> String {
        let series = vec![Series { name: "a<b", points: points.clone() }, Series { name: "c", points }];
        LineChart { title: "t", x_label: "x", series, logarithmic, clip: None, marks: vec![(1.0, "m".to_owned())] }
            .svg()
    }

    #[test]
    fn draws_finite_points_only() {
        let svg = chart(vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, f64::INFINITY), (3.0, 2.0)], false);
        let points = svg.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("a line");
        assert_eq!(points.split(' ').count(), 2, "{points}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        assert!(svg.contains("a&lt;b") && !svg.contains("a<b"));
    }

    #[test]
    fn survives_nothing_one_point_and_zero_on_a_logarithmic_axis() {
        assert!(chart(Vec::new(), false).contains("nothing recorded"));
        for svg in
            [chart(vec![(5.0, 5.0)], false), chart(vec![(0.0, 0.0)], false), chart(vec![(0.0, 0.0), (1.0, 1e30)], true)]
        {
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn higher_values_stand_higher() {
        let svg = chart(vec![(0.0, 1.0), (1.0, 100.0)], true);
        let points = svg.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("a line");
        let y: Vec<f64> = points.split(' ').filter_map(|p| p.split(',').nth(1)?.parse().ok()).collect();
        assert!(y[0] > y[1], "{points}");
    }

    #[test]
    fn a_histogram_counts_every_value_once() {
        let svg = histogram("t", "w", [("in", &[1.0, 0.99, 2.0]), ("out", &[0.0, f64::NAN, 0.001])]);
        assert!(svg.contains("<title>3 in</title>"), "{svg}");
        assert!(svg.contains("<title>2 out</title>"), "{svg}");
    }
}
