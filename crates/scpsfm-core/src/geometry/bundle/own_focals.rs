//! Focal lengths of which every view has its own, by the normal equations of the views.

use nalgebra::{DVector, DVectorView, SVector};

use super::intrinsics::Parameter;
use super::metric::POSE;
use super::whitened::WhitenedViews;

/// Share of a view's log focal length in a null direction from which it counts as undetermined.
const TAKES_PART: f64 = 1e-8;
/// Variance of a view's log focal length, over the least of any view, up to which it has a say in the mean: one that is
/// known ten times less well says nothing of it.
const COUNTS_WITHIN: f64 = 100.0;

/// Log focal lengths of which every view has its own.
#[derive(Debug, Clone)]
pub(super) struct OwnFocals {
    pub of_view: Vec<Function>,
    /// Of each camera group, over the views that are determined about as well as any of it.
    pub mean: Vec<Function>,
}

/// A linear function of the unknowns of the views, with the intrinsics that they share held.
#[derive(Debug, Clone)]
pub(super) struct Function {
    /// `None`: not determined.
    pub variance: Option<f64>,
    /// By how much it falls where the shared intrinsics rise.
    pub coupling: DVector<f64>,
    /// What it is at the minimum minus what it is here.
    pub shift: f64,
}

/// An eigenvector of the information on the views.
pub(super) struct Direction<'a> {
    /// `None`: rounding hides it.
    pub information: Option<f64>,
    pub vector: DVectorView<'a, f64>,
    /// What it has in common with the shared intrinsics, and half the downward gradient along it.
    pub coupling: DVector<f64>,
    pub gradient: f64,
}

impl OwnFocals {
    pub fn new<const C: usize>(
        views: &WhitenedViews<C>,
        directions: &[Direction],
        group_of: &[usize],
        groups: usize,
    ) -> Self {
        let count = group_of.len();
        let function = |weight: &dyn Fn(usize) -> f64| Function::new(views, directions, count, weight);
        let of_view: Vec<Function> =
            (0..count).map(|view| function(&|other| if other == view { 1.0 } else { 0.0 })).collect();
        let mean = |group: usize| {
            let of_group = || (0..count).filter(|view| group_of[*view] == group);
            let least = of_group().filter_map(|view| of_view[view].variance).fold(f64::INFINITY, f64::min);
            let counts = |view: usize| {
                let is_known = |variance: f64| variance <= COUNTS_WITHIN * least;
                group_of[view] == group && of_view[view].variance.is_some_and(is_known)
            };
            let counted = of_group().filter(|view| counts(*view)).count();
            function(&|view| if counts(view) { (counted as f64).recip() } else { 0.0 })
        };
        let mean = (0..groups).map(mean).collect();
        Self { of_view, mean }
    }
}

impl Function {
    /// A weighted sum of the log focal lengths of so many views.
    fn new<const C: usize>(
        views: &WhitenedViews<C>,
        directions: &[Direction],
        count: usize,
        weight: &dyn Fn(usize) -> f64,
    ) -> Self {
        let whitened = views.function(|view| {
            let mut gradient = SVector::zeros();
            gradient[POSE] = weight(view);
            gradient
        });
        let shared = directions.first().map_or(0, |direction| direction.coupling.len());
        let mut found = Self { variance: Some(0.0), coupling: DVector::zeros(shared), shift: 0.0 };
        for direction in directions {
            let along = whitened.dot(&direction.vector);
            match direction.information {
                Some(value) => {
                    found.variance = found.variance.map(|sum| sum + along * along / value);
                    found.coupling.axpy(along / value, &direction.coupling, 1.0);
                    found.shift += direction.gradient * along / value;
                }
                None if along * along > TAKES_PART * whitened.norm_squared() => found.variance = None,
                None => {}
            }
        }
        let is_undetermined = (0..count).any(|view| weight(view) > 0.0 && views.unseen(view, POSE) > TAKES_PART);
        found.variance = found.variance.filter(|variance| !is_undetermined && *variance > 0.0);
        // The shared log focal length is replaced by the views' own, so its coupling is zeroed.
        found.coupling.iter_mut().step_by(Parameter::COUNT).for_each(|along| *along = 0.0);
        found
    }
}
