//! The rows as a page.

use std::fmt::Write;

use super::{Row, table};
use crate::report::html::escape;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:120rem;padding:0 1.5rem;color:#111;\
background:#fff}div{overflow-x:auto}table{border-collapse:collapse;font-size:13px}td,th{padding:.15rem .6rem;\
text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}.words{text-align:left}";

/// The page; nothing is fetched from anywhere. `peer`: the other program's command line, empty where there is none;
/// `note`: what there is to say of runs that are missing.
pub fn page(rows: &[Row], peer: &[String], note: Option<&str>) -> String {
    let mut table = String::from("<table>\n<tr>");
    for heading in table::headings() {
        let _ = write!(table, "<th>{}</th>", escape(heading));
    }
    table.push_str("</tr>\n");
    for row in rows {
        table.push_str("<tr>");
        for (cell, is_words) in table::cells(row) {
            let class = if is_words { " class=\"words\"" } else { "" };
            let _ = write!(table, "<td{class}>{}</td>", escape(&cell));
        }
        table.push_str("</tr>\n");
    }
    table.push_str("</table>\n");
    let peer = match peer {
        [] => String::new(),
        words => format!("<p>Peer: <code>{}</code></p>\n", escape(&words.join(" "))),
    };
    let note = note.map_or_else(String::new, |note| format!("<p><strong>{}</strong></p>\n", escape(note)));
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>scpsfm on real sequences</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n<h1>Real sequences</h1>\n{note}{peer}<p>Views: how many are registered, of how many, and in how many parts where \
         there are several. Focal %: deviation from the known focal \
         length. Precision, recall and F1: over all observations against the labels, by the side's verdicts on \
         observations or on tracks. Mean and rms px: reprojection errors over what the side itself kept. Centres %: root \
         mean square error of the camera centres of the largest part after the best similarity, as a share of the known \
         trajectory's extent; ~ where the cameras were estimated from the same tracks. CPU s, wall s and peak MB: of the \
         whole process, its start included.</p>\n<div>{table}</div>\n</body>\n</html>\n"
    )
}
