//! The page that shows an evaluation together: figures, what METRIC is worth, every cell.

use std::fmt::Write;

use super::figures;
use super::plan::{Depths, Plan};
use super::summary::{Cell, Coverage};
use crate::report::html::escape;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:110rem;padding:0 1.5rem;color:#111;\
background:#fff}table{border-collapse:collapse;font-size:13px}td,th{padding:.15rem .7rem;text-align:right;\
border-bottom:1px solid #ddd}td:nth-child(-n+4),th:nth-child(-n+4){text-align:left}figure{margin:1.5rem 0;overflow-x:auto}\
svg{min-width:70rem;width:100%}caption{text-align:left;padding:.5rem 0}";

/// The page; nothing is fetched from anywhere. `note`: what there is to say of runs that are missing.
pub fn page(plan: &Plan, cells: &[Cell], coverage: &[Coverage], note: Option<&str>) -> String {
    let mut body = String::from("<h1>Evaluation</h1>\n");
    if let Some(note) = note {
        let _ = writeln!(body, "<p><strong>{}</strong></p>", escape(note));
    }
    body.push_str(
        "<p>Every method on the same scenes, against an oracle that knows the truth. F1 is a mean \
         over the seeds; errors are medians over the seeds that have one. 2D error: root mean square distance of the \
         reprojections from the true image points. 3D error: mean relative distance after the best similarity. Focal \
         error: |ln(f / f true)|. Of psfm, F1 is that of the best threshold.",
    );
    let _ = writeln!(body, " The network of paper and scpsfm has {} of the original's width.</p>", plan.paper_width);
    let has_figure = plan.sweeps.iter().any(|sweep| sweep.names.is_empty());
    for &depths in plan.depths.iter().filter(|_| has_figure) {
        let what = match depths {
            Depths::Given => "Depths given",
            Depths::None => "No depths: image points alone",
            Depths::Epipolar => {
                "No depths given: estimated from fundamental matrices and epipoles, by paper, scpsfm and psfm"
            }
        };
        let _ = write!(body, "<h2>{what}</h2>\n<figure>{}</figure>\n", figures::svg(plan, cells, depths));
    }
    body.push_str(&coverage_table(coverage));
    body.push_str(&cell_table(cells));
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>scpsfm evaluation</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n{body}</body>\n</html>\n"
    )
}

fn coverage_table(coverage: &[Coverage]) -> String {
    let mut table = String::from(
        "<h2>What METRIC is worth</h2>\n<table>\n<tr><th>method</th><th>scenes</th><th>METRIC</th>\
         <th>within 1 sigma</th><th>within 3 sigma</th><th>wrong by &gt; 5 %</th>\
         <th>METRIC where the Cramer-Rao bound is below .01</th></tr>\n",
    );
    for row in coverage {
        let _ = writeln!(
            table,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{:.1} %</td><td>{:.1} %</td><td>{}</td><td>{:.1} % of {}</td></tr>",
            row.contestant.name(),
            row.scenes,
            row.metric,
            100.0 * row.within_one_sigma,
            100.0 * row.within_three_sigma,
            row.metric_and_wrong,
            100.0 * row.determined_metric,
            row.determined
        );
    }
    table + "</table>\n"
}

fn cell_table(cells: &[Cell]) -> String {
    let mut table = String::from(
        "<h2>Every cell</h2>\n<table>\n<tr><th>sweep</th><th>at</th><th>depths</th><th>method</th><th>seeds</th><th>F1</th>\
         <th>least F1</th><th>by observation</th><th>2D px</th><th>3D</th><th>focal %</th><th>of the oracle's</th><th>METRIC</th><th>WEAK</th>\
         <th>PROJECTIVE</th><th>seconds</th></tr>\n",
    );
    let shown = |value: Option<f64>, factor: f64, digits: usize| {
        value.map_or_else(|| "-".into(), |value| format!("{:.*}", digits, factor * value))
    };
    for cell in cells {
        let interval =
            cell.focal_ratio_interval.map_or_else(String::new, |[low, high]| format!(" ({low:.2} to {high:.2})"));
        let _ = writeln!(
            table,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.3}</td><td>{:.3}</td><td>{}</td><td>{}</td><td>{}</td>\
             <td>{}</td><td>{}{}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td></tr>",
            escape(cell.sweep),
            escape(&cell.place),
            cell.depths.name(),
            cell.contestant.name(),
            cell.seeds,
            cell.mean_f1,
            cell.least_f1,
            shown(cell.observation_f1, 1.0, 3),
            shown(cell.error_2d_px, 1.0, 2),
            shown(cell.error_3d, 1.0, 4),
            shown(cell.focal_error, 100.0, 2),
            shown(cell.focal_ratio, 1.0, 2),
            interval,
            cell.metric,
            cell.weak,
            cell.projective_only,
            cell.median_seconds
        );
    }
    table + "</table>\n"
}
