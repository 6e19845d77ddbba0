//! Windows of consecutive views, each an input of its own, and the table of what came of them.

use std::ops::Range;

use serde::Serialize;

use super::{Label, LabelledInput, warnings};
use crate::domain::{Grade, RawInput, Solution, Status, counted};

/// Names of the files.
pub const CSV: &str = "windows.csv";
pub const JSON: &str = "windows.json";

/// Windows of `length` views, one every `step` views; views at the end that fill none are left.
pub fn ranges(views: usize, length: usize, step: usize) -> Vec<Range<usize>> {
    (0..views).step_by(step.max(1)).map(|first| first..first + length).take_while(|range| range.end <= views).collect()
}

/// The views of a window with the tracks that two of them see or more, under the ids of the whole.
pub fn cut(input: &LabelledInput, range: &Range<usize>) -> LabelledInput {
    let raw = &input.raw;
    let inside: Vec<usize> = (0..raw.view.len()).filter(|&k| range.contains(&(raw.view[k] as usize))).collect();
    let mut seen = vec![0usize; raw.track_count];
    inside.iter().for_each(|&k| seen[raw.track[k] as usize] += 1);
    let mut number = vec![None; raw.track_count];
    let kept = (0..raw.track_count).filter(|&track| seen[track] >= 2);
    let kept: Vec<usize> =
        kept.enumerate().map(|(place, track)| (number[track] = Some(place as u32), track).1).collect();
    let mut cut = LabelledInput {
        raw: RawInput { views: raw.views[range.clone()].to_vec(), track_count: kept.len(), ..RawInput::default() },
        view_labels: input.view_labels[range.clone()].to_vec(),
        track_labels: kept.iter().map(|&track| input.track_labels[track].clone()).collect(),
        colmap_images: input.colmap_images.get(range.clone()).unwrap_or_default().to_vec(),
        path: input.path.clone(),
        ..LabelledInput::default()
    };
    for k in inside {
        let Some(track) = number[raw.track[k] as usize] else { continue };
        cut.raw.view.push(raw.view[k] - range.start as u32);
        cut.raw.track.push(track);
        cut.raw.x.push(raw.x[k]);
        cut.raw.y.push(raw.y[k]);
        cut.raw.depth.extend(raw.depth.get(k));
        cut.raw.sigma.extend(raw.sigma.get(k));
        cut.lines.extend(input.lines.get(k));
        cut.keypoints.extend(input.keypoints.get(k));
    }
    cut
}

/// What came of one window; what is not known is null.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Counted from 1.
    pub window: usize,
    pub first_view: Label,
    pub last_view: Label,
    pub registered_views: usize,
    /// Tracks that two of its views see or more.
    pub tracks: usize,
    pub inlier_tracks: usize,
    pub observations: usize,
    pub inlier_observations: usize,
    pub focal_px: Option<f64>,
    pub sigma_log_focal: Option<f64>,
    /// `NO_RECONSTRUCTION` where there is none.
    pub grade: &'static str,
    /// Over the inlier observations, distances.
    pub reprojection_mean_px: Option<f64>,
    pub reprojection_rms_px: Option<f64>,
    /// Of the solve; `None` where there was none.
    pub seconds: Option<f64>,
    /// Why there is no focal length.
    pub reason: Option<String>,
    /// Codes of the warnings of its solve.
    pub warnings: Vec<&'static str>,
}

impl Row {
    /// Window `index`, counted from 0, as it was cut; nothing came of it for this reason.
    pub fn unsolved(index: usize, input: &LabelledInput, reason: String) -> Self {
        let label = |label: Option<&Label>| label.cloned().unwrap_or(Label::Number(0));
        Self {
            window: index + 1,
            first_view: label(input.view_labels.first()),
            last_view: label(input.view_labels.last()),
            registered_views: 0,
            tracks: input.raw.track_count,
            inlier_tracks: 0,
            observations: input.raw.x.len(),
            inlier_observations: 0,
            focal_px: None,
            sigma_log_focal: None,
            grade: "NO_RECONSTRUCTION",
            reprojection_mean_px: None,
            reprojection_rms_px: None,
            seconds: None,
            reason: Some(reason),
            warnings: Vec::new(),
        }
    }

    /// The same with its solution.
    pub fn solved(index: usize, input: &LabelledInput, solution: &Solution) -> Self {
        let calibration = solution.calibrations.first();
        let why = warnings::reason(solution);
        let why = why.map_or_else(String::new, |warning| format!("{}: {}", warning.code.name(), warning.detail));
        // Several cameras may have the same warning.
        let mut codes = Vec::new();
        for code in solution.warnings.iter().map(|warning| warning.code.name()) {
            if !codes.contains(&code) {
                codes.push(code);
            }
        }
        Self {
            registered_views: solution.registered_views().len(),
            inlier_tracks: solution.inlier_track_count(),
            inlier_observations: solution.inlier_observation_count(),
            focal_px: calibration.map(|calibration| calibration.focal_px),
            sigma_log_focal: calibration.and_then(|calibration| calibration.sigma_log_focal),
            grade: match solution.status {
                Status::NoReconstruction => "NO_RECONSTRUCTION",
                Status::Solved => solution.grade.map_or("SOLVED", Grade::name),
            },
            reprojection_mean_px: solution.reprojection_mean_px,
            reprojection_rms_px: solution.reprojection_rms_px,
            seconds: Some(solution.seconds),
            reason: calibration.is_none().then_some(why),
            warnings: codes,
            ..Self::unsolved(index, input, String::new())
        }
    }
}

/// Mean and median over the windows that have a value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Average {
    pub windows: usize,
    pub mean: f64,
    pub median: f64,
}

impl Average {
    /// `None` where no window has a value.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.filter(|value| value.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        let windows = values.len();
        let (low, high) = (values.get(windows.checked_sub(1)? / 2)?, values.get(windows / 2)?);
        Some(Self { windows, mean: values.iter().sum::<f64>() / windows as f64, median: (low + high) / 2.0 })
    }
}

/// What `windows.json` holds.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    /// Views a window, and from the beginning of one to that of the next.
    pub window: usize,
    pub step: usize,
    /// Views in no window: at the end, where they fill none, and between windows that are farther apart than long.
    pub views_left: usize,
    pub solved: usize,
    pub inlier_tracks: Option<Average>,
    pub focal_px: Option<Average>,
    pub sigma_log_focal: Option<Average>,
    pub reprojection_mean_px: Option<Average>,
    pub seconds: Option<Average>,
    pub windows: Vec<Row>,
}

impl Table {
    /// * `views`: of the input; `window` and `step`: see [`ranges`]
    pub fn new(views: usize, window: usize, step: usize, windows: Vec<Row>) -> Self {
        let over = |pick: fn(&Row) -> Option<f64>| Average::of(windows.iter().filter_map(pick));
        let ranges = ranges(views, window, step);
        let covered = (0..views).filter(|view| ranges.iter().any(|range| range.contains(view))).count();
        Self {
            window,
            step,
            views_left: views - covered,
            solved: windows.iter().filter(|row| row.registered_views > 0).count(),
            inlier_tracks: over(|row| (row.registered_views > 0).then_some(row.inlier_tracks as f64)),
            focal_px: over(|row| row.focal_px),
            sigma_log_focal: over(|row| row.sigma_log_focal),
            reprojection_mean_px: over(|row| row.reprojection_mean_px),
            seconds: over(|row| row.seconds),
            windows,
        }
    }

    /// One line a window; what is not known is empty.
    pub fn csv(&self) -> String {
        let mut text = String::from(
            "window,first_view,last_view,registered_views,tracks,inlier_tracks,observations,inlier_observations,focal_px,\
             sigma_log_focal,grade,reprojection_mean_px,reprojection_rms_px,seconds,reason,warnings\n",
        );
        let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
        for row in &self.windows {
            let reason = row.reason.clone().map_or_else(String::new, |reason| Label::Name(reason.into()).csv());
            text.push_str(&format!(
                "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{reason},{}\n",
                row.window,
                row.first_view.csv(),
                row.last_view.csv(),
                row.registered_views,
                row.tracks,
                row.inlier_tracks,
                row.observations,
                row.inlier_observations,
                number(row.focal_px),
                number(row.sigma_log_focal),
                row.grade,
                number(row.reprojection_mean_px),
                number(row.reprojection_rms_px),
                number(row.seconds),
                row.warnings.join(" "),
            ));
        }
        text
    }

    /// A line a window, then means and medians; for people.
    pub fn text(&self) -> String {
        let mut text = format!(
            "{:>6}  {:<24}{:>8}{:>8}{:>8}{:>10}{:>9}  {:<18}{:>8}{:>9}\n",
            "window", "views", "tracks", "inliers", "seen", "focal px", "sigma %", "grade", "mean px", "seconds"
        );
        let shown = |value: Option<f64>, factor: f64, decimals: usize| {
            value.map_or_else(|| "-".into(), |value| format!("{:.decimals$}", factor * value))
        };
        for row in &self.windows {
            let views = format!("{} to {}", row.first_view.shown(), row.last_view.shown());
            text.push_str(&format!(
                "{:>6}  {views:<24}{:>8}{:>8}{:>8}{:>10}{:>9}  {:<18}{:>8}{:>9}",
                row.window,
                row.tracks,
                row.inlier_tracks,
                row.inlier_observations,
                shown(row.focal_px, 1.0, 1),
                shown(row.sigma_log_focal, 100.0, 2),
                row.grade,
                shown(row.reprojection_mean_px, 1.0, 3),
                shown(row.seconds, 1.0, 2)
            ));
            // The reason begins with the code of its warning.
            let reason = row.reason.as_deref().unwrap_or_default();
            let codes = row.warnings.iter().copied().filter(|code| !reason.starts_with(code));
            let notes: Vec<&str> = codes.chain(Some(reason).filter(|reason| !reason.is_empty())).collect();
            if !notes.is_empty() {
                text.push_str(&format!("  {}", notes.join(", ")));
            }
            text.push('\n');
        }
        let average = |name: &str, pick: fn(&Average) -> f64| {
            let of = |average: &Option<Average>| average.as_ref().map(pick);
            format!(
                "{name:>6}  {:<24}{:>8}{:>8}{:>8}{:>10}{:>9}  {:<18}{:>8}{:>9}\n",
                format!("{} of {} solved", self.solved, counted(self.windows.len(), "window")),
                "",
                shown(of(&self.inlier_tracks), 1.0, 1),
                "",
                shown(of(&self.focal_px), 1.0, 1),
                shown(of(&self.sigma_log_focal), 100.0, 2),
                "",
                shown(of(&self.reprojection_mean_px), 1.0, 3),
                shown(of(&self.seconds), 1.0, 2)
            )
        };
        text.push_str(&average("mean", |average| average.mean));
        text.push_str(&average("median", |average| average.median));
        if self.views_left > 0 {
            text.push_str(&format!("views in no window: {}\n", self.views_left));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Limits;
    use crate::formats::fixture;

    #[test]
    fn windows_follow_each_other_and_what_fills_none_is_left() {
        assert_eq!(ranges(10, 4, 4), [0..4, 4..8]);
        assert_eq!(ranges(11, 4, 3), [0..4, 3..7, 6..10]);
        assert!(ranges(3, 4, 4).is_empty());
        let table = Table::new(10, 4, 4, Vec::new());
        assert_eq!((table.views_left, table.focal_px), (2, None));
        assert!(table.text().contains("views in no window: 2"));
        assert_eq!(Table::new(11, 3, 5, Vec::new()).views_left, 5, "two gaps and the last");
    }

    #[test]
    fn a_window_keeps_ids_points_and_the_tracks_that_two_views_see() {
        let (mut input, _) = fixture::solved();
        // Of track 0 the window sees one observation only.
        let far: Vec<usize> = (0..input.raw.x.len())
            .filter(|&k| input.raw.track[k] == 0 && (1..3).contains(&input.raw.view[k]))
            .collect();
        for k in far.into_iter().rev() {
            for column in [&mut input.raw.view, &mut input.raw.track] {
                column.remove(k);
            }
            input.raw.x.remove(k);
            input.raw.y.remove(k);
            input.lines.remove(k);
        }
        let window = cut(&input, &(1..4));
        assert_eq!(window.view_labels, [Label::Number(13), Label::Number(23), Label::Number(33)]);
        assert_eq!((window.raw.track_count, window.track_labels[0].clone()), (39, Label::Number(102)));
        assert_eq!((window.raw.x.len(), window.lines.len()), (3 * 39, 3 * 39));
        let k = window.lines.len() / 2;
        let whole = input.lines.iter().position(|line| *line == window.lines[k]).expect("a line of the whole");
        assert_eq!((window.raw.x[k], window.raw.view[k]), (input.raw.x[whole], input.raw.view[whole] - 1));
        window.check(&Limits::default()).expect("a valid input");
    }

    #[test]
    fn averages_are_over_what_is_known() {
        let (input, solution) = fixture::solved();
        let mut rows = vec![
            Row::solved(0, &input, &solution),
            Row::unsolved(1, &input, "nothing, \"at all\"".into()),
            Row::solved(2, &input, &fixture::projective_only().1),
        ];
        rows[0].reprojection_mean_px = Some(1.0);
        rows[2].reprojection_mean_px = Some(2.0);
        let focal = solution.calibrations[0].focal_px;
        let table = Table::new(15, 5, 5, rows);
        assert_eq!(table.focal_px, Some(Average { windows: 1, mean: focal, median: focal }));
        assert_eq!(table.reprojection_mean_px, Some(Average { windows: 2, mean: 1.5, median: 1.5 }));
        assert_eq!(Average::of([3.0, 1.0, 8.0].into_iter()).map(|average| average.median), Some(3.0));
        let csv = table.csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[1].starts_with("1,3,43,5,40,20,200,100,") && lines[1].ends_with(",,FEW_INLIERS"), "{csv}");
        assert!(lines[2].ends_with(",,,NO_RECONSTRUCTION,,,,\"nothing, \"\"at all\"\"\","), "{csv}");
        let turned = "UNOBSERVABLE_FOCAL: the camera only moved sideways";
        assert!(lines[3].ends_with(&format!("{turned},UNOBSERVABLE_FOCAL")), "{csv}");
        let text = table.text();
        let rows: Vec<&str> = text.lines().collect();
        assert!(rows[1].ends_with("  FEW_INLIERS") && rows[3].ends_with(&format!("  {turned}")), "{text}");
        assert!(text.contains("2 of 3 windows solved"), "{text}");
    }
}
