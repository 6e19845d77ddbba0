//! The normal equations of the intrinsics that views share: those of views and intrinsics with the views eliminated.

use faer::prelude::Solve;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector, DVectorView, SVector};

use super::intrinsics::Parameter;
use super::metric::{MetricReconstruction, POSE, Pose, VIEW};
use super::sequence::{GAUGE_DAMPING, System};
use super::whitened::WhitenedViews;

pub(super) const PARAMETERS: usize = Parameter::COUNT;
/// Views up to which they are eliminated by eigenvectors, which tell what the observations do not say of them, in time
/// cubic in the views: as many as projective cameras are fitted to.
const BY_EIGENVECTORS: usize = 40;
/// Part of a parameter's information, as the root of a share, that a direction of the poses may take and still count as
/// apart from the intrinsics: what rounding leaves where the two have nothing to do with each other.
const APART: f64 = 1e-11;
/// Share of a view's log focal length in a null direction from which it counts as undetermined.
const TAKES_PART: f64 = 1e-8;
/// Variance of a view's log focal length, over the least of any view, up to which it has a say in the mean: one that is
/// known ten times less well says nothing of it.
const COUNTS_WITHIN: f64 = 100.0;

/// Place of an intrinsic of a camera group among all.
pub(super) fn place(group: usize, parameter: Parameter) -> usize {
    PARAMETERS * group + parameter as usize
}

/// The equations; each group's unknowns in the order of [`Parameter`].
#[derive(Debug, Clone)]
pub(super) struct WithoutViews {
    pub matrix: DMatrix<f64>,
    /// Half the downward gradient of the cost.
    pub negative_gradient: DVector<f64>,
    pub own_focals: Option<OwnFocals>,
    /// The matrix' diagonal were poses and points known.
    pub known: Vec<f64>,
}

/// The diagonal of the equations of the intrinsics were all else known; of a focal length that views have of their own,
/// that of one for all.
fn known(system: &System, metric: &MetricReconstruction) -> Vec<f64> {
    let mut known = vec![0.0; PARAMETERS * metric.intrinsics.len()];
    for (view, mut unknowns) in system.of_views() {
        if let Some(own_focal) = unknowns.nth(POSE) {
            known[place(metric.group_of[view], Parameter::LogFocal)] += system.known[own_focal];
        }
    }
    system.of_groups().for_each(|(group, parameter, unknown)| known[place(group, parameter)] = system.known[unknown]);
    known
}

/// Unit information for a parameter of which something is known.
pub(super) fn scale_of(information: f64) -> f64 {
    if information > 0.0 { information.sqrt().recip() } else { 1.0 }
}

impl WithoutViews {
    /// Eliminates the views; `None` where that leaves what is no number.
    pub fn new(system: &System, metric: &MetricReconstruction) -> Option<Self> {
        match (metric.has_own_focals(), metric.poses.len() <= BY_EIGENVECTORS) {
            (true, _) => Self::of_views::<VIEW>(system, metric),
            (false, true) => Self::of_views::<POSE>(system, metric),
            (false, false) => Self::by_factorisation(system, metric),
        }
    }

    /// By the eigenvectors of views of `C` unknowns each.
    fn of_views<const C: usize>(system: &System, metric: &MetricReconstruction) -> Option<Self> {
        let known = known(system, metric);
        let first = known.len();
        let dimension = first + C * metric.poses.len();
        // Where each unknown goes: the intrinsics come first.
        let mut places = vec![0; system.known.len()];
        for (view, unknowns) in system.of_views() {
            unknowns.enumerate().for_each(|(k, unknown)| places[unknown] = first + C * view + k);
        }
        system.of_groups().for_each(|(group, parameter, unknown)| places[unknown] = place(group, parameter));
        let (mut matrix, mut vector) = (DMatrix::zeros(dimension, dimension), DVector::zeros(dimension));
        system.for_each(|row, column, value| {
            matrix[(places[row], places[column])] = value;
            matrix[(places[column], places[row])] = value;
        });
        places.iter().zip(&system.negative_gradient).for_each(|(place, value)| vector[*place] = *value);
        Self::by_eigenvectors::<C>(&matrix, &vector, known, &metric.group_of, &metric.poses)
    }

    /// By a sparse factorisation of the poses, in time linear in the views where each shares points with a bounded
    /// number of others. Directions of the poses on which rounding hides what the observations say count as known;
    /// `None` without intrinsics, or where the poses' equations are not positive definite.
    fn by_factorisation(system: &System, metric: &MetricReconstruction) -> Option<Self> {
        let known = known(system, metric);
        let places: Vec<(usize, usize)> =
            system.of_groups().map(|(group, parameter, unknown)| (unknown, place(group, parameter))).collect();
        // The intrinsics come last.
        let poses = places.first()?.0;
        let shared = |unknown: usize| places[unknown - poses].1;
        let mut information = DMatrix::zeros(known.len(), known.len());
        let mut coupling = Mat::<f64>::zeros(poses, known.len());
        let mut among_poses = Vec::new();
        system.for_each(|row, column, value| match (row < poses, column < poses) {
            (true, _) if row == column => {
                // Nothing is known of this unknown: it stays where it is.
                let held = if system.known[row] > 0.0 { GAUGE_DAMPING * system.known[row] } else { 1.0 };
                among_poses.push(Triplet::new(row, column, value + held));
            }
            (true, _) if value == 0.0 => (),
            (true, _) => among_poses.push(Triplet::new(row, column, value)),
            (false, true) => coupling[(column, shared(row))] = value,
            (false, false) => {
                information[(shared(row), shared(column))] = value;
                information[(shared(column), shared(row))] = value;
            }
        });
        let factor = SparseColMat::<usize, f64>::try_new_from_triplets(poses, poses, &among_poses).ok()?;
        let solved = factor.sp_cholesky(Side::Lower).ok()?.solve(&coupling);
        let vector = &system.negative_gradient;
        let mut negative_gradient = DVector::zeros(known.len());
        for (unknown, k) in &places {
            negative_gradient[*k] = vector[*unknown];
        }
        for k in 0..known.len() {
            let column = solved.col(k);
            negative_gradient[k] -= (0..poses).map(|row| column[row] * vector[row]).sum::<f64>();
            for l in 0..known.len() {
                information[(l, k)] -= (0..poses).map(|row| coupling[(row, l)] * column[row]).sum::<f64>();
            }
        }
        Some(Self { matrix: information, negative_gradient, own_focals: None, known })
    }

    /// Eliminates the views, of `C` unknowns each, from the reduced system, whose first unknowns are the intrinsics.
    /// With it what the views' own focal lengths are, where they have them.
    ///
    /// A direction of the views on which rounding hides what the observations say, but which goes along with the
    /// intrinsics, is taken to be as free as it can be: the intrinsics have no information left along with it. Taken as
    /// known, it would make them certain.
    fn by_eigenvectors<const C: usize>(
        matrix: &DMatrix<f64>,
        vector: &DVector<f64>,
        known: Vec<f64>,
        group_of: &[usize],
        poses: &[Pose],
    ) -> Option<Self> {
        let first = known.len();
        let mut information = matrix.view((0, 0), (first, first)).into_owned();
        let mut negative_gradient = vector.rows(0, first).into_owned();
        let views = WhitenedViews::<C>::new(matrix, first, poses)?;
        let of_column =
            |column: DVectorView<f64>| views.function(|view| column.fixed_rows::<C>(first + C * view).into_owned());
        let coupling: Vec<DVector<f64>> = matrix.column_iter().take(first).map(of_column).collect();
        let gradient = of_column(vector.as_view());
        let directions: Vec<Direction> = views
            .directions()
            .map(|(information, vector)| Direction {
                information,
                vector,
                coupling: DVector::from_fn(first, |row, _| coupling[row].dot(&vector)),
                gradient: gradient.dot(&vector),
            })
            .collect();
        let mut free = Vec::new();
        for direction in &directions {
            let along = &direction.coupling;
            match direction.information {
                Some(value) => {
                    information.ger(-value.recip(), along, along, 1.0);
                    negative_gradient.axpy(-direction.gradient / value, along, 1.0);
                }
                None => free.push(along.clone()),
            }
        }
        let groups = first / PARAMETERS;
        let own_focals = (C > POSE).then(|| OwnFocals::new(&views, &directions, group_of, groups));
        for shared in (0..groups).filter(|_| own_focals.is_some()).map(|group| place(group, Parameter::LogFocal)) {
            // A focal length for all is a direction of the views' own; with it the system would have none of its rank.
            information.row_mut(shared).fill(0.0);
            information.column_mut(shared).fill(0.0);
            information[(shared, shared)] = known[shared];
            negative_gradient[shared] = 0.0;
        }
        let scale = DVector::from_fn(first, |row, _| scale_of(known[row]));
        for along in free {
            let along = along.component_mul(&scale);
            if along.amax() <= APART {
                continue;
            }
            // The most that leaves the information positive.
            let scaled =
                DMatrix::from_fn(first, first, |row, column| information[(row, column)] * scale[row] * scale[column]);
            let Some(solved) = scaled.cholesky().map(|factor| factor.solve(&along)) else { continue };
            let unscaled = along.component_div(&scale);
            information.ger(-along.dot(&solved).recip(), &unscaled, &unscaled, 1.0);
        }
        Some(Self { matrix: information, negative_gradient, own_focals, known })
    }
}

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

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::super::testing::{self, NOISE};
    use super::*;

    /// One pose of which the observations say next to nothing but together with the focal length.
    #[test]
    fn a_pose_that_is_hidden_by_rounding_leaves_the_focal_length_free() {
        // A turn of one view against the other is no similarity.
        let pose = |x: f64| Pose { rotation: Matrix3::identity(), translation: Vector3::new(x, 0.0, 0.0) };
        let dimension = PARAMETERS + 2 * POSE;
        let system = |weak: f64, coupled: f64| {
            let mut matrix = DMatrix::<f64>::identity(dimension, dimension);
            let (first, second) = (PARAMETERS, PARAMETERS + POSE);
            matrix[(second, first)] = 1.0 - weak;
            matrix[(first, 0)] = coupled * (weak / 2.0).sqrt();
            matrix[(second, 0)] = -matrix[(first, 0)];
            matrix.fill_upper_triangle_with_lower_triangle();
            let poses = [pose(0.0), pose(1.0)];
            WithoutViews::by_eigenvectors::<POSE>(
                &matrix,
                &DVector::zeros(dimension),
                vec![1.0; PARAMETERS],
                &[0; 2],
                &poses,
            )
            .expect("finite")
            .matrix
        };
        for weak in [1e-4, 1e-9, 1e-15] {
            let left = system(weak, 0.999)[(0, 0)];
            println!("{weak:e}: {left}");
            assert!(left < 0.01, "{weak:e}: {left}");
        }
        assert_eq!(system(1e-15, 0.0)[(0, 0)], 1.0, "what is apart from the poses is left alone");
    }

    /// A chain of views, each connected with its neighbours only.
    #[test]
    fn a_factorisation_leaves_what_eigenvectors_leave() {
        for seed in 0..5 {
            let mut scene = testing::scene(seed, 30, 300, NOISE);
            scene.observations.retain(|seen| (seen.point % 26..seen.point % 26 + 5).contains(&seen.view));
            let metric = scene.reconstruction();
            let system = System::new(&metric, &scene.observations).expect("finite");
            let expected = WithoutViews::of_views::<POSE>(&system, &metric).expect("finite");
            let found = WithoutViews::by_factorisation(&system, &metric).expect("finite");
            for (k, row) in found.matrix.row_iter().enumerate() {
                let unit = expected.matrix[(k, k)].sqrt();
                for (l, value) in row.iter().enumerate() {
                    let error = (value - expected.matrix[(k, l)]).abs() / (unit * expected.matrix[(l, l)].sqrt());
                    assert!(error < 1e-6, "seed {seed}, {k} and {l}: off by {error}");
                }
                let error = (found.negative_gradient[k] - expected.negative_gradient[k]).abs() / (unit * NOISE);
                assert!(error < 1e-5, "seed {seed}, gradient {k}: off by {error}");
            }
        }
    }
}
