//! What makes no input, by field and index.

use std::collections::HashMap;

use super::{FocalPrior, ImageSize, Input, RawInput, View};
use crate::domain::error::{Violation, Violations, quoted};
use crate::domain::limits::Limits;
use crate::domain::result::LEAST_VIEWS;
use crate::domain::words::counted;

pub(super) fn check_counts(raw: &RawInput, limits: &Limits, field: &impl Fn(&str) -> String, found: &mut Violations) {
    let mut bound = |name: &str, count: usize, max: usize, what: &str| {
        if count > max {
            found.push(Violation::of(field(name), format!("{count} {what} are above the limit of {max}")));
        }
    };
    bound("views", raw.views.len(), limits.max_views, "views");
    bound("track_count", raw.track_count, limits.max_tracks, "tracks");
    bound("xs", raw.x.len(), limits.max_observations, "observations");
    if raw.views.len() < 2 {
        found.push(Violation::of(field("views"), too_few_views(raw.views.len())));
    }
    if raw.track_count == 0 {
        found.push(Violation::of(field("track_count"), "no tracks given, at least 1 is needed"));
    }
    if raw.x.is_empty() {
        found.push(Violation::of(field("xs"), "no observations given"));
    }
    let lengths = [("view_indices", raw.view.len()), ("track_indices", raw.track.len()), ("ys", raw.y.len())];
    for (name, length) in lengths {
        if length != raw.x.len() {
            found.push(Violation::of(
                field(name),
                format!(
                    "has {} where xs has {}; all must have one an observation",
                    counted(length, "entry"),
                    raw.x.len()
                ),
            ));
        }
    }
    for (name, values) in [("depths", &raw.depth), ("sigmas_px", &raw.sigma)] {
        if !values.is_empty() && values.len() != raw.x.len() {
            found.push(Violation::of(
                field(name),
                format!(
                    "has {} where xs has {}; give one an observation or none",
                    counted(values.len(), "entry"),
                    raw.x.len()
                ),
            ));
        }
    }
}

/// What is wrong with fewer than two views. Two are taken: the network gives their tracks weights, and the result says
/// that there is no reconstruction.
pub fn too_few_views(count: usize) -> String {
    let given = if count == 1 { "1 view" } else { "no views" };
    format!("{given} given; a reconstruction needs at least {LEAST_VIEWS}")
}

pub(super) fn check_views(views: &[View], field: &impl Fn(&str) -> String, found: &mut Violations) {
    let mut names = HashMap::new();
    for (index, view) in views.iter().enumerate() {
        if let Some(name) = view.name.as_deref() {
            if let Err(description) = View::check_name(name) {
                found.push(Violation::at(field("views"), index, description).within("name"));
            }
            if let Some(first) = names.insert(name, index) {
                let description = format!("the name {} is that of view {first} too", quoted(name));
                found.push(Violation::at(field("views"), index, description).within("name"));
            }
        }
        if let Some(ImageSize { width_px, height_px }) = view.size {
            for (part, side) in [("size.width_px", width_px), ("size.height_px", height_px)] {
                if side == 0 || side > ImageSize::MAX_SIDE_PX {
                    let most = ImageSize::MAX_SIDE_PX;
                    let description = format!(
                        "size {width_px} x {height_px} px is not within 1..={most}; leave both out when unknown"
                    );
                    found.push(Violation::at(field("views"), index, description).within(part));
                }
            }
        }
        if let Some(FocalPrior { focal_px, sigma_log }) = view.focal_prior {
            let parts = [
                ("focal_prior.focal_px", focal_px, FocalPrior::FOCAL_RANGE_PX),
                ("focal_prior.sigma_log", sigma_log, FocalPrior::SIGMA_LOG_RANGE),
            ];
            for (part, value, (least, most)) in parts {
                // Written so that NaN fails.
                if !(least..=most).contains(&value) {
                    let description = format!(
                        "focal prior {focal_px:e} px with sigma {sigma_log:e}: {value:e} is not within {least:e}..={most:e}"
                    );
                    found.push(Violation::at(field("views"), index, description).within(part));
                }
            }
        }
    }
}

pub(super) fn check_observations(raw: &RawInput, field: &impl Fn(&str) -> String, found: &mut Violations) {
    for k in 0..raw.x.len() {
        if raw.view[k] as usize >= raw.views.len() {
            found.push(Violation::at(
                field("view_indices"),
                k,
                format!("view {} is outside the {} views given", raw.view[k], raw.views.len()),
            ));
        }
        if raw.track[k] as usize >= raw.track_count {
            found.push(Violation::at(
                field("track_indices"),
                k,
                format!("track {} is outside the declared count of {}", raw.track[k], raw.track_count),
            ));
        }
        for (name, value) in [("xs", raw.x[k]), ("ys", raw.y[k])] {
            if let Err(what) = check_position(value) {
                found.push(Violation::at(field(name), k, what));
            }
        }
        let (least, most) = Input::DEPTH_RANGE;
        if let Some(&depth) = raw.depth.get(k)
            && !(least..=most).contains(&depth.abs())
        {
            found.push(Violation::at(
                field("depths"),
                k,
                format!("{depth:?} is not of a size within {least:e}..={most:e}; leave an unobserved point out"),
            ));
        }
        let (least, most) = Input::SIGMA_RANGE;
        if let Some(sigma) = raw.sigma.get(k)
            && !(least..=most).contains(sigma)
        {
            let what = format!("{sigma:?} px is no standard deviation within {least:e}..={most:e} px");
            found.push(Violation::at(field("sigmas_px"), k, what));
        }
    }
}

/// Whether a number can be a coordinate of a point in pixels.
pub(in crate::domain) fn check_position(value: f64) -> Result<(), String> {
    let most = Input::MAX_COORDINATE_PX;
    if !value.is_finite() {
        Err(format!("{value} is not a finite number"))
    } else if value.abs() > most {
        Err(format!("{value:e} px is beyond {most:e} px; coordinates are in pixels"))
    } else {
        Ok(())
    }
}

pub(super) fn check_duplicates(raw: &RawInput, order: &[u32], field: &impl Fn(&str) -> String, found: &mut Violations) {
    for pair in order.windows(2) {
        let (first, second) = (pair[0] as usize, pair[1] as usize);
        if raw.track[first] == raw.track[second] && raw.view[first] == raw.view[second] {
            found.push(Violation::at(
                field("track_indices"),
                second,
                format!(
                    "track {} is observed a second time in view {} (first at index {first})",
                    raw.track[second], raw.view[second]
                ),
            ));
        }
    }
}

pub(super) fn check_views_with_observations(raw: &RawInput, field: &impl Fn(&str) -> String, found: &mut Violations) {
    let mut seen = vec![false; raw.views.len()];
    for &view in &raw.view {
        if let Some(seen) = seen.get_mut(view as usize) {
            *seen = true;
        }
    }
    let count = seen.iter().filter(|&&seen| seen).count();
    if count < 2 {
        found.push(Violation::of(
            field("view_indices"),
            format!("all observations lie in one view; a reconstruction needs at least {LEAST_VIEWS} views"),
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::raw;
    use super::*;

    fn violations(raw: RawInput) -> Vec<String> {
        let error = Input::new(raw, &Limits::default(), "track_set").expect_err("invalid input was accepted");
        error.violations().iter().map(Violation::path).collect()
    }

    #[test]
    fn names_field_and_index_of_what_is_wrong() {
        let with = |change: &dyn Fn(&mut RawInput)| {
            let mut raw = raw();
            change(&mut raw);
            violations(raw)
        };
        assert_eq!(with(&|raw| raw.x[2] = f64::NAN), ["track_set.xs[2]"]);
        assert_eq!(with(&|raw| raw.y[3] = f64::INFINITY), ["track_set.ys[3]"]);
        assert_eq!(with(&|raw| raw.y[1] = 1e300), ["track_set.ys[1]"]);
        assert_eq!(with(&|raw| raw.track[0] = 2), ["track_set.track_indices[0]"]);
        assert_eq!(with(&|raw| raw.view[3] = 7), ["track_set.view_indices[3]"]);
        assert_eq!(with(&|raw| raw.track[1] = 0), ["track_set.track_indices[2]"]);
        assert_eq!(with(&|raw| raw.depth = vec![1.0, 0.0, 1.0, 1.0]), ["track_set.depths[1]"]);
        assert_eq!(with(&|raw| raw.depth = vec![1.0]), ["track_set.depths"]);
        assert_eq!(
            with(&|raw| raw.sigma = vec![1.0, 0.5, f64::NAN, 0.0]),
            ["track_set.sigmas_px[2]", "track_set.sigmas_px[3]"]
        );
        assert_eq!(with(&|raw| raw.sigma = vec![1.0]), ["track_set.sigmas_px"]);
        assert_eq!(with(&|raw| raw.y.truncate(3)), ["track_set.ys"]);
        assert_eq!(with(&|raw| raw.track_count = 0), ["track_set.track_count"]);
        assert_eq!(with(&|raw| raw.views.truncate(1)), ["track_set.views"]);
        let half_a_size = View { size: Some(ImageSize { width_px: 640, height_px: 0 }), ..View::default() };
        assert_eq!(with(&|raw| raw.views[1] = half_a_size.clone()), ["track_set.views[1].size.height_px"]);
        for (focal_px, sigma_log, fields) in [
            (1e300, 0.1, vec!["track_set.views[0].focal_prior.focal_px"]),
            (800.0, 1e-200, vec!["track_set.views[0].focal_prior.sigma_log"]),
            (
                f64::NAN,
                0.0,
                vec!["track_set.views[0].focal_prior.focal_px", "track_set.views[0].focal_prior.sigma_log"],
            ),
        ] {
            let focal_prior = Some(FocalPrior { focal_px, sigma_log });
            assert_eq!(with(&|raw| raw.views[0].focal_prior = focal_prior), fields, "{focal_px} {sigma_log}");
        }
        assert_eq!(
            with(&|raw| raw.view = vec![0, 0, 0, 0]),
            ["track_set.track_indices[3]", "track_set.track_indices[1]", "track_set.view_indices"]
        );
    }

    #[test]
    fn refuses_what_is_above_the_limits_before_looking_at_numbers() {
        let limits = Limits { max_views: 1, max_tracks: 1, max_observations: 3 };
        let error = Input::new(raw(), &limits, "track_set").expect_err("above the limits");
        assert_eq!(error.violations().len(), 3);
    }

    #[test]
    fn lists_a_bounded_number_of_violations() {
        let mut raw = raw();
        raw.track_count = 1000;
        raw.x = vec![f64::NAN; 500];
        raw.y = vec![0.0; 500];
        raw.view = vec![0; 500];
        raw.view[0] = 1;
        raw.track = (0..500).collect();
        let error = Input::new(raw, &Limits::default(), "track_set").expect_err("all NaN");
        assert_eq!((error.violations().len(), error.unlisted()), (3, 0));
        assert!(error.to_string().ends_with("xs[2]: NaN is not a finite number; and 497 more like this"), "{error}");
    }
}
