//! The page as a whole.

use super::*;
use crate::domain::{Status, Warning, WarningCode};
use crate::formats::{Label, fixture};
use crate::synthetic::{SceneOptions, SequenceOptions};

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
        "id=\"calibration\"",
        "id=\"parts\"",
        "id=\"covisibility\"",
    ] {
        assert!(page.contains(part), "no {part}");
    }
    assert!(page.contains("<dt>rejected tracks</dt><dd>20</dd>"));
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
    assert!(page.contains("known up to a projective transformation only") && page.contains("no calibration to show"));
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

#[test]
fn a_long_sequence_makes_a_small_page() {
    let options = SequenceOptions { views: 1000, tracks: 200_000, ..SequenceOptions::default() };
    let (mut input, mut solution) = fixture::solved_sequence(&options);
    // Names as long as files may have, of characters that grow when escaped.
    input.view_labels = (0..1000).map(|view| Label::Name(format!("{}{view}.jpg", "<".repeat(4000)).into())).collect();
    input.track_labels = (0..200_000).map(|track| Label::Name(format!("{track}{}", "<".repeat(200)).into())).collect();
    solution.views.iter_mut().skip(700).for_each(|view| view.part = 1);
    let page = page(&solution, Some(&input));
    assert!(page.len() < 5 * 1024 * 1024, "{} bytes", page.len());
    assert!(page.contains("of 200000 tracks are drawn") && page.contains("form 2 parts"));
}

/// Three sequences one after the other: more views than the generator makes at once.
fn long_sequence() -> (LabelledInput, Solution) {
    let options = SequenceOptions { views: 1000, tracks: 20_000, ..SequenceOptions::default() };
    let (mut input, mut solution) = fixture::solved_sequence(&options);
    let (one, answer) = (input.raw.clone(), solution.clone());
    for copy in 1..3 {
        input.raw.views.extend(one.views.iter().cloned());
        input.raw.track_count += one.track_count;
        input.raw.view.extend(one.view.iter().map(|view| view + copy * 1000));
        input.raw.track.extend(one.track.iter().map(|track| track + copy * 20_000));
        input.raw.x.extend(&one.x);
        input.raw.y.extend(&one.y);
        solution.views.extend(answer.views.iter().cloned());
        solution.tracks.weight.extend(&answer.tracks.weight);
        solution.tracks.inlier.extend(&answer.tracks.inlier);
        solution.tracks.point.extend(&answer.tracks.point);
        solution.observations.inlier.extend(&answer.observations.inlier);
        solution.observations.residual_px.extend(&answer.observations.residual_px);
    }
    (LabelledInput::unlabelled(input.raw, &input.path), solution)
}

/// Names as hostile as a file may hold, more views than a page lists, and reasons that name views.
#[test]
fn hostile_names_of_many_views_stay_text_in_a_small_page() {
    let (mut input, mut solution) = long_sequence();
    for (view, result) in solution.views.iter_mut().enumerate() {
        if view % 5 == 0 {
            *result = fixture::left_out(crate::domain::LeftOut::NotRegistered { points: 9, agreeing: 2 });
        } else if view > 2000 {
            result.part = 1;
        }
    }
    let clean = page(&solution, Some(&input));
    // What a page shows of a long name is its end.
    let ends = [
        "\"><img src=x onerror=e(1)>",
        "'/><b id='e'>&lt;",
        "</script><script>e(1)//",
        "</text></svg><svg onload=e(1)>",
    ];
    let name = |k: usize| {
        let end = format!("{k}{}", ends[k % 4]);
        Label::Name(format!("{}{end}", "\u{e9}".repeat(200 - end.len())).into())
    };
    input.view_labels = (0..3000).map(name).collect();
    input.track_labels = (0..60_000).map(name).collect();
    let page = page(&solution, Some(&input));
    assert!(page.len() < 5 * 1024 * 1024, "{} bytes", page.len());
    // In the data of the script, quotes and `>` stand as they are; what could end it is the `<`.
    for tag in ["<img", "<b ", "<script", "</script", "</text></svg><svg", "\"><img"] {
        assert_eq!(page.matches(tag).count(), clean.matches(tag).count(), "names brought in {tag}");
    }
    assert!(page.contains("0&quot;&gt;&lt;img src=x onerror=e(1)&gt; (2 of the 9 points it sees agree on a pose)"));
    assert!(page.contains("600 of 3000 views were left out") && page.contains("2000 of 3000 views are listed"));
}

#[test]
fn the_same_result_makes_the_same_page_but_for_two_lines() {
    let options = SequenceOptions { views: 30, tracks: 500, ..SequenceOptions::default() };
    let (input, mut solution) = fixture::solved_sequence(&options);
    let first = page(&solution, Some(&input));
    assert_eq!(first, page(&solution, Some(&input)));
    solution.seconds *= 3.0;
    solution.stages.iter_mut().for_each(|stage| stage.seconds += 1.0);
    solution.proposal_times.iter_mut().for_each(|time| time.seconds = Some(0.25));
    solution.history.iter_mut().for_each(|record| record.elapsed_seconds += 1.0);
    let second = page(&solution, Some(&input));
    let differing = first.lines().zip(second.lines()).filter(|(a, b)| a != b).count();
    assert_eq!((first.lines().count(), differing), (second.lines().count(), 2));
}

/// A document that is just enough for the script of the images, which prints the strokes: opacity and points of each.
const IMAGES_UNDER_NODE: &str = r#"
const strokes = [];
let points = [];
const state = {}, calls = {
  beginPath() { points = []; }, moveTo(...at) { points.push(at); }, lineTo(...at) { points.push(at); },
  stroke() { strokes.push([state.globalAlpha, points.length]); },
};
const context = new Proxy(state, { get: (_, name) => calls[name] ?? (() => {}) });
const element = { addEventListener() {}, add() {}, replaceChildren() {}, append() {}, style: {}, checked: true,
  insertRow: () => element, getContext: () => context, textContent: "" };
const elements = { "tracks-data": { textContent: DATA }, colour: { ...element, value: "inlier" },
  view: { ...element, get value() { return VIEW; }, set value(_) {} } };
const document = { getElementById: (id) => elements[id] ?? element, createElement: () => element };
const getComputedStyle = () => ({ getPropertyValue: () => "" });
const matchMedia = () => element, addEventListener = () => {}, devicePixelRatio = 1;
const Option = class {};
"#;

/// Strokes with which the page joins the observations of a view to others of their tracks, those of accepted
/// observations and the rest; `None` without node.
fn flow_lines(input: &LabelledInput, solution: &Solution, view: usize) -> Option<[usize; 2]> {
    let counts = counts::of_views(solution, Some(input));
    let data = serde_json::to_string(&scene::tracks(solution, input, &counts).json.to_string()).expect("text");
    let document = IMAGES_UNDER_NODE.replace("DATA", &data).replace("VIEW", &format!("\"{view}\""));
    let scripts = [include_str!("script/common.js"), include_str!("script/images.js")].concat();
    let program = format!("{document}{scripts}\nimages(); console.log(JSON.stringify(strokes));");
    let Ok(output) = std::process::Command::new("node").args(["-e", &program]).output() else {
        eprintln!("SKIPPED the flow lines of the report: no node");
        return None;
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let strokes: Vec<(Option<f64>, usize)> = serde_json::from_slice(&output.stdout).expect("strokes");
    let with = |opacity: f64| strokes.iter().filter(|(found, _)| *found == Some(opacity)).count();
    Some([with(0.6), with(0.18)])
}

/// Of an inlier track, what was left out is on no line, and the accepted observations before and after it are joined.
#[test]
fn flow_lines_join_observations_of_one_point() {
    let (input, mut solution) = fixture::solved();
    let track = solution.tracks.inlier.iter().position(|inlier| *inlier).expect("an inlier");
    let mut of_track = [0; 5];
    for (k, view) in input.raw.view.iter().enumerate().filter(|(k, _)| input.raw.track[*k] as usize == track) {
        of_track[*view as usize] = k;
    }
    let inliers = solution.inlier_track_count();
    let outliers = solution.tracks.inlier.len() - inliers;
    for (left_out, lines) in [
        (vec![], [[0; 2]; 4]),
        (vec![2], [[0, 0], [0, 0], [1, 0], [0, 0]]),
        (vec![2, 3, 4], [[0, 0], [1, 0], [1, 0], [1, 0]]),
    ] {
        for (view, &k) in of_track.iter().enumerate() {
            solution.observations.inlier[k] = !left_out.contains(&view);
        }
        for (view, fewer) in lines.into_iter().enumerate() {
            let Some(found) = flow_lines(&input, &solution, view) else { return };
            let expected = [inliers - fewer[0], outliers - fewer[1]];
            assert_eq!(found, expected, "view {view}, {left_out:?} left out: accepted, others");
        }
    }
}
