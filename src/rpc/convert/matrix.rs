//! Measurement matrices: checked in their own terms, then read as observations, padding stripped.

use super::input::view_from_wire;
use super::input_message::{InputMessage, within};
use crate::domain::error::Violations;
use crate::domain::input::too_few_views;
use crate::domain::{Input, InvalidInput, Limits, RawInput, View, Violation};
use crate::rpc::proto;

/// Name of a matrix in violations.
const MATRIX: &str = proto::MeasurementMatrix::NAME;

fn field(name: &str) -> String {
    format!("{MATRIX}.{name}")
}

/// Refuses what is above the limits by what is claimed and by what has arrived. Padding counts: a matrix that is
/// mostly holes is a track set.
pub(super) fn check_size(matrix: &proto::MeasurementMatrix, limits: &Limits) -> Result<(), InvalidInput> {
    let (n, m) = (matrix.view_count as usize, matrix.track_count as usize);
    within(MATRIX, matrix.declared_counts(limits))?;
    // In u64, since two counts within their limits may still overflow 32 bits together.
    let entries = n as u64 * m as u64;
    if entries > limits.max_observations as u64 {
        return Err(Violation::of(
            field("track_count"),
            format!(
                "{n} views x {m} tracks are {entries} entries, above this server's limit of {}; send what is \
                 observed as a track_set",
                limits.max_observations
            ),
        )
        .into());
    }
    let entries = entries as usize;
    if matrix.values.len() > 3 * entries {
        return Err(wrong_length("values", matrix.values.len(), 3 * entries, "3 x view_count x track_count").into());
    }
    if matrix.visibility.len() > entries {
        return Err(wrong_length("visibility", matrix.visibility.len(), entries, "view_count x track_count").into());
    }
    Ok(())
}

fn wrong_length(name: &str, length: usize, due: usize, rule: &str) -> Violation {
    Violation::of(field(name), format!("has {length} entries where {rule} = {due} are due"))
}

/// Checks a matrix and reads its observations, view by view and track by track.
pub(super) fn to_input(matrix: proto::MeasurementMatrix, limits: &Limits) -> Result<Input, InvalidInput> {
    check_size(&matrix, limits)?;
    check_shape(&matrix)?;
    let raw = observations(&matrix)?;
    Input::new(raw, limits, MATRIX).map_err(in_terms_of_the_matrix)
}

fn check_shape(matrix: &proto::MeasurementMatrix) -> Result<(), InvalidInput> {
    let (n, m) = (matrix.view_count as usize, matrix.track_count as usize);
    let mut found = Violations::default();
    if n < 2 {
        found.push(Violation::of(field("view_count"), too_few_views(n)));
    }
    if m == 0 {
        found.push(Violation::of(field("track_count"), "no tracks given, at least 1 is needed"));
    }
    if matrix.values.len() != 3 * n * m {
        found.push(wrong_length("values", matrix.values.len(), 3 * n * m, "3 x view_count x track_count"));
    }
    if !matrix.visibility.is_empty() && matrix.visibility.len() != n * m {
        found.push(wrong_length("visibility", matrix.visibility.len(), n * m, "view_count x track_count"));
    }
    if !matrix.views.is_empty() && matrix.views.len() != n {
        let count = matrix.views.len();
        found.push(Violation::of(field("views"), format!("has {count} entries for {n} views; give all or none")));
    }
    found.into_result()
}

/// What is observed; the shape is right.
fn observations(matrix: &proto::MeasurementMatrix) -> Result<RawInput, InvalidInput> {
    let (n, m) = (matrix.view_count as usize, matrix.track_count as usize);
    let mut found = Violations::default();
    let mut raw = RawInput {
        views: if matrix.views.is_empty() {
            vec![View::default(); n]
        } else {
            matrix.views.iter().map(view_from_wire).collect()
        },
        track_count: m,
        ..RawInput::default()
    };
    for i in 0..n {
        for j in 0..m {
            if matrix.visibility.get(i * m + j) == Some(&0) {
                continue;
            }
            let at = [0, 1, 2].map(|row| (3 * i + row) * m + j);
            let entry = at.map(|k| matrix.values[k]);
            if entry == [0.0; 3] {
                continue;
            }
            if let Some(violation) = wrong_entry(entry, at) {
                found.push(violation);
                continue;
            }
            let [a, b, c] = entry;
            raw.view.push(i as u32);
            raw.track.push(j as u32);
            raw.x.push(a / c);
            raw.y.push(b / c);
            if matrix.has_depths {
                raw.depth.push(c);
            }
        }
    }
    found.into_result()?;
    Ok(raw)
}

/// What is wrong with one entry (a, b, c) whose numbers stand at `at` in `values`.
fn wrong_entry(entry: [f64; 3], at: [usize; 3]) -> Option<Violation> {
    let [a, b, c] = entry;
    let wrong = |row: usize, text: String| Some(Violation::at(field("values"), at[row], text));
    if let Some(row) = entry.iter().position(|value| !value.is_finite()) {
        return wrong(row, format!("{} is not a finite number", entry[row]));
    }
    if c == 0.0 {
        return wrong(2, "0 is no scale of an observed point; an unobserved entry is (0, 0, 0)".to_owned());
    }
    // Written so that what overflows to infinity is beyond the bound too.
    let row = [a / c, b / c].iter().position(|value| value.abs() > Input::MAX_COORDINATE_PX)?;
    let (value_px, bound_px) = (entry[row] / c, Input::MAX_COORDINATE_PX);
    wrong(row, format!("{value_px:e} px after division by the third row is beyond {bound_px:e} px"))
}

/// Speaks of `values` where the check of the observations speaks of arrays that a matrix does not have.
fn in_terms_of_the_matrix(error: InvalidInput) -> InvalidInput {
    let mut found = Violations::default();
    for violation in error.violations() {
        let name = violation.field.strip_prefix(MATRIX).and_then(|rest| rest.strip_prefix('.'));
        match name {
            Some("view_indices" | "track_indices" | "xs" | "ys" | "depths") => {
                found.push(Violation::of(field("values"), violation.description.clone()));
            }
            _ => found.push(violation.clone()),
        }
    }
    found.add_unlisted(error.unlisted());
    // Never empty: the error had at least one.
    found.into_result().err().unwrap_or(error)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two views, three tracks: lambda = 2 in the first view, 4 in the second; track 1 is padding in view 1.
    fn matrix() -> proto::MeasurementMatrix {
        #[rustfmt::skip]
        let values = vec![
            2.0, 4.0, 6.0,
            20.0, 40.0, 60.0,
            2.0, 2.0, 2.0,
            4.0, 0.0, 12.0,
            40.0, 0.0, 120.0,
            4.0, 0.0, 4.0,
        ];
        proto::MeasurementMatrix {
            view_count: 2,
            track_count: 3,
            values,
            has_depths: true,
            ..proto::MeasurementMatrix::default()
        }
    }

    fn raw(matrix: proto::MeasurementMatrix) -> RawInput {
        to_input(matrix, &Limits::default()).expect("valid").to_raw()
    }

    fn wrong(change: impl Fn(&mut proto::MeasurementMatrix)) -> Vec<String> {
        let mut matrix = matrix();
        change(&mut matrix);
        let error = to_input(matrix, &Limits::default()).expect_err("invalid input was accepted");
        error.violations().iter().map(Violation::path).collect()
    }

    #[test]
    fn padding_is_stripped_and_indices_are_kept() {
        let raw = raw(matrix());
        assert_eq!(raw.view, [0, 0, 0, 1, 1]);
        assert_eq!(raw.track, [0, 1, 2, 0, 2]);
        assert_eq!(raw.x, [1.0, 2.0, 3.0, 1.0, 3.0]);
        assert_eq!(raw.y, [10.0, 20.0, 30.0, 10.0, 30.0]);
        assert_eq!(raw.depth, [2.0, 2.0, 2.0, 4.0, 4.0]);
        assert_eq!(raw.track_count, 3);
    }

    #[test]
    fn without_depths_the_third_row_only_scales() {
        let raw = raw(proto::MeasurementMatrix { has_depths: false, ..matrix() });
        assert_eq!(raw.x, [1.0, 2.0, 3.0, 1.0, 3.0]);
        assert!(raw.depth.is_empty());
    }

    #[test]
    fn what_the_mask_hides_is_not_looked_at() {
        let mut hidden = matrix();
        hidden.visibility = vec![1, 1, 0, 1, 1, 1];
        hidden.values[2] = f64::NAN;
        let raw = raw(hidden);
        assert_eq!((raw.view, raw.track), (vec![0, 0, 1, 1], vec![0, 1, 0, 2]));
    }

    #[test]
    fn names_field_and_index_of_what_is_wrong() {
        assert_eq!(wrong(|matrix| matrix.values[4] = f64::NAN), ["measurement_matrix.values[4]"]);
        assert_eq!(wrong(|matrix| matrix.values[8] = f64::INFINITY), ["measurement_matrix.values[8]"]);
        assert_eq!(wrong(|matrix| matrix.values[8] = 0.0), ["measurement_matrix.values[8]"]);
        assert_eq!(wrong(|matrix| matrix.values[0] = 1e300), ["measurement_matrix.values[0]"]);
        assert_eq!(wrong(|matrix| matrix.values.truncate(17)), ["measurement_matrix.values"]);
        assert_eq!(wrong(|matrix| matrix.values.push(1.0)), ["measurement_matrix.values"]);
        assert_eq!(wrong(|matrix| matrix.visibility = vec![1; 5]), ["measurement_matrix.visibility"]);
        assert_eq!(wrong(|matrix| matrix.visibility = vec![0; 6]), ["measurement_matrix.values"]);
        assert_eq!(wrong(|matrix| matrix.visibility = vec![1, 1, 1, 0, 0, 0]), ["measurement_matrix.values"]);
        assert_eq!(wrong(|matrix| matrix.views = vec![proto::View::default()]), ["measurement_matrix.views"]);
        assert_eq!(
            wrong(|matrix| (matrix.view_count, matrix.values) = (1, vec![1.0; 9])),
            ["measurement_matrix.view_count"]
        );
        assert_eq!(wrong(|matrix| matrix.view_count = 0), ["measurement_matrix.values"]);
    }

    #[test]
    fn a_giant_claim_is_refused_by_its_counts() {
        let claim = |view_count, track_count| {
            let matrix = proto::MeasurementMatrix { view_count, track_count, ..Default::default() };
            check_size(&matrix, &Limits::default()).expect_err("giant").violations()[0].path()
        };
        assert_eq!(claim(u32::MAX, 1), "measurement_matrix.view_count");
        assert_eq!(claim(2, u32::MAX), "measurement_matrix.track_count");
        assert_eq!(claim(2_000, 1_000_000), "measurement_matrix.track_count");
    }
}
