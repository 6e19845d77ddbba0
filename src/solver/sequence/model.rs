//! The state of an extension: what is known of the cameras, the views, the points and the noise.

use nalgebra::{Vector2, Vector3};

use crate::domain::{FocalPrior, StopToken};
use crate::geometry::Camera;
use crate::geometry::bundle::metric::{Intrinsics, IntrinsicsModel, Pose, Reconstruction};
use crate::geometry::observation::Observation;
use crate::solver::calibration::ViewFocal;
use crate::solver::{Context, attempt, block, classification};

/// An input as the extension sees it; observations keep the input's sorted order (track, view).
pub struct Scene<'a> {
    pub context: Context<'a>,
    /// Normalised image points, one an observation.
    pub xy: Vec<Vector2<f64>>,
    /// See [`Observation::weight`]; one an observation.
    pub weights: Vec<f64>,
    /// Observations of each view.
    pub of_view: Vec<Vec<u32>>,
    /// Camera of each view, each of which gets a calibration: the camera groups, counted from 0 in rising order of the
    /// input's numbers, or one for all where they are merged or views have focal lengths of their own.
    pub camera_of: Vec<usize>,
    pub cameras: usize,
    /// What is known of the focal length of each camera beforehand; nothing where views have their own.
    pub focal_priors: Vec<Option<FocalPrior>>,
    /// Density of a wrong coordinate; see [`classification::Geometry::outlier_density`].
    pub outlier_density: f64,
}

impl<'a> Scene<'a> {
    pub fn new(context: &Context<'a>) -> Self {
        let input = context.input;
        let mut of_view = vec![Vec::new(); input.view_count()];
        let mut xy = Vec::with_capacity(input.observation_count());
        for k in 0..input.observation_count() {
            let view = input.view_of(k);
            of_view[view].push(k as u32);
            xy.push(context.normalization.normalize(view, input.point_px(k)));
        }
        let outlier_density = classification::outlier_density(&xy);
        let (camera_of, cameras) = match context.merges_cameras {
            true => (vec![0; input.view_count()], 1),
            false => block::camera_groups(input),
        };
        let of_camera = |camera: usize| {
            let views = input.views().iter().zip(&camera_of).filter(|(_, of)| **of == camera);
            attempt::focal_prior(views.map(|(view, _)| view))
        };
        let is_shared = !context.settings.focal_per_view;
        let focal_priors = (0..cameras).map(|camera| of_camera(camera).filter(|_| is_shared)).collect();
        Self {
            context: *context,
            xy,
            weights: block::weights(input),
            of_view,
            camera_of,
            cameras,
            focal_priors,
            outlier_density,
        }
    }

    /// Whether every view has a focal length of its own.
    pub fn has_own_focals(&self) -> bool {
        self.context.settings.focal_per_view
    }

    pub fn stop(&self) -> &'a StopToken {
        self.context.stop
    }

    pub fn tracks(&self) -> usize {
        self.context.input.track_count()
    }

    pub fn view_of(&self, k: usize) -> usize {
        self.context.input.view_of(k)
    }

    pub fn observation(&self, k: usize) -> Observation {
        Observation { weight: self.weights[k], ..Observation::new(self.view_of(k), self.track_of(k), self.xy[k]) }
    }

    pub fn track_of(&self, k: usize) -> usize {
        self.context.input.track_of(k)
    }

    /// Observations of a track.
    pub fn of_track(&self, track: usize) -> std::ops::Range<usize> {
        self.context.ranges[track]..self.context.ranges[track + 1]
    }
}

/// A point of the reconstruction.
#[derive(Debug, Clone, Copy)]
pub struct Landmark {
    pub position: Vector3<f64>,
    /// Largest angle between the rays that see it, radians.
    pub angle: f64,
    /// Observations that agree with it.
    pub support: usize,
    /// Part that it was triangulated in.
    pub part: u32,
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
    /// Part of each registered view: views that share no tracks are reconstructions of their own, under one
    /// calibration.
    pub part_of: Vec<u32>,
    /// One a track of the input.
    pub landmarks: Vec<Option<Landmark>>,
    /// One an observation: whether it agrees with its landmark.
    pub kept: Vec<bool>,
    /// The part that grows.
    current: u32,
    /// Landmarks of that part among the tracks of each view that may support a pose.
    pub supported: Vec<usize>,
    /// Core noise, one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Noise of the seed, whose gates found it.
    seed_noise: f64,
    /// Whether the residuals would have asked for more noise than [`NOISE_GROWTH`] allows.
    pub is_strained: bool,
}

/// Noise that a sequence may have, in that of its seed: the seed's is measured without a calibration, and a metric
/// reconstruction that fits four times worse is wrong. Without a bound wrong observations widen their own gates.
const NOISE_GROWTH: f64 = 4.0;
/// Least noise that is believed, pixels: exact input would close every gate.
const LEAST_NOISE_PX: f64 = 0.01;

impl Model {
    /// A model of nothing yet, with this noise, all cameras like this one.
    pub fn new(scene: &Scene, intrinsics: Intrinsics, noise: f64) -> Self {
        let views = scene.context.input.view_count();
        let free = IntrinsicsModel::focal(scene.has_own_focals());
        let lens = Lens { intrinsics, free, is_known: false };
        let own_focal = OwnFocal { focal: intrinsics.focal, is_determined: true };
        Self {
            lenses: vec![lens; scene.cameras],
            own_focals: if scene.has_own_focals() { vec![own_focal; views] } else { Vec::new() },
            poses: vec![None; views],
            part_of: vec![0; views],
            landmarks: vec![None; scene.tracks()],
            kept: vec![false; scene.xy.len()],
            current: 0,
            supported: vec![0; views],
            noise,
            seed_noise: noise,
            is_strained: false,
        }
    }

    /// Takes the noise that the residuals show, within bounds.
    pub fn set_noise(&mut self, scene: &Scene, noise: f64) {
        let least = LEAST_NOISE_PX / scene.context.scale_px;
        let most = NOISE_GROWTH * self.seed_noise.max(least);
        if noise.is_finite() {
            self.is_strained = noise > most;
            self.noise = noise.clamp(least, most);
        }
    }

    /// Turns to the part that grows next.
    pub fn turn_to(&mut self, scene: &Scene, part: u32) {
        self.current = part;
        self.supported.fill(0);
        for track in 0..self.landmarks.len() {
            self.count_support(scene, track, 1);
        }
    }

    /// Sets the landmark of a track.
    pub fn set_landmark(&mut self, scene: &Scene, track: usize, landmark: Option<Landmark>) {
        self.count_support(scene, track, -1);
        self.landmarks[track] = landmark;
        self.count_support(scene, track, 1);
    }

    fn count_support(&mut self, scene: &Scene, track: usize, by: isize) {
        let counts = |landmark: &Landmark| landmark.part == self.current && landmark.supports();
        if self.landmarks[track].as_ref().is_some_and(counts) {
            for k in scene.of_track(track) {
                let count = &mut self.supported[scene.view_of(k)];
                *count = count.saturating_add_signed(by);
            }
        }
    }

    /// Adds the views of a metric block as a part; lenses that are not known yet are the block's.
    ///
    /// * `focals`: the focal length of each of these views, where views have their own
    pub fn add_part(
        &mut self,
        scene: &Scene,
        part: u32,
        views: &[usize],
        metric: &Reconstruction,
        focals: Option<&[ViewFocal]>,
    ) {
        for (i, (&view, pose)) in views.iter().zip(&metric.poses).enumerate() {
            let lens = &mut self.lenses[scene.camera_of[view]];
            if !lens.is_known {
                lens.intrinsics = metric.intrinsics[metric.group_of[i]];
            }
            if let (Some(own), Some(found)) = (self.own_focals.get_mut(view), focals.and_then(|focals| focals.get(i))) {
                *own = OwnFocal { focal: found.focal, is_determined: found.sigma_log.is_some() };
            }
            self.register(scene, view, part, *pose);
        }
    }

    pub fn register(&mut self, scene: &Scene, view: usize, part: u32, pose: Pose) {
        self.poses[view] = Some(pose);
        self.part_of[view] = part;
        self.lenses[scene.camera_of[view]].is_known = true;
    }

    /// Whether the focal length of a view is not known before it is registered.
    pub fn is_focal_unknown(&self, scene: &Scene, view: usize) -> bool {
        !self.own_focals.is_empty() || !self.lenses[scene.camera_of[view]].is_known
    }

    /// Takes these intrinsics for a view: its focal length where it has its own, and all for its camera where no view
    /// had that yet.
    pub fn set_intrinsics(&mut self, scene: &Scene, view: usize, intrinsics: Intrinsics) {
        if let Some(own) = self.own_focals.get_mut(view) {
            own.focal = intrinsics.focal;
        }
        let lens = &mut self.lenses[scene.camera_of[view]];
        if self.own_focals.is_empty() || !lens.is_known {
            lens.intrinsics = intrinsics;
        }
    }

    /// Takes views back.
    pub fn unregister(&mut self, scene: &Scene, views: &[usize]) {
        for &view in views {
            self.poses[view] = None;
            self.part_of[view] = 0;
        }
        self.lenses.iter_mut().for_each(|lens| lens.is_known = false);
        for view in self.registered() {
            self.lenses[scene.camera_of[view]].is_known = true;
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
    /// that can be told.
    pub fn is_determined(&self, view: usize) -> bool {
        self.own_focals.get(view).is_none_or(|own| own.is_determined)
    }

    /// Registered views of a part, increasing.
    pub fn of_part(&self, part: u32) -> Vec<usize> {
        (0..self.poses.len()).filter(|&view| self.poses[view].is_some() && self.part_of[view] == part).collect()
    }

    pub fn intrinsics_of(&self, scene: &Scene, view: usize) -> Intrinsics {
        let shared = self.lenses[scene.camera_of[view]].intrinsics;
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
    pub fn cameras(&self, scene: &Scene) -> Vec<Option<Camera>> {
        let camera =
            |(view, pose): (usize, &Option<Pose>)| pose.map(|pose| pose.camera(&self.intrinsics_of(scene, view)));
        self.poses.iter().enumerate().map(camera).collect()
    }

    /// Where the pinhole cameras see an observation; `None` where the view is not registered or the lens images
    /// nothing.
    pub fn observation(&self, scene: &Scene, k: usize) -> Option<Observation> {
        let view = scene.view_of(k);
        self.poses[view]?;
        let seen = scene.observation(k);
        Some(Observation { xy: self.intrinsics_of(scene, view).undistort(&seen.xy)?, ..seen })
    }

    /// Squared residual, normalised units, within which an observation agrees with its landmark.
    pub fn gate(&self, scene: &Scene) -> f64 {
        classification::working_gate(self.noise, scene.outlier_density)
    }
}
