//! The state of an extension: what is known of the cameras, the views, the points and the noise.

use nalgebra::Vector3;

use super::options::{AdjustmentOptions, GrowthOptions};
use crate::geometry::Camera;
use crate::geometry::bundle::metric::{Intrinsics, IntrinsicsModel, MetricReconstruction, Pose};
use crate::geometry::observation::Observation;
use crate::geometry::similarity::Similarity;
use crate::solver::calibration::ViewFocal;
use crate::solver::problem::Problem;

/// The component that the calibration comes from.
pub const FIRST: u32 = 0;

/// A point of the reconstruction.
#[derive(Debug, Clone, Copy)]
pub struct Landmark {
    pub position: Vector3<f64>,
    /// Largest angle between the rays that see it, radians; of a direction, which no ray places, half a turn.
    pub angle: f64,
    /// Observations that agree with it.
    pub support: usize,
    /// Component that it was triangulated in.
    pub component: u32,
}

/// What images the views of a camera.
#[derive(Debug, Clone, Copy)]
pub struct Lens {
    pub intrinsics: Intrinsics,
    /// Which intrinsics adjustments leave free.
    pub free: IntrinsicsModel,
    /// Whether a registered view has it; until then its focal length is a guess.
    pub is_known: bool,
}

/// The focal length of a view that has its own.
#[derive(Debug, Clone, Copy)]
pub struct OwnFocal {
    /// Normalised; a guess until the view is registered.
    pub focal: f64,
    /// Whether the observations determine it.
    pub is_determined: bool,
}

/// A metric reconstruction under way.
#[derive(Debug, Clone)]
pub struct Model {
    /// One a camera.
    pub lenses: Vec<Lens>,
    /// One a view of the input where views have their own, else empty.
    pub own_focals: Vec<OwnFocal>,
    /// One a view of the input.
    pub poses: Vec<Option<Pose>>,
    /// Component of each registered view: views that share no tracks are reconstructions of their own, under one
    /// calibration.
    pub component_of: Vec<u32>,
    /// One a track of the input.
    pub landmarks: Vec<Option<Landmark>>,
    /// One an observation: whether it agrees with its landmark.
    pub kept: Vec<bool>,
    /// Core noise, one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Noise of the seed, whose gates found it.
    seed_noise: f64,
    /// Whether the residuals would have asked for more noise than it may have.
    pub is_strained: bool,
    /// Whether it began from static tracks.
    pub of_static: bool,
    /// Whether the camera only turned: poses have no translation, and landmarks are directions.
    pub has_common_centre: bool,
}

impl Model {
    /// A model of nothing yet, with this noise, all cameras like this one.
    pub fn new(problem: &Problem, intrinsics: Intrinsics, noise: f64) -> Self {
        let views = problem.input.view_count();
        let free = IntrinsicsModel::focal(problem.has_own_focals());
        let lens = Lens { intrinsics, free, is_known: false };
        let own_focal = OwnFocal { focal: intrinsics.focal, is_determined: true };
        Self {
            lenses: vec![lens; problem.cameras],
            own_focals: if problem.has_own_focals() { vec![own_focal; views] } else { Vec::new() },
            poses: vec![None; views],
            component_of: vec![0; views],
            landmarks: vec![None; problem.tracks()],
            kept: vec![false; problem.xy.len()],
            noise,
            seed_noise: noise,
            is_strained: false,
            of_static: false,
            has_common_centre: false,
        }
    }

    /// Takes the noise that the residuals show, within bounds.
    pub fn set_noise(&mut self, problem: &Problem, noise: f64) {
        let least = AdjustmentOptions::DEFAULT.least_noise_px / problem.scale_px;
        let most = GrowthOptions::METRIC.noise_growth * self.seed_noise.max(least);
        if noise.is_finite() {
            self.is_strained = noise > most;
            self.noise = noise.clamp(least, most);
        }
    }

    /// Adds the views of a metric block as a component; lenses that are not known yet are the block's.
    ///
    /// * `focals`: the focal length of each of these views, where views have their own
    pub fn add_component(
        &mut self,
        problem: &Problem,
        component: u32,
        views: &[usize],
        metric: &MetricReconstruction,
        focals: Option<&[ViewFocal]>,
    ) {
        for (i, (&view, pose)) in views.iter().zip(&metric.poses).enumerate() {
            let lens = &mut self.lenses[problem.camera_of[view]];
            if !lens.is_known {
                lens.intrinsics = metric.intrinsics[metric.group_of[i]];
            }
            if let (Some(own), Some(found)) = (self.own_focals.get_mut(view), focals.and_then(|focals| focals.get(i))) {
                *own = OwnFocal { focal: found.focal, is_determined: found.sigma_log.is_some() };
            }
            self.register(problem, view, component, *pose);
        }
    }

    pub fn register(&mut self, problem: &Problem, view: usize, component: u32, pose: Pose) {
        self.poses[view] = Some(pose);
        self.component_of[view] = component;
        self.lenses[problem.camera_of[view]].is_known = true;
    }

    /// Whether the focal length of a view is not known before it is registered.
    pub fn is_focal_unknown(&self, problem: &Problem, view: usize) -> bool {
        !self.own_focals.is_empty() || !self.lenses[problem.camera_of[view]].is_known
    }

    /// Takes these intrinsics for a view: its focal length where it has its own, and all for its camera where no view
    /// had that yet.
    pub fn set_intrinsics(&mut self, problem: &Problem, view: usize, intrinsics: Intrinsics) {
        if let Some(own) = self.own_focals.get_mut(view) {
            *own = OwnFocal { focal: intrinsics.focal, is_determined: true };
        }
        let lens = &mut self.lenses[problem.camera_of[view]];
        if self.own_focals.is_empty() || !lens.is_known {
            lens.intrinsics = intrinsics;
        }
    }

    /// Components that have views, increasing.
    pub fn components(&self) -> Vec<u32> {
        let mut components: Vec<u32> = self.registered().into_iter().map(|view| self.component_of[view]).collect();
        components.sort_unstable();
        components.dedup();
        components
    }

    /// Takes a component into the frame of another one.
    ///
    /// * `similarity`: from the frame of the one to that of the other
    pub fn merge(&mut self, from: u32, into: u32, similarity: &Similarity) {
        for view in self.of_component(from) {
            self.poses[view] = self.poses[view].map(|pose| similarity.pose(&pose));
            self.component_of[view] = into;
        }
        for landmark in self.landmarks.iter_mut().flatten().filter(|landmark| landmark.component == from) {
            landmark.position = similarity.apply(&landmark.position);
            landmark.component = into;
        }
    }

    /// Takes views back.
    pub fn unregister(&mut self, problem: &Problem, views: &[usize]) {
        for &view in views {
            self.poses[view] = None;
            self.component_of[view] = 0;
        }
        self.lenses.iter_mut().for_each(|lens| lens.is_known = false);
        for view in self.registered() {
            self.lenses[problem.camera_of[view]].is_known = true;
        }
    }

    /// Registered views, increasing.
    pub fn registered(&self) -> Vec<usize> {
        (0..self.poses.len()).filter(|&view| self.poses[view].is_some()).collect()
    }

    /// Registered views whose focal length is determined, increasing.
    pub fn determined(&self) -> Vec<usize> {
        let mut views = self.registered();
        views.retain(|&view| self.is_determined(view));
        views
    }

    /// Whether the observations determine the focal length of a view: where views have their own, some may have none
    /// that can be reported.
    pub fn is_determined(&self, view: usize) -> bool {
        self.own_focals.get(view).is_none_or(|own| own.is_determined)
    }

    /// Registered views of a component, increasing.
    pub fn of_component(&self, component: u32) -> Vec<usize> {
        (0..self.poses.len())
            .filter(|&view| self.poses[view].is_some() && self.component_of[view] == component)
            .collect()
    }

    /// Observations of a view that verified landmarks explain: what holds it in its component.
    pub fn held_by(&self, problem: &Problem, view: usize) -> usize {
        let holds = |&&k: &&u32| {
            let k = k as usize;
            self.kept[k] && self.landmarks[problem.track_of(k)].is_some_and(|landmark| landmark.is_verified())
        };
        problem.of_view[view].iter().filter(holds).count()
    }

    pub fn intrinsics_of(&self, problem: &Problem, view: usize) -> Intrinsics {
        let shared = self.lenses[problem.camera_of[view]].intrinsics;
        match self.own_focals.get(view) {
            Some(own) => Intrinsics { focal: own.focal, ..shared },
            None => shared,
        }
    }

    /// Logarithm of the focal length of a camera, the mean over these of its views where views have their own.
    pub fn log_focal(&self, camera: usize, views: &[usize]) -> f64 {
        if self.own_focals.is_empty() {
            return self.lenses[camera].intrinsics.focal.ln();
        }
        let sum: f64 = views.iter().map(|&view| self.own_focals[view].focal.ln()).sum();
        sum / views.len().max(1) as f64
    }

    /// Pinhole cameras of all views; `None` for those that are not registered.
    pub fn cameras(&self, problem: &Problem) -> Vec<Option<Camera>> {
        let camera =
            |(view, pose): (usize, &Option<Pose>)| pose.map(|pose| pose.camera(&self.intrinsics_of(problem, view)));
        self.poses.iter().enumerate().map(camera).collect()
    }

    /// Where the pinhole cameras see an observation; `None` where the view is not registered or the lens images
    /// nothing.
    pub fn observation(&self, problem: &Problem, k: usize) -> Option<Observation> {
        let view = problem.view_of(k);
        self.poses[view]?;
        self.intrinsics_of(problem, view).undistorted(&problem.observation(k))
    }
}
